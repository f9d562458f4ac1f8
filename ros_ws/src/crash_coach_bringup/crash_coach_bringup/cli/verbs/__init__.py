"""The verbs of `crash-coach`, a file each."""
