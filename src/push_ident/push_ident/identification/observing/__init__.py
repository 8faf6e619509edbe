"""Push records condensed for a fit: poses and forces with the noise that they really have."""
