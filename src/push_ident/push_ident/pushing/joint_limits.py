"""What every joint of an arm keeps to, and whether a motion does; errors name joint, value and limit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.push import PushCode
from push_ident.pushing.trajectory import JointTrajectory, cubics
from push_ident.types import Float64Array

__all__ = ["JointLimits", "gentler"]

_ROUNDING = 1e-3
"""Relative, of velocities and accelerations."""
_PLANNED = 0.95
"""Share of an acceleration limit that a plan uses."""
_ANGLE = 1e-6
"""Of positions [rad]."""


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

    @property
    def planned(self) -> JointLimits:
        """What a plan may use of them, so that the cubics between the points that the arm gets of it keep to the whole."""
        return replace(self, acceleration=_PLANNED * self.acceleration)

    def check_positions(self, postures: Float64Array) -> None:
        """`postures` [rad], shape (n, n_joints), lie within the positions of every joint."""
        excess = np.maximum(self.lower - postures, postures - self.upper)
        row, joint = np.unravel_index(int(np.argmax(excess)), excess.shape)
        if excess[row, joint] > _ANGLE:
            raise PlanningError(
                PushCode.LIMIT,
                f"{self.names[joint]} would be at {postures[row, joint]:.3f} rad, limits "
                f"{self.lower[joint]:.3f}..{self.upper[joint]:.3f} rad.",
            )

    def check_velocities(self, trajectory: JointTrajectory) -> None:
        """No joint turns faster at a sample of a plan."""
        share = np.abs(trajectory.velocity) / self.velocity
        row, joint = np.unravel_index(int(np.argmax(share)), share.shape)
        if not share[row, joint] <= 1.0 + _ROUNDING:
            raise PlanningError(
                PushCode.LIMIT,
                f"{self.names[joint]} would turn at {abs(trajectory.velocity[row, joint]):.3f} rad/s, limit {self.velocity[joint]:.3f} "
                "rad/s; push slower.",
            )

    def check_accelerations(self, trajectory: JointTrajectory, remedy: str) -> None:
        """No joint accelerates more between the samples of a plan, in the mean; the text ends with `remedy`."""
        share = np.abs(trajectory.acceleration) / self.acceleration
        row, joint = np.unravel_index(int(np.argmax(share)), share.shape)
        if not share[row, joint] <= 1.0 + _ROUNDING:
            raise PlanningError(
                PushCode.LIMIT,
                f"{self.names[joint]} would accelerate at {abs(trajectory.acceleration[row, joint]):.2f} rad/s^2, limit "
                f"{self.acceleration[joint]:.2f} rad/s^2 ({_PLANNED:.0%} of joint_acceleration_limits); {remedy}.",
            )

    def are_kept_by(self, followed: JointTrajectory) -> bool:
        """Whether a controller that follows `followed` by cubics between its points keeps to all limits at every moment."""
        velocity, acceleration = cubics(followed)
        within = np.all(followed.position >= self.lower - _ANGLE) and np.all(followed.position <= self.upper + _ANGLE)
        slow = np.all(np.abs(velocity) <= (1.0 + _ROUNDING) * self.velocity)
        return bool(within and slow and np.all(np.abs(acceleration) <= (1.0 + _ROUNDING) * self.acceleration))

    def time_to_move(self, distance: Float64Array) -> float:
        """Least time [s] in which a cubic from rest to rest moves every joint by `distance` [rad], shape (n_joints,)."""
        way = np.abs(distance)
        return float(max(np.max(1.5 * way / self.velocity), np.sqrt(np.max(6.0 * way / self.acceleration))))


def gentler(acceleration: float) -> str:
    """What helps a motion whose tool accelerates at `acceleration` [m/s^2]."""
    return f"lower `acceleration` of the tool, {acceleration:.2f} m/s^2, or push slower"
