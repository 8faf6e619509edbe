"""Benchmark: the compiled engine against PyBullet."""
