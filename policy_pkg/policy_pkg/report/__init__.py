"""Many finished runs under the same episodes: methods over seeds and maps."""
