"""Experiment: error against budget for every solver."""
