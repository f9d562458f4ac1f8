"""`crash-coach faults`: what faults there are, and fault scenarios judged."""
