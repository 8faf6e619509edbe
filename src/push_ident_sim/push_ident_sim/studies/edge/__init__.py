"""Experiment: objects pushed out over the edge of the table."""
