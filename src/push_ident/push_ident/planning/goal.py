"""Where an object shall be, and how likely it is there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.se2 import wrap_angle
from push_ident.types import Float64Array

__all__ = ["CERTAIN", "Goal"]

CERTAIN = 0.9
"""Chance of being at the goal from which the object counts as there [1]."""
_DRAWS = 2000
"""Poses drawn for a chance: its standard error is 1 % at most."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A pose with tolerances.

    Raises:
        InputError: a pose that is not three finite numbers, or a tolerance that is not positive.
    """

    pose: Float64Array
    """Of the object frame in the table frame (x, y, yaw), shape (3,)."""
    position: float = 0.02
    """Largest distance of the object frame's origin from the goal [m]."""
    yaw: float = 0.1
    """Largest angle to the goal [rad]."""

    def __post_init__(self) -> None:
        pose = np.array(self.pose, dtype=np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise InputError(f"The goal is {self.pose}, expected three finite numbers (x, y, yaw) in metres and radians.")
        for name, unit in (("position", "m"), ("yaw", "rad")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"The tolerance of the {name} is {value}, expected a positive number [{unit}].")
        pose.setflags(write=False)
        object.__setattr__(self, "pose", pose)

    @property
    def tolerance(self) -> Float64Array:
        """(x, y, yaw) [m, m, rad], shape (3,)."""
        return np.array([self.position, self.position, self.yaw])

    def error(self, pose: Float64Array) -> Float64Array:
        """Distance [m] and angle [rad] of poses, shape (..., 3), from the goal, shape (..., 2)."""
        difference = np.asarray(pose) - self.pose
        return np.stack([np.linalg.norm(difference[..., :2], axis=-1), np.abs(wrap_angle(difference[..., 2]))], axis=-1)

    def relative_error(self, pose: Float64Array) -> Float64Array:
        """The larger of both errors of poses, shape (..., 3), in units of its tolerance; 1 and less is there. Shape (...)."""
        return np.asarray(np.max(self.error(pose) / [self.position, self.yaw], axis=-1))

    def chance(self, pose: Float64Array, covariance: Float64Array) -> float:
        """Probability of being there at a pose, shape (3,), known with a covariance, shape (3, 3)."""
        value, vector = np.linalg.eigh(covariance)
        root = vector * np.sqrt(np.maximum(value, 0.0))
        drawn = pose + np.random.default_rng(0).normal(size=(_DRAWS, 3)) @ root.T
        return float(np.mean(self.relative_error(drawn) <= 1.0))
