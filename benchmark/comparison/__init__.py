"""Comparison of runs: their differences, with probabilities and locations."""
