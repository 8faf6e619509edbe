"""Many pushes of many models in one call."""
