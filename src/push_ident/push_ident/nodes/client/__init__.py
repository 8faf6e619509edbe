"""The other side of the nodes: clients of a cell, for commands and tests."""
