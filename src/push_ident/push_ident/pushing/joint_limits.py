"""Limits of the joints of an arm, and checks of motions against them; errors name joint, value and limit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.push import PushCode
from push_ident.pushing.trajectory import JointTrajectory, cubics
from push_ident.types import Float64Array

__all__ = ["JointLimits", "gentler"]


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
