"""Planar pushing: the fast rigid step, its contact with the outline, and its exact derivatives."""
