"""Pose of each known object in each frame, and what happens when a part of it is missing."""
