"""Experiment: the diagnosis on sealed cases."""
