"""Identification from a camera that stands elsewhere than it says, and from outlines that it traced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, random_records, square
from push_ident.geometry.se2 import compose
from push_ident.identification.fitting.problem import FitProblem, unknowns_of_push
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import NoiseModel, observe_push
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.predicting.next_push import PlannedPush, RankingOptions, rank_pushes
from push_ident.identification.predicting.prediction import held_out_errors, predict
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec, nuisance_effects
from push_ident.physics.scenario import PushScenario
from push_ident.types import CameraAccuracy, ObjectShape, PushRecord

ACCURACY = CameraAccuracy(position=4e-3, heading=1e-2)
WRONG = np.array([4e-3, -3e-3, 8e-3])
"""The true table frame in that of the camera."""
ASIDE = np.array([3e-3, 0.0, 0.0])
RECORDS = random_records(hammer(1), 10, 5)


def traced(shape: ObjectShape, std: float = 1.5e-3) -> ObjectShape:
    return replace(shape, outline_std=np.full(len(shape.outline), std))


def from_the_camera(records: Sequence[PushRecord], accuracy: CameraAccuracy) -> list[PushRecord]:
    """The same pushes with the poses that the wrong camera reports."""
    return [
        replace(r, poses=replace(r.poses, pose=np.array([compose(WRONG, pose) for pose in r.poses.pose]), camera=accuracy)) for r in records
    ]


def test_a_stated_accuracy_finds_where_the_camera_stands_and_predicts_better() -> None:
    errors = {}
    for accuracy in (CameraAccuracy(), ACCURACY):
        records = from_the_camera(RECORDS, accuracy)
        posterior = identify(records[:6]).posterior
        errors[accuracy] = held_out_errors(posterior.model, records[6:], effects=posterior.effects).mean()
    assert errors[ACCURACY] < 0.7 * errors[CameraAccuracy()]
    own, std = posterior.effects, posterior.effects_std
    found = np.r_[own.values[own.slice_of("camera_translation")], own.values[own.slice_of("camera_rotation")]]
    std = np.r_[std[own.slice_of("camera_translation")], std[own.slice_of("camera_rotation")]]
    assert np.all(np.abs(found - WRONG) < 3.0 * std)
    assert np.all(std < [2e-3, 2e-3, 9e-3])  # the pushes say more than the calibration


def test_online_the_camera_stays_an_unknown_from_push_to_push() -> None:
    records = from_the_camera(RECORDS, ACCURACY)
    online = OnlineIdentifier(OnlineIdentifier.new(RECORDS[0].shape), window=2)
    stds = []
    for record in records[:4]:
        stds.append(online.add(record).posterior.effects_std)
    assert all(len(std) == 3 for std in stds)
    assert stds[-1][0] < stds[0][0] < ACCURACY.position


def test_gradient_with_a_traced_outline_and_a_camera_equals_central_differences() -> None:
    shape = traced(RECORDS[0].shape)
    records = [replace(record, shape=shape) for record in from_the_camera(RECORDS[:2], ACCURACY)]
    prior = Prior(max_modes=4).with_camera_accuracy(record.poses.camera for record in records)
    problem = FitProblem(records, UnknownsSpec.of(shape, prior, effects=nuisance_effects(shape, prior)))
    assert problem.unknowns_of_push == unknowns_of_push(shape) == 5
    x = 0.2 * np.random.default_rng(1).normal(size=problem.size)
    gradient = problem.evaluate(x).gradient
    for i in [*range(problem.unknowns.size - 6, problem.unknowns.size), *range(problem.unknowns.size, problem.size)]:
        step = np.zeros(problem.size)
        step[i] = 1e-5
        assert gradient[i] == pytest.approx((problem.cost(x + step) - problem.cost(x - step)) / 2e-5, rel=1e-3, abs=1e-3)


def test_a_push_that_touches_a_displaced_surface_moves_the_maps_less() -> None:
    """Where the outline is exact, a push displaced by 3 mm is explained by the object; where it is traced, by its outline."""
    records = [*RECORDS[:3], replace(RECORDS[3], poses=replace(RECORDS[3].poses, pose=RECORDS[3].poses.pose + ASIDE))]
    moved = {}
    for name, shape in (("exact", RECORDS[0].shape), ("traced", traced(RECORDS[0].shape, 3e-3))):
        with_push, without = (identify([replace(r, shape=shape) for r in part]).posterior.model for part in (records, RECORDS[:4]))
        moved[name] = np.linalg.norm(with_push.mass * with_push.friction - without.mass * without.friction)
    assert moved["traced"] < 0.5 * moved["exact"]


def test_a_traced_outline_widens_predictions_and_an_exact_one_does_not() -> None:
    posterior = identify(RECORDS[:3]).posterior
    record = RECORDS[5]
    scenario = PushScenario(record.pusher, record.poses.pose[0], record.poses.time[-1:])
    exact, off = predict(posterior, scenario), predict(posterior, scenario, noise=NoiseModel(outline_errors=False))
    assert np.array_equal(exact.covariance, off.covariance)
    seen = identify([replace(r, shape=traced(r.shape)) for r in RECORDS[:3]]).posterior
    wide, narrow = predict(seen, scenario), predict(seen, scenario, noise=NoiseModel(outline_errors=False))
    assert np.trace(wide.covariance[-1][:2, :2]) > np.trace(narrow.covariance[-1][:2, :2]) + 1.5e-3**2


def test_discrepancy_of_an_outline_is_its_slope() -> None:
    shape, noise = square(), NoiseModel(model_discrepancy_position=0.0, model_discrepancy_yaw=0.0)
    assert noise.with_outline_of(shape) is noise and noise.surface_std(shape) == 0.0
    seen = traced(shape, 2e-3)
    size = np.sqrt(np.mean(np.sum(shape.cells.centres**2, axis=1)))
    wider = noise.with_outline_of(seen)
    assert wider.model_discrepancy == pytest.approx([2e-3 / size, 2e-3 / size, 2e-3 / size**2])
    assert NoiseModel(outline_errors=False).surface_std(seen) == 0.0
    record = replace(RECORDS[0], shape=traced(RECORDS[0].shape, 2e-3))
    assert observe_push(record).surface_std == pytest.approx(2e-3)


def test_a_push_of_a_traced_outline_is_expected_to_say_less() -> None:
    """With the prior of the displacement as wide as the outline is uncertain; a very exact outline is as good as an exact one."""
    information = {}
    for std in (None, 1e-6, 2e-3):
        shape = RECORDS[0].shape if std is None else traced(RECORDS[0].shape, std)
        posterior = prior_posterior(shape, Prior(max_modes=6))
        pushes = [PlannedPush(record.poses.pose[0], record.pusher) for record in RECORDS[:2]]
        ranked = rank_pushes(posterior, pushes, reference=pushes, rng=np.random.default_rng(0), options=RankingOptions(n_draws=0))
        information[std] = sum(value.information for value in ranked.values)
    assert information[1e-6] == pytest.approx(information[None], rel=0.05)
    assert information[2e-3] < 0.9 * information[None]
