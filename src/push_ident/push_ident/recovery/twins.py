"""Simulated twins of recorded pushes: the same paths, starts, stamps and noise, with another object and with effects that are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.observing.observation import ForceObservation, NoiseModel, observe_push, rest_frames, scatter_at_rest
from push_ident.identification.unknowns.mechanics import Mechanics
from push_ident.physics.effect_values import true_pose
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, PushRecord, SolveStatus, WrenchTrack

_NUMERICS: Final = SimulationSettings(step=1 / 960, resolve_events=True)
"""Finer than the first steps of a fit, so that their errors do not cancel."""


def twins_of(records: Sequence[PushRecord], mechanics: Mechanics, noise: NoiseModel, rng: np.random.Generator) -> list[PushRecord]:
    """The pushes as they would have been recorded of an object with these mechanics and effects.

    Noise is that of the recording: of the frames by their covariances, what they scatter at rest and their correlation; of forces by what
    they scatter. On top come a displacement of the surface and a model discrepancy, a Wiener process of the travel, of the size that
    `noise` states.

    Raises:
        InputError: a push cannot be simulated.
    """
    return [_twin(record, mechanics, noise.with_outline_of(record.shape), rng) for record in records]


def _twin(record: PushRecord, mechanics: Mechanics, noise: NoiseModel, rng: np.random.Generator) -> PushRecord:
    poses, wrench = record.poses, record.wrench
    displaced = np.append(noise.surface_std(record.shape) * rng.normal(size=2), 0.0)
    start = true_pose(mechanics.effects, observe_push(record, noise).pose[0] - displaced)
    forces = None
    if wrench is not None and len(wrench.time) > 1:
        # A sample is the mean since the one before.
        edges = np.append(wrench.time[0] - np.median(np.diff(wrench.time)), wrench.time)
        forces = ForceObservation(edges, wrench.force, np.ones(len(wrench.time)))
    force_time = np.zeros(0) if forces is None else forces.times(mechanics.all_effects)
    motion = mechanics.simulate(PushScenario(record.pusher, start, poses.time, record.order, force_time), _NUMERICS)
    if motion.status is SolveStatus.SIMULATION_FAILED:
        raise InputError(f"{record.source}: its twin cannot be simulated; leave that push out.")
    steps = np.linalg.norm(np.diff(motion.pose[:, :2], axis=0), axis=1)
    walk = np.cumsum(np.sqrt(steps * steps.sum())[:, None] * rng.normal(size=(len(steps), 3)), axis=0) * noise.model_discrepancy
    pose = motion.pose + displaced + np.vstack([np.zeros(3), walk]) + _errors(record, noise, rng)
    if forces is not None and wrench is not None:
        force = forces.simulated(motion.impulse, mechanics.mass_factor, mechanics.all_effects)
        std = float(np.median(np.abs(np.diff(wrench.force, axis=0)))) / (0.6745 * np.sqrt(2.0))  # of a sample about its neighbours
        wrench = WrenchTrack(wrench.time, force + std * rng.normal(size=force.shape))
    return replace(record, poses=replace(poses, pose=pose), wrench=wrench)


def _errors(record: PushRecord, noise: NoiseModel, rng: np.random.Generator) -> Float64Array:
    """Errors of the frames [m, m, rad], shape (n_frames, 3); see `observation` for what frames share and what averages out."""
    n, rho = len(record.poses.time), max(noise.correlation, 0.0)
    scatter = scatter_at_rest(record, rho)
    error = rng.normal(size=(n, 3))
    for frame in range(1, n):
        error[frame] = rho * error[frame - 1] + np.sqrt(1.0 - rho**2) * error[frame]
    error = np.sqrt(scatter) * error + np.sqrt(max(0.0, 1.0 - 2.0 * scatter)) * rng.normal(size=3)
    before, after, _ = rest_frames(record)
    error[before[-1] + 1 : after[0]] *= noise.frame_factor
    return np.einsum("fij,fj->fi", np.linalg.cholesky(record.poses.covariance), error)
