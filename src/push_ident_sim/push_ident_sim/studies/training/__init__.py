"""Experiment: error against the number of training pushes."""
