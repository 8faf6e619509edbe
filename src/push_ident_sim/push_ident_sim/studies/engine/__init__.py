"""Benchmark: time and memory of the compiled engine."""
