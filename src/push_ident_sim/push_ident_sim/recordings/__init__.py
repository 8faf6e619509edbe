"""Simulated pushes: the true motion, what a camera would record of it, and bags of such pushes."""
