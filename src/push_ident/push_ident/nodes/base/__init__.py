"""What every node is made of: parameters, lifecycle, guard, process, network."""
