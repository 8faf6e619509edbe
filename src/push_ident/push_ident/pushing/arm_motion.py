"""A checked motion of the arm, and where an arm is on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.pushing.joint_limits import JointLimits
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array

__all__ = ["ArmMotion", "nearest_on_path"]

_LEAD: Final = 0.05
"""How far the arm may appear to be ahead of the clock [s]: a simulated clock arrives late."""


@dataclass(frozen=True, slots=True)
class ArmMotion:
    """A checked motion of the arm. Times are in seconds from its start."""

    limits: JointLimits
    """Limits of the arm on every motion."""
    trajectory: JointTrajectory
    tip: Float64Array
    """Tip at every sample of the trajectory [m], shape (n, 3), root frame."""

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return self.trajectory.duration

    def deviation(self, tip: Float64Array, earliest: float, latest: float) -> float:
        """Distance [m] of a measured `tip` (3,) to the part of the path between two times of the plan [s], and `_LEAD` further.

        An arm that follows with a delay within these times has no deviation.
        """
        return self._nearest(tip, earliest, latest + _LEAD)[0]

    def joint_deviation(self, q: Float64Array, earliest: float, latest: float) -> tuple[str, float]:
        """The joint that is farthest [rad] from that part of the path, of measured positions `q` [rad], shape (n_joints,)."""
        part = self._part(earliest, latest + _LEAD)
        _, index = nearest_on_path(self.trajectory.position[part], q)
        (on_path,), _ = self.trajectory.follow(np.array([self._time_of(index, part)]))
        i = int(np.argmax(np.abs(q - on_path)))
        return self.limits.names[i], float(abs(q[i] - on_path[i]))

    def time_at(self, tip: Float64Array, earliest: float, latest: float) -> float:
        """Time of the plan [s] between two at which the path is nearest to a measured `tip` (3,)."""
        return self._nearest(tip, earliest, latest)[1]

    def _nearest(self, tip: Float64Array, earliest: float, latest: float) -> tuple[float, float]:
        """Distance [m] of a tip to the path between two times of the plan, and the time of the nearest point [s]."""
        part = self._part(earliest, latest)
        distance, index = nearest_on_path(self.tip[part], tip)
        return distance, self._time_of(index, part)

    def _part(self, earliest: float, latest: float) -> slice:
        """Samples of the trajectory between two times of the plan [s], and one to either side."""
        first, last = np.searchsorted(self.trajectory.time, [earliest, latest])
        return slice(max(int(first) - 1, 0), int(last) + 1)

    def _time_of(self, index: float, part: slice) -> float:
        """Time of the plan [s] at a fractional index of a part of its samples."""
        time = self.trajectory.time[part]
        return float(np.interp(index, np.arange(len(time)), time))


def nearest_on_path(path: Float64Array, point: Float64Array) -> tuple[float, float]:
    """Distance of a point from a path of straight lines.

    Args:
        path: its corners [m], shape (n, d), n at least 1.
        point: shape (d,) [m].

    Returns:
        The distance [m], and the nearest point as a fractional index of corners: 2.25 is a quarter of the way from the third to the fourth.
    """
    edge = np.diff(path, axis=0)
    if len(edge) == 0:
        return float(np.linalg.norm(path[0] - point)), 0.0
    from_start = point - path[:-1]
    share = np.clip(np.sum(from_start * edge, axis=1) / np.maximum(np.sum(edge * edge, axis=1), 1e-300), 0.0, 1.0)
    distance = np.linalg.norm(from_start - share[:, None] * edge, axis=1)
    k = int(np.argmin(distance))
    return float(distance[k]), float(k + share[k])
