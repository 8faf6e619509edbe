"""Experiment: identification over models of depth sensors."""
