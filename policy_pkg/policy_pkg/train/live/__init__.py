"""A run on episodes that a graph plays."""
