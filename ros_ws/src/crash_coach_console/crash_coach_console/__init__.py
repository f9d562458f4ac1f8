"""The live console: a team, a recording or a training run as a web page."""
