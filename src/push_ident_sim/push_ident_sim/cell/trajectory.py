"""Joint trajectories as a ros2_control trajectory controller runs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class JointTrajectory:
    """Points joined by straight lines, or by cubics where velocities are given; at rest before the first and after the last."""

    time: Float64Array
    """[s], shape (n_points,), strictly increasing."""
    position: Float64Array
    """[rad], shape (n_points, n_joints)."""
    velocity: Float64Array | None = None
    """[rad/s], as `position`; None: straight lines."""

    def __post_init__(self) -> None:
        n_points = len(self.time)
        if n_points == 0 or self.position.ndim != 2 or len(self.position) != n_points:
            raise InputError(f"A trajectory needs one time per row of positions, got {n_points} and shape {self.position.shape}.")
        if self.velocity is not None and self.velocity.shape != self.position.shape:
            raise InputError(f"Velocities have shape {self.velocity.shape}, expected {self.position.shape} or none.")
        parts = [self.time, self.position] + ([] if self.velocity is None else [self.velocity])
        if not all(np.all(np.isfinite(part)) for part in parts):
            raise InputError("A trajectory must be finite throughout.")
        if np.any(np.diff(self.time) <= 0):
            raise InputError("Times of a trajectory must increase strictly from point to point.")

    @classmethod
    def hold(cls, position: Float64Array) -> JointTrajectory:
        """Stay at `position` [rad], shape (n_joints,)."""
        return cls(np.zeros(1), np.array(position, dtype=np.float64)[None, :])

    def from_state(self, now: float, position: Float64Array, velocity: Float64Array, start: float | None = None) -> JointTrajectory:
        """The same delayed by `start` [s], or by `now`, going on from the state commanded `now`; points not after `now` are dropped.

        Raises InputError when it ends before `now`.
        """
        time = self.time + (now if start is None else start)
        ahead = time > now
        if start is not None and not ahead.any():
            raise InputError(f"it ended {now - time[-1]:.3f} s ago.")
        velocities = None if self.velocity is None else np.vstack([velocity, self.velocity[ahead]])
        return JointTrajectory(np.append(now, time[ahead]), np.vstack([position, self.position[ahead]]), velocities)

    def sample(self, time: float) -> tuple[Float64Array, Float64Array]:
        """Position [rad] and velocity [rad/s] at `time` [s], each shape (n_joints,)."""
        if time < self.time[0] or time >= self.time[-1]:
            at = 0 if time < self.time[0] else -1
            return self.position[at].copy(), np.zeros(self.position.shape[1])
        i = int(np.searchsorted(self.time, time, side="right")) - 1
        span = self.time[i + 1] - self.time[i]
        s = (time - self.time[i]) / span
        p0, p1 = self.position[i], self.position[i + 1]
        if self.velocity is None:
            return p0 + s * (p1 - p0), (p1 - p0) / span
        # Cubic Hermite polynomial.
        m0, m1 = span * self.velocity[i], span * self.velocity[i + 1]
        position = (1 + 2 * s) * (1 - s) ** 2 * p0 + s * (1 - s) ** 2 * m0 + s**2 * (3 - 2 * s) * p1 + s**2 * (s - 1) * m1
        velocity = (6 * s * (s - 1) * (p0 - p1) + (1 - s) * (1 - 3 * s) * m0 + s * (3 * s - 2) * m1) / span
        return position, velocity
