"""Benchmark: the default solver to convergence."""
