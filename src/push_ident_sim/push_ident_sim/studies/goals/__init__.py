"""Objects that are pushed to goals."""
