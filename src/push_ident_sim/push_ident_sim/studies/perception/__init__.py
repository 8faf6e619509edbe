"""Experiment: errors and times of perception."""
