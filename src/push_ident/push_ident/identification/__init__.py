"""Fit the mechanical model of an object to pushes, report its identifiability, and predict other pushes."""
