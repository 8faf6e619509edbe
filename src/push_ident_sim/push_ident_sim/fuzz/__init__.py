"""Fuzzing of the nodes with mutated messages, and of the commands with mutated bags."""
