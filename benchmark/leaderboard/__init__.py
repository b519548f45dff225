"""Benchmarks with a name and a version, results that are handed in, and their table."""
