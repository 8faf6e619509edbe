"""Pushes with effects, and stand-ins for fits and residuals, for the tests of a diagnosis."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from helpers.objects import hammer, random_records
from push_ident.diagnosis.account import Account, ExpectedErrors
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.policy import DecisionPolicy, NextPushPolicy, UnknownPolicy
from push_ident.diagnosis.residuals import FrameResiduals
from push_ident.diagnosis.selection import Candidate, Step
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.types import Float64Array, ObjectModel, PoseTrack, PushRecord

_HAMMER = hammer(1)
TRUTH = ObjectModel(_HAMMER.shape, _HAMMER.mass, _HAMMER.friction, 0.3)
"""The object that is pushed."""
NOISE = np.array([1e-3, 1e-3, np.radians(0.5)])
"""Standard deviation of the poses [m, m, rad]."""

QUICK = DiagnosisSettings(policy=DecisionPolicy(unknown=UnknownPolicy(draws=200), next_push=NextPushPolicy(candidates=24, references=8)))
"""Fewer draws and candidate pushes than by default: what is decided from clear data is the same."""

_FINE = SimulationSettings(step=1 / 1920, resolve_events=True)
"""Finer than the steps of any fit, so that their errors do not cancel."""


def simulated_pushes(n: int, seed: int, effects: dict[str, list[float]] | None = None, *, noise: Float64Array = NOISE) -> list[PushRecord]:
    """Random pushes of `TRUTH` with some effects and white noise; their sources are "push 0", "push 1" and so on."""
    rng = np.random.default_rng([seed, 7])
    records = []
    for order, record in enumerate(random_records(TRUTH, n, seed)):
        scenario = PushScenario(record.pusher, record.poses.pose[0], record.poses.time, order)
        pose = simulate(TRUTH, scenario, settings=_FINE, effects=effects).pose
        records.append(replace(record, poses=_seen(record, pose, rng, noise), order=order, source=f"push {order}"))
    return records


def wobbling(records: list[PushRecord], frequency: float, radius: float, seed: int) -> list[PushRecord]:
    """`TRUTH` pushed along the same paths by a tool that circles about its reported place [Hz, m], with a phase of its own in each push."""
    rng, pushes = np.random.default_rng(seed), []
    for record in records:
        path, angle = record.pusher, 2.0 * np.pi * (frequency * record.pusher.time + rng.random())
        driven = replace(path, position=path.position + radius * np.column_stack([np.cos(angle), np.sin(angle)]))
        pose = simulate(TRUTH, PushScenario(driven, record.poses.pose[0], record.poses.time), settings=_FINE).pose
        pushes.append(replace(record, poses=_seen(record, pose, rng, NOISE)))
    return pushes


def _seen(record: PushRecord, pose: Float64Array, rng: np.random.Generator, noise: Float64Array) -> PoseTrack:
    time, observed = record.poses.time, pose + rng.normal(size=pose.shape) * noise
    return PoseTrack(time, observed, np.broadcast_to(np.diag(noise**2), (len(time), 3, 3)))


def with_correlated_noise(records: list[PushRecord], rho: float, seed: int) -> list[PushRecord]:
    """The same pushes with more noise, of twice the standard deviation, whose errors are correlated from frame to frame."""
    rng = np.random.default_rng(seed)
    noisy = []
    for record in records:
        noise = rng.normal(size=record.poses.pose.shape)
        for k in range(1, len(noise)):
            noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * noise[k]
        track = PoseTrack(record.poses.time, record.poses.pose + 2.0 * NOISE * noise, 5.0 * record.poses.covariance)
        noisy.append(replace(record, poses=track))
    return noisy


def traced_by_camera(records: list[PushRecord]) -> list[PushRecord]:
    """The same pushes of an object whose outline a camera traced."""
    return [replace(record, shape=replace(record.shape, outline_std=np.full(len(record.shape.outline), 4e-4))) for record in records]


class _Stub(SimpleNamespace):
    """Equal to itself only."""

    __eq__ = object.__eq__
    __hash__ = object.__hash__


def stub_fit(*names: str, log_evidence: float = 0.0) -> Fit:
    """A fit of which only the effects and the log evidence are known."""
    return cast(Any, _Stub(names=names, log_evidence=log_evidence, push_log_densities=np.zeros(8)))


def step_of(before: Fit | None = None, **log_bayes_factors: float) -> Step:
    """A step with these refitted effects, the best first; their fits have them only."""
    return Step(before or stub_fit(), None, (), tuple(Candidate(name, stub_fit(name), value) for name, value in log_bayes_factors.items()))


def frame_residuals(standardized: Float64Array) -> FrameResiduals:
    """Standardized residuals of some pushes, shape (n_pushes, n_frames, 3), and nothing else; under the model they would be white."""
    n_pushes, n_frames, _ = standardized.shape
    n = n_pushes * n_frames
    zero, white = np.zeros(n), np.random.default_rng(1).normal(size=(400, n, 3))
    push = np.repeat(np.arange(n_pushes), n_frames)
    return FrameResiduals(standardized.reshape(n, 3), np.zeros((n, 3)), push, zero, zero, zero, zero, np.zeros((n, 2)), zero, white)


def gap_of(before: list[float], after: list[float], noise: float, log_density_gain: float = 1.0, *, names: tuple[str, ...] = ()) -> Gap:
    """A gap of some pushes whose errors [m] are given; each push is a fold."""
    n = len(before)
    return Gap(np.array(before), np.array(after), np.full(n, noise), np.full(n, log_density_gain), np.zeros((n, 1)), names=names)


def account_of_parts(gap: Gap, noise: float, maps: float, model: float, more_pushes: int | None = 0) -> Account:
    """The account of a gap whose expected parts [m] are given, the same for every push."""
    cumulated = np.cumsum([noise, maps, model])
    expected = ExpectedErrors(*(np.full(len(gap.before), part) for part in cumulated), (0.9 * cumulated[-1], 1.1 * cumulated[-1]))
    return Account(gap, expected, more_pushes)
