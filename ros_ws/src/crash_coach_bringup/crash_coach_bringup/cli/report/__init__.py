"""`crash-coach report`: many runs as one page."""
