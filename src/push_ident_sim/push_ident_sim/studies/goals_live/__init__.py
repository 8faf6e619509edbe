"""Experiment: an object is pushed to goals in the live cell."""
