"""Whether a motion keeps to the limits of every joint; errors name joint, value and limit."""

from __future__ import annotations

import numpy as np

from push_ident.errors import PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.push import PushCode
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array

__all__ = ["check_accelerations", "check_positions", "check_velocities", "gentler"]

_ROUNDING = 1e-3
"""Relative, of velocities and accelerations."""


def check_positions(kinematics: ArmKinematics, postures: Float64Array) -> None:
    """Raise PlanningError LIMIT where a joint of `postures` [rad], shape (n, n_joints), is beyond its limits."""
    excess = np.maximum(kinematics.position_lower - postures, postures - kinematics.position_upper)
    row, joint = np.unravel_index(int(np.argmax(excess)), excess.shape)
    if excess[row, joint] > 1e-6:
        raise PlanningError(
            PushCode.LIMIT,
            f"{kinematics.joint_names[joint]} would be at {postures[row, joint]:.3f} rad, limits "
            f"{kinematics.position_lower[joint]:.3f}..{kinematics.position_upper[joint]:.3f} rad.",
        )


def check_velocities(joint_names: tuple[str, ...], trajectory: JointTrajectory, limit: Float64Array) -> None:
    """Raise PlanningError LIMIT where a joint turns faster than `limit` [rad/s], shape (n_joints,)."""
    share = np.abs(trajectory.velocity) / limit
    row, joint = np.unravel_index(int(np.argmax(share)), share.shape)
    if share[row, joint] > 1.0 + _ROUNDING:
        raise PlanningError(
            PushCode.LIMIT,
            f"{joint_names[joint]} would turn at {abs(trajectory.velocity[row, joint]):.3f} rad/s, limit {limit[joint]:.3f} rad/s; "
            "push slower.",
        )


def gentler(acceleration: float) -> str:
    """What helps a motion whose tool accelerates at `acceleration` [m/s^2]."""
    return f"lower `acceleration` of the tool, {acceleration:.2f} m/s^2, or push slower"


def check_accelerations(joint_names: tuple[str, ...], trajectory: JointTrajectory, limit: Float64Array, remedy: str) -> None:
    """Raise PlanningError LIMIT, with a remedy, where a joint accelerates at more than `limit` [rad/s^2], shape (n_joints,)."""
    acceleration = np.abs(trajectory.acceleration)
    row, joint = np.unravel_index(int(np.argmax(acceleration / limit)), acceleration.shape)
    if acceleration[row, joint] > limit[joint] * (1.0 + _ROUNDING):
        raise PlanningError(
            PushCode.LIMIT,
            f"{joint_names[joint]} would accelerate at {acceleration[row, joint]:.2f} rad/s^2, limit {limit[joint]:.2f} rad/s^2 "
            f"(joint_acceleration_limits); {remedy}.",
        )
