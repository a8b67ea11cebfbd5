"""Measurements apart from the tests: `python -m benchmarks`, or `make bench ARGS=...`. Not part of the package."""
