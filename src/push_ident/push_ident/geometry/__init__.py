"""Planar rigid motions and outline polygons."""
