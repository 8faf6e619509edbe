"""Inputs of nodes: objects, the table, depth images and pushes."""
