"""Benchmarks of accuracy, run time and stability; README.md contains the results."""
