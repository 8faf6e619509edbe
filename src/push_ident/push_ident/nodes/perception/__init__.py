"""Node `perception_node`."""
