"""Time steps of a fit: chosen by the noise, kept while it runs, and fine enough for fast pushes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import square, uniform
from push_ident.identification.fitting.levenberg_marquardt import minimise
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.unknowns.mechanics import model_at
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.accuracy import SHARE
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.types import Float64Array, PoseTrack, PusherPath, PushRecord, SolveStatus

SHAPE, FRICTION = square(6, 0.015), 0.17
TRUTH = uniform(SHAPE, 0.8, FRICTION, 0.35)
FINE = SimulationSettings(step=1 / 30720, resolve_events=True)


def _pushes(speed: float, n: int, noise: float, path_noise: float = 0.0) -> list[PushRecord]:
    """Pushes of an even square, known by their end poses, with truth at very short steps."""
    rng = np.random.default_rng(7)
    deviation = np.array([noise, noise, noise / 0.05])
    records = []
    for number in range(n):
        side, along, turn = number * np.pi / 2, rng.uniform(-0.03, 0.03), rng.uniform(-0.4, 0.4)
        towards = np.array([np.cos(side + turn), np.sin(side + turn)])
        face = np.array([[np.cos(side), -np.sin(side)], [np.sin(side), np.cos(side)]]) @ np.array([-0.045 - 0.00475, along])
        duration, coast = 0.035 / speed, 0.1 + 1.5 * speed / (9.81 * FRICTION)
        time = np.arange(0.0, 0.2 + duration + coast, 1 / 250)
        position = face - 0.008 * towards + np.clip(speed * (time - 0.1), 0.0, 0.035)[:, None] * towards
        position = position + path_noise * rng.normal(size=position.shape)
        pusher = PusherPath(time, position, 0.00475)
        ends = time[[0, -1]]
        pose = simulate(TRUTH, PushScenario(pusher, np.zeros(3), ends), settings=FINE).pose + deviation * rng.normal(size=(2, 3))
        covariance = np.broadcast_to(np.diag(deviation**2), (2, 3, 3))
        records.append(PushRecord("o1", SHAPE, PoseTrack(ends, pose, covariance), pusher, source=f"push {number}"))
    return records


def _fit(records: list[PushRecord], settings: SimulationSettings | None = None) -> tuple[FitProblem, Float64Array, SolveStatus]:
    problem = FitProblem(records, UnknownsSpec.of(SHAPE, Prior(), maps=False), settings=settings)
    x, _, status = minimise(problem, np.zeros(problem.size))
    return problem, x, status


def _errors(records: list[PushRecord], problem: FitProblem, x: Float64Array) -> tuple[float, float]:
    """Of the friction [-], and mean one of the ends of pushes by the fitted model, simulated at very short steps [m]."""
    model = model_at(problem.unknowns, problem.object_unknowns(x))
    errors = []
    for record in records:
        scenario = PushScenario(record.pusher, np.zeros(3), record.poses.time[-1:])
        end, true = (simulate(each, scenario, settings=FINE).pose[-1, :2] for each in (model, TRUTH))
        errors.append(float(np.linalg.norm(end - true)))
    return float(abs(model.friction.mean() / FRICTION - 1.0)), float(np.mean(errors))


def test_fit_to_fast_pushes_recovers_the_truth_at_very_short_steps() -> None:
    records = _pushes(0.3, 8, 2e-4)
    problem, x, status = _fit(records)
    coarse, x_coarse, _ = _fit(records, SimulationSettings(step=1 / 240))
    assert status is SolveStatus.CONVERGED
    # The objects coast by 27 mm, which is known to 0.2 mm a push. With steps of 1/240 s, friction takes up their error.
    fine_error, coarse_error = _errors(records, problem, x), _errors(records, coarse, x_coarse)
    assert np.all(np.array(fine_error) < [0.01, 1e-4]) and np.all(np.array(coarse_error) > [0.04, 1e-3])
    assert np.median(problem.step_errors(x)) < SHARE


def test_fit_across_kinks_of_the_cost_converges() -> None:
    # A jerky path strikes the object at each sample; poses that are worse than stated leave large residuals.
    rng = np.random.default_rng(3)
    records = [
        replace(record, poses=replace(record.poses, pose=record.poses.pose + 1e-3 * rng.normal(size=(2, 3))))
        for record in _pushes(0.05, 8, 1e-4, path_noise=5e-5)
    ]
    problem = FitProblem(records, UnknownsSpec.of(SHAPE, Prior()), settings=SimulationSettings(step=1 / 240))
    x, end, status = minimise(problem, np.zeros(problem.size))
    assert status is SolveStatus.CONVERGED
    assert end.cost == pytest.approx(problem.cost(x))
