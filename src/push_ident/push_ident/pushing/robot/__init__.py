"""One file for each robot: what the nodes take from it, and whether it fits the arm, the table and the camera."""
