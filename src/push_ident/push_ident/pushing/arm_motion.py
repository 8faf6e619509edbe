"""A checked motion of the arm, the limits of its joints, and where an arm is on it; errors name joint, value and limit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.push import PushCode
from push_ident.pushing.trajectory import JointTrajectory, cubics
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Limits of every joint of an arm; arrays have shape (n_joints,). Methods raise PlanningError LIMIT for what exceeds them."""

    names: tuple[str, ...]
    lower: Float64Array
    """Lowest position [rad]."""
    upper: Float64Array
    """Highest position [rad]."""
    velocity: Float64Array
    """[rad/s]"""
    acceleration: Float64Array
    """[rad/s^2]"""
    planned_share: float = 0.95
    """Share of the acceleration limits that a plan uses [1]: the cubics between its points need a little more."""
    rounding: float = 1e-3
    """Relative excess of a velocity or acceleration that is rounding [1]."""
    angle_rounding: float = 1e-6
    """Excess of a position that is rounding [rad]."""

    @property
    def planned(self) -> JointLimits:
        """Limits of a plan, so that the cubics between the points that the arm gets of it keep to the whole limits."""
        return replace(self, acceleration=self.planned_share * self.acceleration)

    def check_positions(self, postures: Float64Array) -> None:
        """`postures` [rad], shape (n, n_joints), lie within the positions of every joint."""
        excess = np.maximum(self.lower - postures, postures - self.upper)
        row, joint = np.unravel_index(int(np.argmax(excess)), excess.shape)
        if excess[row, joint] > self.angle_rounding:
            raise PlanningError(
                PushCode.LIMIT,
                f"{self.names[joint]} would be at {postures[row, joint]:.3f} rad, limits "
                f"{self.lower[joint]:.3f}..{self.upper[joint]:.3f} rad.",
            )

    def check_velocities(self, trajectory: JointTrajectory) -> None:
        """No joint turns faster at a sample of a plan."""
        share = np.abs(trajectory.velocity) / self.velocity
        row, joint = np.unravel_index(int(np.argmax(share)), share.shape)
        if not share[row, joint] <= 1.0 + self.rounding:
            raise PlanningError(
                PushCode.LIMIT,
                f"{self.names[joint]} would turn at {abs(trajectory.velocity[row, joint]):.3f} rad/s, limit {self.velocity[joint]:.3f} "
                "rad/s; push slower.",
            )

    def check_accelerations(self, trajectory: JointTrajectory, remedy: str) -> None:
        """No joint accelerates more between the samples of a plan, in the mean; the text ends with `remedy`."""
        share = np.abs(trajectory.acceleration) / self.acceleration
        row, joint = np.unravel_index(int(np.argmax(share)), share.shape)
        if not share[row, joint] <= 1.0 + self.rounding:
            raise PlanningError(
                PushCode.LIMIT,
                f"{self.names[joint]} would accelerate at {abs(trajectory.acceleration[row, joint]):.2f} rad/s^2, limit "
                f"{self.acceleration[joint]:.2f} rad/s^2 ({self.planned_share:.0%} of joint_acceleration_limits); {remedy}.",
            )

    def are_kept_by(self, followed: JointTrajectory) -> bool:
        """Whether a controller that follows `followed` by cubics between its points keeps to all limits at every moment."""
        velocity, acceleration = cubics(followed)
        within = np.all(followed.position >= self.lower - self.angle_rounding) and np.all(
            followed.position <= self.upper + self.angle_rounding
        )
        slow = np.all(np.abs(velocity) <= (1.0 + self.rounding) * self.velocity)
        return bool(within and slow and np.all(np.abs(acceleration) <= (1.0 + self.rounding) * self.acceleration))

    def time_to_move(self, distance: Float64Array) -> float:
        """Least time [s] in which a cubic from rest to rest moves every joint by `distance` [rad], shape (n_joints,)."""
        travel = np.abs(distance)
        return float(max(np.max(1.5 * travel / self.velocity), np.sqrt(np.max(6.0 * travel / self.acceleration))))


def gentler(acceleration: float) -> str:
    """Remedy for a motion whose tool accelerates at `acceleration` [m/s^2]."""
    return f"lower `acceleration` of the tool, {acceleration:.2f} m/s^2, or push slower"


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

    def parts_above(self, height: float) -> list[tuple[float, float]]:
        """Times of the plan [s] between which the tip stays above `height` [m]; each part begins and ends at rest."""
        rests = np.flatnonzero(~np.any(self.trajectory.velocity, axis=1))
        parts: list[tuple[float, float]] = []
        for first, last in pairwise(rests.tolist()):
            if np.min(self.tip[first : last + 1, 2]) < height:
                continue
            begin, end = float(self.trajectory.time[first]), float(self.trajectory.time[last])
            if parts and parts[-1][1] == begin:
                begin = parts.pop()[0]
            parts.append((begin, end))
        return parts

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
