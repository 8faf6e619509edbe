"""Joint trajectories: smooth moves between postures, and motion along a path at a given tool speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from push_ident.errors import PlanningError
from push_ident.pushing.push import PushCode
from push_ident.types import Float64Array

SAMPLE_PERIOD: Final = 0.01
"""Time between the samples of a motion, and between looks at a moving arm [s]."""
_MIN_JERK_SPEED = 1.875
"""Highest speed of the minimum-jerk profile over unit length and time (Flash & Hogan 1985)."""
_MIN_JERK_ACCELERATION = 5.774
"""Highest acceleration of the same profile."""


@dataclass(frozen=True, slots=True)
class JointTrajectory:
    """Samples of a motion, about 100 per second."""

    time: Float64Array
    """[s], shape (n,), from 0, strictly increasing."""
    position: Float64Array
    """[rad], shape (n, n_joints)."""
    velocity: Float64Array
    """[rad/s], shape (n, n_joints)."""

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return float(self.time[-1])

    @property
    def acceleration(self) -> Float64Array:
        """Mean acceleration between neighbouring samples [rad/s^2], shape (n - 1, n_joints)."""
        return np.asarray(np.diff(self.velocity, axis=0) / np.diff(self.time)[:, None])

    def follow(self, time: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Position [rad] and velocity [rad/s] at `time` [s], shape (n,), by cubics between the samples; both of shape (n, n_joints).

        At rest before the first sample and after the last one.
        """
        t, q, v = self.time, self.position, self.velocity
        if len(t) == 1:
            return np.tile(q, (len(time), 1)), np.zeros((len(time), q.shape[1]))
        i = np.clip(np.searchsorted(t, time, side="right") - 1, 0, len(t) - 2)
        span = (t[i + 1] - t[i])[:, None]
        u = np.clip((time - t[i])[:, None] / span, 0.0, 1.0)
        m0, m1, change = span * v[i], span * v[i + 1], q[i + 1] - q[i]
        position = q[i] + u * (m0 + u * (3.0 * change - 2.0 * m0 - m1 + u * (m0 + m1 - 2.0 * change)))
        velocity = (m0 + u * (6.0 * change - 4.0 * m0 - 2.0 * m1 + 3.0 * u * (m0 + m1 - 2.0 * change))) / span
        moves = (time >= t[0]) & (time <= t[-1])
        return position, np.where(moves[:, None], velocity, 0.0)


def cubics(trajectory: JointTrajectory) -> tuple[Float64Array, Float64Array]:
    """Extremes of velocity [rad/s] and acceleration [rad/s^2] of the cubics between the points, both of shape (n_extremes, n_joints).

    An acceleration is linear in time between two points, so its extremes are at the points; a velocity has one more where the
    acceleration passes zero.
    """
    span = np.diff(trajectory.time)[:, None]
    before, after = trajectory.velocity[:-1], trajectory.velocity[1:]
    mean = np.diff(trajectory.position, axis=0) / span
    first, last = (6.0 * mean - 4.0 * before - 2.0 * after) / span, (4.0 * after + 2.0 * before - 6.0 * mean) / span
    turns = first * last < 0.0
    share = np.divide(first, first - last, out=np.zeros_like(first), where=turns)
    between = before + 0.5 * share * span * first
    return np.vstack([trajectory.velocity, between]), np.vstack([first, last])


def join(parts: Sequence[JointTrajectory]) -> JointTrajectory:
    """One trajectory of consecutive `parts`; each must begin where the previous one ends."""
    starts = np.cumsum([0.0, *(part.duration for part in parts)])
    rest = [slice(0, None)] + [slice(1, None)] * (len(parts) - 1)
    return JointTrajectory(
        np.concatenate([start + part.time[s] for start, part, s in zip(starts[:-1], parts, rest, strict=True)]),
        np.concatenate([part.position[s] for part, s in zip(parts, rest, strict=True)]),
        np.concatenate([part.velocity[s] for part, s in zip(parts, rest, strict=True)]),
    )


def stand_still(q: Float64Array, duration: float) -> JointTrajectory:
    """Stay at posture `q` for `duration` [s]."""
    time = _samples(duration)
    return JointTrajectory(time, np.tile(q, (len(time), 1)), np.zeros((len(time), len(q))))


