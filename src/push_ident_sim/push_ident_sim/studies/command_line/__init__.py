"""Times of the commands that people wait for."""
