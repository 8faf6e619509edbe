"""Measured forces of a push, condensed for a fit: means over windows, with the noise that they have.

A mean over a window averages the noise of the sensor and what hands and contacts shake, and its model is a difference of impulses, which
the engine gives with its exact derivative. What the samples scatter from one to the next is the noise of the sensor. The model itself is
wrong by a share of the force, since no law of friction is exact; the windows of a push share this discrepancy. Where a force comes
or goes it takes its time, which a rigid contact does not. A pusher that stands still against the object may press it with any force up to
friction: what is measured then says nothing of the object, nor does a window with a part of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.identification.observing.observation import DRIVING, NEAR, NoiseModel, pusher_gaps
from push_ident.physics.effect_values import EffectValues, force_times, measured_forces
from push_ident.physics.simulation import Motion
from push_ident.types import BoolArray, Float64Array, PushRecord, WrenchTrack

__all__ = ["ForceObservation", "observe_forces"]

_WINDOWS = 20
"""Windows of a push at most."""
_SAMPLES = 3
"""Samples of a window at least, where a push has so many."""
_SHARING = 10
"""Windows of a push for which `NoiseModel.force_discrepancy` holds; where there are more, each counts less."""
_NORMAL = 0.6745
"""Median of the size of a standard normal number."""


@dataclass(frozen=True, slots=True)
class ForceObservation:
    """Mean forces of the pusher on the object over windows that follow each other."""

    edges: Float64Array
    """Where windows begin and end [s], on the clock of the push, shape (n + 1,)."""
    force: Float64Array
    """Mean of each [N], shape (n, 2), table frame."""
    std: Float64Array
    """Standard deviation of each component, the discrepancy of the model included [N], shape (n,); infinite where nothing was measured, and
    where the pusher stands still against the object at some time."""

    def times(self, effects: EffectValues) -> Float64Array:
        """When the forces at `edges` were measured [s], shape (n + 1,)."""
        return force_times(effects, self.edges)[0]

    def residual(self, simulated: Float64Array) -> Float64Array:
        """Whitened difference between simulated forces, shape (n, 2), and the measured ones."""
        return np.asarray((simulated - self.force) / self.std[:, None])

    def simulated(self, impulse: Float64Array, factor: float, effects: EffectValues) -> Float64Array:
        """Forces that a sensor would measure [N], shape (n, 2).

        Args:
            impulse: of the pusher until each of `times` [N s], shape (n + 1, 2).
            factor: of the total mass over that of the simulation.
            effects: those on forces act.
        """
        return measured_forces(effects, factor * np.diff(impulse, axis=0) / np.diff(self.edges)[:, None])[0]

    def derivative(
        self, motion: Motion, by_impulse: Float64Array, factor: float, effects: EffectValues
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Derivative of `residual(simulated(...))`.

        Args:
            motion: simulated, with the impulse at `times`.
            factor, effects: as of `simulated`.
            by_impulse: derivative of the impulse by some unknowns, shape (n + 1, 2, n_unknowns).

        Returns:
            By these unknowns, shape (n, 2, n_unknowns); by the logarithm of the factor, shape (n, 2); by the values of the effects as far
            as they act on forces and their times, shape (n, 2, n_values).
        """
        length = np.diff(self.edges)[:, None]
        force = factor * np.diff(motion.impulse, axis=0) / length
        _, by_force, by_value = measured_forces(effects, force)
        whitened = by_force / self.std[:, None, None]
        by_unknown = whitened @ (factor * np.diff(by_impulse, axis=0) / length[:, :, None])
        _, by_time = force_times(effects, self.edges)
        moved = factor * np.diff(by_time[:, :, None] * motion.force_at, axis=1) / length
        values = np.moveaxis(by_value, 0, 2) / self.std[:, None, None] + np.einsum("nij,vnj->niv", whitened, moved)
        return by_unknown, np.einsum("nij,nj->ni", whitened, force), values


def observe_forces(record: PushRecord, noise: NoiseModel | None = None) -> ForceObservation | None:
    """Condense the measured forces of one push; None where there are none."""
    wrench, noise = record.wrench, noise or NoiseModel()
    if wrench is None or len(wrench.time) < 2:
        return None
    # A sample is the mean since the one before.
    step = float(np.median(np.diff(wrench.time)))
    n = int(np.clip(len(wrench.time) // _SAMPLES, 1, _WINDOWS))
    edges = np.linspace(wrench.time[0] - step, wrench.time[-1], n + 1)
    window = np.clip(np.searchsorted(edges, wrench.time - 0.5 * step, side="right") - 1, 0, n - 1)
    count = np.bincount(window, minlength=n)
    measured = (count > 0) & ~_leans(record, edges)
    sums = np.column_stack([np.bincount(window, weights=wrench.force[:, axis], minlength=n) for axis in (0, 1)])
    force = sums / np.maximum(count, 1)[:, None]
    sensor = np.hypot(_scatter(wrench) / np.sqrt(np.maximum(count, 1)), noise.floor_force)
    discrepancy = noise.force_discrepancy * np.linalg.norm(force, axis=1) * np.sqrt(max(1.0, n / _SHARING))
    rise = min(1.0, noise.force_rise / (edges[1] - edges[0])) * _jumps(force)
    std = np.sqrt(sensor**2 + discrepancy**2 + rise**2)
    return ForceObservation(edges, force, np.where(measured, std, np.inf))


def _leans(record: PushRecord, edges: Float64Array) -> BoolArray:
    """Windows in a part of which the pusher stands still where it may touch the object, after it drove there, shape (n,)."""
    pusher = record.pusher
    gap, speed = pusher_gaps(record), np.linalg.norm(np.gradient(pusher.position, pusher.time, axis=0), axis=1)
    slow = DRIVING * max(float(speed.max()), 1e-9)
    near = max(NEAR, 3 * float(np.sqrt(np.median(record.poses.covariance[:, 0, 0]))))
    arrived = pusher.time[(gap < near) & (speed > slow)]
    if not len(arrived):
        return np.zeros(len(edges) - 1, dtype=bool)
    standing = np.append(pusher.time[speed < slow], edges[np.interp(edges, pusher.time, speed) < slow])
    standing.sort()
    stands = np.searchsorted(standing, edges[1:], side="right") > np.searchsorted(standing, edges[:-1], side="left")
    nearest = np.minimum(*(np.interp(side, pusher.time, gap) for side in (edges[:-1], edges[1:])))
    return np.asarray(stands & (nearest < near) & (edges[:-1] > arrived[0]))


def _jumps(force: Float64Array) -> Float64Array:
    """Largest difference of each window to its neighbours [N], shape (n,), of forces of shape (n, 2)."""
    jump = np.r_[0.0, np.linalg.norm(np.diff(force, axis=0), axis=1), 0.0]
    return np.asarray(np.maximum(jump[:-1], jump[1:]))


def _scatter(wrench: WrenchTrack) -> float:
    """Standard deviation of a sample about its neighbours [N], robust against the jumps of a contact."""
    return float(np.median(np.abs(np.diff(wrench.force, axis=0))) / (_NORMAL * np.sqrt(2.0)))
