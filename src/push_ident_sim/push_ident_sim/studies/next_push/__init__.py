"""Experiment: choosing the next push against random pushes."""
