"""Experiment: the demo over objects and seeds."""
