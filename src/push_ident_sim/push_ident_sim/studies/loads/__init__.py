"""Experiment: objects whose loads differ from the weight of their cells."""
