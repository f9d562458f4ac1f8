"""Many runs from one file, here or on a cluster."""
