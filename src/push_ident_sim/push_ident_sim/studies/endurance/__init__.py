"""Experiment: the whole live cell for an hour, while its nodes are killed at random."""
