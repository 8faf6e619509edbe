"""Experiment: the diagnosis on sealed cases through the camera."""
