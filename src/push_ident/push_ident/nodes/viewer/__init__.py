"""Node `viewer_node`."""
