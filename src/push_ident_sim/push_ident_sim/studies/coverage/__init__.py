"""Experiment: calibration of the stated uncertainty."""
