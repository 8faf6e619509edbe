"""The pose of an object while it is pushed: what a model expects of the tool's motion, corrected by the frames of a camera.

A Kalman filter with a variance for each of (x, y, yaw). The tool's place is known far better than the object's, so a pose that would have
the tool inside the object, or hardly in front of it, is moved until they touch.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from push_ident.geometry.se2 import inverse, rotation, transform_points, wrap_angle
from push_ident.physics.batch import BatchClock, ModelBatch
from push_ident.physics.effect_values import driven_path
from push_ident.planning.curved import Face, face_of
from push_ident.types import Float64Array

__all__ = ["ContactTracker"]

_STEP: Final = 1.0 / 120.0
"""Of the simulation between frames [s]."""
_WRONG: Final = np.array([0.1, 2.0])
"""Standard deviation of the expected motion, as a share of the motion [1], and of its turn by its length [rad/m]."""
_DRIFT: Final = np.array([1e-4, 1e-4, 2e-3])
"""And of an object at rest, from frame to frame [m, m, rad]."""
_GATE: Final = 30.0
"""Squared Mahalanobis distance of a frame that the model does not explain [1]: one right frame in a million."""
_IN_A_ROW: Final = 2
"""So many such frames are believed: the object was displaced."""
_TOUCHES: Final = 1e-3
"""A gap that is smaller than this is none [m]: the error of a pose in a frame."""
_DEEP: Final = 5e-3
"""The tool deeper inside the object than this is no error of the pose [m]."""


class ContactTracker:
    """Where an object is that a tool pushes.

    Args:
        model: the most probable one, alone.
        radius: of the tool [m].
        pose: of the object at rest, table frame of the arm, shape (3,).
        covariance: of it, shape (3, 3).
    """

    def __init__(self, model: ModelBatch, radius: float, pose: Float64Array, covariance: Float64Array) -> None:
        self._radius = radius
        self.model = model
        """That says what the tool's motion does."""
        self.pose: Float64Array = np.array(pose, dtype=np.float64)
        """Shape (3,)."""
        self.velocity: Float64Array = np.zeros(3)
        """Of the object frame [m/s, m/s, rad/s], shape (3,)."""
        self._variance: Float64Array = np.diagonal(covariance).copy()
        self._unexplained = 0
        self.was_displaced = False
        """Whether the last frame was believed against the model."""
        self.gap = np.inf
        """Between tool and object [m], after the last frame."""

    def advance(self, time: Float64Array, tool: Float64Array) -> None:
        """The tool has moved: `time` [s], shape (n,), ascending; `tool`, its axis [m], shape (n, 2)."""
        end = float(time[-1])
        ends = np.array([end - min(_STEP, 0.5 * (end - time[0])), end])
        poses = self.model.roll(BatchClock.of(time, ends, _STEP), tool[None], self.pose[None], self.velocity[None])[0, 0]
        if not np.all(np.isfinite(poses)):
            self.velocity = np.zeros(3)
            return
        moved = poses[1] - self.pose
        length = float(np.linalg.norm(moved[:2]))
        wrong = np.array([_WRONG[0] * length, _WRONG[0] * length, _WRONG[0] * abs(moved[2]) + _WRONG[1] * length])
        self._variance = self._variance + wrong**2 + _DRIFT**2
        self.velocity = (poses[1] - poses[0]) / (ends[1] - ends[0])
        self.pose = poses[1]

    def see(self, pose: Float64Array, covariance: Float64Array, tool: Float64Array) -> Face:
        """A frame: pose, shape (3,), its covariance, shape (3, 3), and the axis of the tool then as the arm reports it
        [m], shape (2,).

        Returns the face that the tool is at.
        """
        noise = np.diagonal(covariance)
        difference = np.append((pose - self.pose)[:2], wrap_angle(pose[2] - self.pose[2]))
        unexplained = float(np.sum(difference**2 / (self._variance + noise))) > _GATE
        self._unexplained = self._unexplained + 1 if unexplained else 0
        self.was_displaced = self._unexplained >= _IN_A_ROW
        if self.was_displaced:
            self.pose, self._variance, self.velocity, self._unexplained = self.pose + difference, noise.copy(), np.zeros(3), 0
        elif not unexplained:
            gain = self._variance / (self._variance + noise)
            self.pose = self.pose + gain * difference
            self._variance = (1.0 - gain) * self._variance
        return self._touch(tool)

    def _touch(self, tool: Float64Array) -> Face:
        model = self.model.models[0]
        # Where the tool is by the model, which may know that it is displaced from where the arm reports it.
        at = driven_path(model.effects.of_motion, np.zeros(0), np.append(tool, 0.0)[None])[0][0, :2]
        face, distance = face_of(self.model.shape.outline, transform_points(inverse(self.pose), at[None])[0])
        self.gap = distance - self._radius - model.surface
        if -_DEEP < self.gap < _TOUCHES:
            self.pose = self.pose + np.append(rotation(float(self.pose[2])) @ face.normal * self.gap, 0.0)
            self.gap = 0.0
        return face
