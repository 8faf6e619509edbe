"""Experiment: objects pushed to many goals in a row."""
