"""Benchmarks: `make bench` runs every bench_*.py and writes runs/bench.json."""
