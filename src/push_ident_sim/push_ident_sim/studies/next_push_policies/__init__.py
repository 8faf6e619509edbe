"""Random pushes against pushes ranked first, on simulated objects."""
