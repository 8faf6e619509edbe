"""Node `goal_pushing_node`."""
