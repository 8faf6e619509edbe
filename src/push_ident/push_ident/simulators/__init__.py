"""Simulators of other people: recorded pushes repeated in them, and their gap to what was recorded."""
