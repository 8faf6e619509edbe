"""The result of an engine for one push: the truth behind a record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class TrueMotion:
    """The true motion in one push, without noise; one row per time step."""

    time: Float64Array
    """[s], shape (n_steps + 1,), from 0."""
    pose: Float64Array
    """(x, y, yaw) of the object frame in `table` [m, m, rad], shape (n_steps + 1, 3), yaw not wrapped."""
    pusher: Float64Array
    """Axis of the pusher in `table` [m], shape (n_steps + 1, 2)."""
    reported: Float64Array
    """The same as the arm reports it; it differs from `pusher` only under effects that act on the pusher."""
    force: Float64Array
    """Of the pusher on the object in `table` [N], mean over the step that ends at `time`, shape (n_steps + 1, 2)."""

    def pose_at(self, time: float) -> Float64Array:
        """Pose at a time [s], shape (3,); before and after the push everything is at rest."""
        return self._at(time, self.pose)

    def pusher_at(self, time: float) -> Float64Array:
        """Axis of the pusher at a time [s], shape (2,), likewise."""
        return self._at(time, self.pusher)

    def _at(self, time: float, values: Float64Array) -> Float64Array:
        return np.array([np.interp(time, self.time, column) for column in values.T])


def checked_pose(pose: ArrayLike) -> Float64Array:
    """A pose or velocity (x, y, yaw) as an array; raises InputError unless it is three finite numbers."""
    array = np.array(pose, dtype=np.float64)
    if array.shape != (3,) or not np.all(np.isfinite(array)):
        raise InputError(f"A pose or velocity of an object is three finite numbers (x, y, yaw), got {array}.")
    return array
