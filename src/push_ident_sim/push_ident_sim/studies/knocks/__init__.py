"""Experiment: objects that are displaced on their path."""
