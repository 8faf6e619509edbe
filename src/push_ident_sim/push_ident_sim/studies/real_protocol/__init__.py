"""Experiment: the protocol of the paper's robot experiment."""
