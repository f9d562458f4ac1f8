"""A run on recordings."""
