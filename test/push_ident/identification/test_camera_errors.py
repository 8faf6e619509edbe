"""Identification from a camera that stands elsewhere than it says, and from outlines that it traced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, random_records, square
from push_ident.geometry.se2 import compose
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import NoiseModel, observe_push
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.predicting.next_push import PlannedPush, RankingOptions, rank_pushes
from push_ident.identification.predicting.prediction import held_out_errors, predict
from push_ident.identification.results.posterior import ModelPosterior, prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.scenario import PushScenario
from push_ident.types import CameraAccuracy, ObjectShape, PushRecord

ACCURACY = CameraAccuracy(position=4e-3, heading=1e-2)
WRONG = np.array([4e-3, -3e-3, 8e-3])
"""The true table frame in that of the camera."""
RECORDS = random_records(hammer(1), 10, 5)


def traced(shape: ObjectShape, std: float) -> ObjectShape:
    return replace(shape, outline_std=np.full(len(shape.outline), std))


def from_the_camera(records: Sequence[PushRecord], accuracy: CameraAccuracy) -> list[PushRecord]:
    """The same pushes with the poses that the wrong camera reports."""
    return [replace(r, poses=replace(r.poses, pose=np.array([compose(WRONG, p) for p in r.poses.pose]), camera=accuracy)) for r in records]


def test_a_stated_accuracy_finds_where_the_camera_stands_and_predicts_better() -> None:
    errors = {}
    for accuracy in (CameraAccuracy(), ACCURACY):
        records = from_the_camera(RECORDS, accuracy)
        posterior = identify(records[:4]).posterior
        errors[accuracy] = held_out_errors(posterior.model, records[6:], effects=posterior.effects).mean()
    assert errors[ACCURACY] < 0.7 * errors[CameraAccuracy()]
    assert posterior.effects.names == ("camera_translation", "camera_rotation")
    assert np.all(np.abs(posterior.effects.values - WRONG) < 3.0 * posterior.effects_std)
    assert np.all(posterior.effects_std < [2e-3, 2e-3, 9e-3])  # the pushes say more than the calibration


def test_online_the_camera_stays_an_unknown_from_push_to_push() -> None:
    online = OnlineIdentifier(OnlineIdentifier.new(RECORDS[0].shape), window=2)
    stds = [online.add(record).posterior.effects_std for record in from_the_camera(RECORDS[:3], ACCURACY)]
    assert all(len(std) == 3 for std in stds)
    assert stds[-1][0] < stds[0][0] < ACCURACY.position


@pytest.fixture(scope="module")
def posteriors() -> dict[float, ModelPosterior]:
    """After three pushes, by the deviation that the outline states."""
    shapes = {std: traced(RECORDS[0].shape, std) if std else RECORDS[0].shape for std in (0.0, 3e-3)}
    return {std: identify([replace(r, shape=shape) for r in RECORDS[:3]]).posterior for std, shape in shapes.items()}


def test_a_push_that_touches_a_displaced_surface_moves_the_maps_less(posteriors: dict[float, ModelPosterior]) -> None:
    """Where the outline is exact, a push displaced by 3 mm is explained by the object; where it is traced, by its outline."""
    aside = replace(RECORDS[2], poses=replace(RECORDS[2].poses, pose=RECORDS[2].poses.pose + np.array([3e-3, 0.0, 0.0])))
    moved = {}
    for std, without in posteriors.items():
        with_push = identify([replace(r, shape=without.unknowns.shape) for r in (*RECORDS[:2], aside)]).posterior.model
        moved[std] = np.linalg.norm(with_push.mass * with_push.friction - without.model.mass * without.model.friction)
    assert moved[3e-3] < 0.5 * moved[0.0]


def test_a_traced_outline_widens_predictions_and_an_exact_one_does_not(posteriors: dict[float, ModelPosterior]) -> None:
    scenario = PushScenario(RECORDS[5].pusher, RECORDS[5].poses.pose[0], RECORDS[5].poses.time[-1:])
    (exact, without), (wide, narrow) = (
        [predict(posterior, scenario, noise=NoiseModel(outline_errors=on)).covariance for on in (True, False)]
        for posterior in posteriors.values()
    )
    assert np.array_equal(exact, without)
    assert np.trace(wide[-1][:2, :2]) > np.trace(narrow[-1][:2, :2]) + 3e-3**2


def test_discrepancy_of_an_outline_is_its_slope() -> None:
    shape, noise = square(), NoiseModel(model_discrepancy_position=0.0, model_discrepancy_yaw=0.0)
    assert noise.with_outline_of(shape) is noise and noise.surface_std(shape) == 0.0
    size = np.sqrt(np.mean(np.sum(shape.cells.centres**2, axis=1)))
    assert noise.with_outline_of(traced(shape, 2e-3)).model_discrepancy == pytest.approx([2e-3 / size, 2e-3 / size, 2e-3 / size**2])
    assert observe_push(replace(RECORDS[0], shape=traced(RECORDS[0].shape, 2e-3))).surface_std == pytest.approx(2e-3)


def test_a_push_of_a_traced_outline_is_expected_to_say_less() -> None:
    """With the prior of the displacement as wide as the outline is uncertain; a very exact outline is as good as an exact one."""
    information = {}
    for std in (0.0, 1e-6, 2e-3):
        posterior = prior_posterior(traced(RECORDS[0].shape, std) if std else RECORDS[0].shape, Prior(max_modes=6))
        pushes = [PlannedPush(record.poses.pose[0], record.pusher) for record in RECORDS[:2]]
        ranked = rank_pushes(posterior, pushes, reference=pushes, rng=np.random.default_rng(0), options=RankingOptions(n_draws=0))
        information[std] = -0.5 * sum(np.linalg.slogdet(value.covariance)[1] for value in ranked.values)
    assert information[1e-6] == pytest.approx(information[0.0], rel=0.05)
    assert information[2e-3] < 0.9 * information[0.0]
