"""Identification while pushes arrive, and the file that survives a killed process."""
