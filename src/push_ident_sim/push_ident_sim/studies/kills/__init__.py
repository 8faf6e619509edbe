"""Experiment: nodes of the live cell killed in the middle of pushes."""
