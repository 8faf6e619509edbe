"""Experiment: learned maps beside the truth."""
