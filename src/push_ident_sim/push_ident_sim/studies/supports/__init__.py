"""Experiment: plates on three feet and on whole bases, known by the end poses of their pushes."""
