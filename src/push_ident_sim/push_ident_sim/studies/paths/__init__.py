"""Experiment: objects pushed along paths."""
