"""A depth frame: its points and labels, the robot in it, the plane of the table, the occupancy of the workspace."""
