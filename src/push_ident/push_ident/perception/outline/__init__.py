"""Outline, cells and heights of an object from one or several views at rest."""
