"""Benchmark: all solvers with the same budget."""
