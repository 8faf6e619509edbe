"""Fit the mechanical model of an object to pushes, say what they leave open, and predict other pushes."""
