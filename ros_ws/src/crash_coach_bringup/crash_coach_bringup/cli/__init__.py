"""One file per verb; main.py is the map."""
