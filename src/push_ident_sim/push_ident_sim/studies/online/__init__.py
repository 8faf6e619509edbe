"""Experiment: learning an object online from depth images."""
