"""Node `push_executor_node`."""
