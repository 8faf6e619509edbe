"""Experiment: live identification against the library."""
