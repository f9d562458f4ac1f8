"""The `crash-coach` command line, launch files and layouts: where the packages meet."""