def joint_move(q_from: Float64Array, q_to: Float64Array, max_velocity: Float64Array, max_acceleration: Float64Array) -> JointTrajectory:
    """Minimum-jerk move that takes every joint from one posture to another.

    `max_velocity` [rad/s] and `max_acceleration` [rad/s^2] have shape (n_joints,).
    """
    travel = np.abs(q_to - q_from)
    by_velocity = _MIN_JERK_SPEED * float(np.max(travel / max_velocity))
    time = _samples(max(by_velocity, float(np.sqrt(_MIN_JERK_ACCELERATION * np.max(travel / max_acceleration)))))
    share, rate = _min_jerk(time / time[-1])
    return JointTrajectory(time, q_from + share[:, None] * (q_to - q_from), rate[:, None] / time[-1] * (q_to - q_from))


def path_move(
    postures: Float64Array, length: float, max_speed: float, acceleration: float, max_velocity: Float64Array, max_acceleration: Float64Array
) -> JointTrajectory:
    """Minimum-jerk motion along a path, as fast as the limits allow.

    `postures` (n, n_joints) are equally spaced along the `length` [m]; `max_speed` [m/s] and `acceleration` [m/s^2] are limits of the tool,
    `max_velocity` [rad/s] and `max_acceleration` [rad/s^2], shape (n_joints,), of the joints.
    """
    spline = _spline(postures, length)
    at = np.linspace(0.0, length, 4 * len(postures))
    slope, bend = np.max(np.abs(spline(at, 1)), axis=0), np.max(np.abs(spline(at, 2)), axis=0)
    by_speed = _MIN_JERK_SPEED * length * max(1.0 / max_speed, float(np.max(slope / max_velocity)))
    # A joint accelerates with the tool along the path, and where the path bends in the space of joints.
    joints = _MIN_JERK_ACCELERATION * length * slope + (_MIN_JERK_SPEED * length) ** 2 * bend
    by_acceleration = float(np.sqrt(max(_MIN_JERK_ACCELERATION * length / acceleration, np.max(joints / max_acceleration))))
    time = _samples(max(by_speed, by_acceleration))
    share, rate = _min_jerk(time / time[-1])
    return _along(spline, time, length * share, length / time[-1] * rate)


def path_at_speed(postures: Float64Array, length: float, speed: float, acceleration: float) -> JointTrajectory:
    """Motion along a path at constant tool `speed` [m/s], with ramps of constant `acceleration` [m/s^2] at both ends.

    Raises PlanningError LIMIT when the path is too short for the ramps.
    """
    ramp = speed / acceleration
    if speed * ramp > length:
        raise PlanningError(PushCode.LIMIT, f"{length:.3f} m is too short to reach and leave {speed:.3f} m/s; push slower or further.")
    end = length / speed + ramp
    time = _samples(end)
    rate = np.clip(np.minimum(time, end - time) * acceleration, 0.0, speed)
    travel = np.select(
        [time < ramp, time > end - ramp],
        [0.5 * acceleration * time**2, length - 0.5 * acceleration * (end - time) ** 2],
        speed * (time - 0.5 * ramp),
    )
    return _along(_spline(postures, length), time, travel, rate)


def _along(spline: CubicSpline, time: Float64Array, travel: Float64Array, rate: Float64Array) -> JointTrajectory:
    return JointTrajectory(time, spline(travel), spline(travel, 1) * rate[:, None])


def _spline(postures: Float64Array, length: float) -> CubicSpline:
    return CubicSpline(np.linspace(0.0, length, len(postures)), postures)


def _samples(duration: float) -> Float64Array:
    return np.linspace(0.0, max(duration, 2 * SAMPLE_PERIOD), max(int(np.ceil(duration / SAMPLE_PERIOD)), 2) + 1)


def _min_jerk(phase: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Fraction of the path and its rate, at `phase` from 0 to 1."""
    return phase**3 * (10.0 - 15.0 * phase + 6.0 * phase**2), 30.0 * phase**2 * (1.0 - phase) ** 2
