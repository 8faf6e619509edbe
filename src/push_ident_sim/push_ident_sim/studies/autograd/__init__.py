"""Benchmark: the compiled engine against automatic differentiation."""
