"""Time of a plan of a push to a goal."""
