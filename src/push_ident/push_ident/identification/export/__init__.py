"""Models for other simulators: one description of the object, written as MJCF, SDF or URDF."""
