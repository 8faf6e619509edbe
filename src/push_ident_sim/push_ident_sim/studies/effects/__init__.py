"""Experiment: what a diagnosis is worth when objects are pushed to goals."""
