"""Experiment: Push-T as gym-pusht has it."""
