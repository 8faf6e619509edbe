"""Benchmark: time of a frame in perception."""
