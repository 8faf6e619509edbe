"""Node `identification_node`."""
