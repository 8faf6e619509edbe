"""Experiment: the real executor on the simulated cell."""
