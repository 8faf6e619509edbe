"""Experiment: the live cell settles a diagnosis by itself."""
