"""Planar and spatial rigid motions, outline polygons, and the kinematics and shape of an arm."""
