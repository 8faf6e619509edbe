"""What all faults share: the live cell, the proxy between its nodes, the monitor of its topics, the oracles."""
