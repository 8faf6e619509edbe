"""Experiment: checks of the simulated cell."""
