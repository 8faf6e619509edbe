"""Sensors in a fit: what measured forces add, and what wrong sensors, cameras and traced outlines must not do to the maps."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import hammer, random_records, square, uniform, with_forces
from push_ident.geometry.outline import dense, signed_distance
from push_ident.geometry.se2 import compose
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import NoiseModel, observe_forces
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.predicting.next_push import PlannedPush, RankingOptions, rank_pushes
from push_ident.identification.predicting.prediction import held_out_errors, predict
from push_ident.identification.results.model_file import load_model, save_model
from push_ident.identification.results.posterior import ModelPosterior, prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.scenario import PushScenario
from push_ident.types import CameraAccuracy, ObjectShape, PusherPath, PushRecord, WrenchTrack

TRUTH = hammer(2)
RECORDS = random_records(TRUTH, 5, 2)
MEASURED = [with_forces(record, TRUTH) for record in RECORDS[:4]]


def test_forces_become_means_over_windows_with_their_noise() -> None:
    time = np.linspace(0.01, 2.0, 200)
    force = np.tile([3.0, -1.0], (200, 1)) + 0.3 * np.random.default_rng(0).normal(size=(200, 2))
    seen = observe_forces(replace(RECORDS[0], wrench=WrenchTrack(time, force)))
    assert seen is not None and len(seen.force) == 20 and seen.edges[[0, -1]] == pytest.approx([0.0, 2.0])
    assert np.abs(seen.force - [3.0, -1.0]).max() < 0.4
    # 0.3 N over 10 samples, and 10 % of 3.2 N in twice as many windows as share it.
    expected = np.hypot(0.3 / np.sqrt(10), np.sqrt(2) * 0.1 * np.hypot(3, 1))
    assert np.median(seen.std[np.isfinite(seen.std)]) == pytest.approx(expected, rel=0.1)
    # A window without a sample says nothing.
    time = np.r_[np.linspace(0.01, 0.5, 50), np.linspace(1.51, 2.0, 50)]
    seen = observe_forces(replace(RECORDS[0], wrench=WrenchTrack(time, np.ones((100, 2)))))
    assert seen is not None and np.isinf(seen.std).sum() >= 8
    assert np.all(seen.residual(np.zeros_like(seen.force))[np.isinf(seen.std)] == 0.0)
    assert observe_forces(RECORDS[0]) is None


def test_a_pusher_that_stands_still_against_the_object_says_nothing_of_it() -> None:
    """Friction holds a body at rest against any force below its limit: what presses it after the stop is that of springs in the arm."""
    record, rest = MEASURED[0], np.arange(0.01, 0.5, 0.01)
    pusher, wrench, end = record.pusher, record.wrench, record.pusher.time[-1]
    assert wrench is not None
    stop = pusher.time[np.flatnonzero(np.any(np.diff(pusher.position, axis=0) != 0.0, axis=1))[-1]]
    forces = WrenchTrack(np.r_[wrench.time, end + rest], np.vstack([wrench.force, np.full((len(rest), 2), 0.4)]))
    position = np.vstack([pusher.position, np.tile(pusher.position[-1], (len(rest), 1))])
    seen = observe_forces(replace(record, pusher=PusherPath(np.r_[pusher.time, end + rest], position, pusher.radius), wrench=forces))
    assert seen is not None
    # The window in which it stops says nothing either: a force that lasts as long as the pusher leans would be taken for a late stop.
    assert np.all(np.isinf(seen.std[seen.edges[1:] > stop]))
    assert np.all(np.isfinite(seen.std[seen.edges[1:] < stop])) and np.count_nonzero(seen.edges[1:] < stop) > 5


@pytest.fixture(scope="module")
def measured() -> ModelPosterior:
    return identify(MEASURED).posterior


def test_total_mass_and_friction_of_the_object_are_known_together_better_than_each(measured: ModelPosterior) -> None:
    unknowns, names = measured.unknowns, ("friction_scale", "total_mass")
    at, std = [unknowns.slices[name].start for name in names], np.array([unknowns.blocks[name].std[0] for name in names])
    both = measured.covariance[np.ix_(at, at)] * np.outer(std, std)
    product = np.sqrt(both.sum())
    assert product < 0.06 and product < 0.5 * np.sqrt(np.diag(both)).min()
    assert measured.model.mass @ measured.model.friction == pytest.approx(TRUTH.mass @ TRUTH.friction, rel=0.08)


@pytest.mark.parametrize(
    ("effect", "value", "left", "accuracy"),
    [("force_offset", [0.6, -0.4], [0.0, 0.0], 0.1), ("force_delay", [0.03], [0.03], 0.004)],
    ids=["offset, which is taken off", "delay"],
)
def test_errors_of_the_sensor_are_found_and_leave_the_maps_alone(
    measured: ModelPosterior, effect: str, value: list[float], left: list[float], accuracy: float
) -> None:
    result = identify([with_forces(r, TRUTH, {effect: value}) for r in RECORDS[:4]])
    wrong = result.posterior
    assert wrong.effects.values[wrong.effects.slice_of(effect)] == pytest.approx(left, abs=accuracy)
    assert any("0.7 N are measured without contact" in note for note in result.notes) == (value != left)
    change = wrong.model.mass * wrong.model.friction - measured.model.mass * measured.model.friction
    assert np.abs(change).max() < np.max(measured.mass_friction_std)


# --- cameras that stand elsewhere than they say, and outlines that they traced


ACCURACY = CameraAccuracy(position=4e-3, heading=1e-2)
WRONG = np.array([4e-3, -3e-3, 8e-3])
"""The true table frame in that of the camera."""
FILMED = random_records(hammer(1), 10, 5)


def traced(shape: ObjectShape, std: float) -> ObjectShape:
    return replace(shape, outline_std=np.full(len(shape.outline), std))


def from_the_camera(records: Sequence[PushRecord], accuracy: CameraAccuracy) -> list[PushRecord]:
    """The same pushes with the poses that the wrong camera reports."""
    return [replace(r, poses=replace(r.poses, pose=np.array([compose(WRONG, p) for p in r.poses.pose]), camera=accuracy)) for r in records]


def test_a_stated_accuracy_finds_where_the_camera_stands_and_predicts_better_also_online() -> None:
    exact, records = from_the_camera(FILMED, CameraAccuracy()), from_the_camera(FILMED, ACCURACY)
    online = OnlineIdentifier(OnlineIdentifier.new(FILMED[0].shape), window=2)
    stds = [online.add(record).posterior.effects_std for record in records[:4]]
    assert stds[-1][0] < stds[0][0] < ACCURACY.position
    errors = []
    for posterior in (identify(exact[:4]).posterior, online.posterior):
        errors.append(held_out_errors(posterior.model, records[6:], effects=posterior.effects).mean())
    assert errors[1] < 0.7 * errors[0]
    assert posterior.effects.names == ("camera_translation", "camera_rotation")
    assert np.all(np.abs(posterior.effects.values - WRONG) < 3.0 * posterior.effects_std)
    assert np.all(posterior.effects_std < [2e-3, 2e-3, 9e-3])  # the pushes say more than the calibration


@pytest.fixture(scope="module")
def posteriors() -> dict[float, ModelPosterior]:
    """After three pushes, by the deviation that the outline states."""
    shapes = {std: traced(FILMED[0].shape, std) if std else FILMED[0].shape for std in (0.0, 3e-3)}
    return {std: identify([replace(r, shape=shape) for r in FILMED[:3]]).posterior for std, shape in shapes.items()}


def test_a_push_that_touches_a_displaced_surface_moves_the_maps_less(posteriors: dict[float, ModelPosterior]) -> None:
    """Where the outline is exact, a push displaced by 3 mm is explained by the object; where it is traced, by its outline."""
    aside = replace(FILMED[2], poses=replace(FILMED[2].poses, pose=FILMED[2].poses.pose + np.array([3e-3, 0.0, 0.0])))
    moved = {}
    for std, without in posteriors.items():
        with_push = identify([replace(r, shape=without.unknowns.shape) for r in (*FILMED[:2], aside)]).posterior.model
        moved[std] = np.linalg.norm(with_push.mass * with_push.friction - without.model.mass * without.model.friction)
    assert moved[3e-3] < 0.5 * moved[0.0]


def test_a_traced_outline_widens_predictions_and_an_exact_one_does_not(posteriors: dict[float, ModelPosterior]) -> None:
    scenario = PushScenario(FILMED[5].pusher, FILMED[5].poses.pose[0], FILMED[5].poses.time[-1:])
    (exact, without), (wide, narrow) = (
        [predict(posterior, scenario, noise=NoiseModel(outline_errors=on)).covariance for on in (True, False)]
        for posterior in posteriors.values()
    )
    assert np.array_equal(exact, without)
    assert np.trace(wide[-1][:2, :2]) > np.trace(narrow[-1][:2, :2]) + 3e-3**2


def test_a_push_of_a_traced_outline_is_expected_to_say_less() -> None:
    """With the prior of the displacement as wide as the outline is uncertain; a very exact outline is as good as an exact one."""
    information = {}
    for std in (0.0, 1e-6, 2e-3):
        posterior = prior_posterior(traced(FILMED[0].shape, std) if std else FILMED[0].shape, Prior(max_modes=6))
        pushes = [PlannedPush(record.poses.pose[0], record.pusher) for record in FILMED[:2]]
        ranked = rank_pushes(posterior, pushes, reference=pushes, rng=np.random.default_rng(0), options=RankingOptions(n_draws=0))
        information[std] = -0.5 * sum(np.linalg.slogdet(value.covariance)[1] for value in ranked.values)
    assert information[1e-6] == pytest.approx(information[0.0], rel=0.05)
    assert information[2e-3] < 0.9 * information[0.0]


def test_pushes_show_how_a_traced_face_is_inclined(tmp_path: Path) -> None:
    """A bulge of 4 mm in the middle of a face, as a matcher of windows leaves it: it inclines both halves by 4 degrees."""
    truth = uniform(square(11, 0.012))
    x = truth.shape.outline[:, 0]
    left = int(np.flatnonzero((x < 0.0) & (np.roll(x, -1) < 0.0))[0])
    bulged = np.insert(truth.shape.outline, left + 1, (x.min() - 0.004, 0.0), axis=0)
    seen = ObjectShape(truth.shape.cells, bulged, np.full(len(bulged), 1.5e-3))
    off: dict[object, float] = {}
    for seed in (5, 6):
        touched = identify([replace(record, shape=seen) for record in random_records(truth, 8, seed)]).posterior
        for name, outline in (("traced", bulged), (seed, touched.model.shape.outline)):
            off[name] = np.sqrt(np.mean(signed_distance(dense(outline, 1e-3), truth.shape.outline) ** 2))
    assert max(off[5], off[6]) < 0.7 * off["traced"]
    save_model(tmp_path / "o1.json", touched, object_id="o1")
    _, read = load_model(tmp_path / "o1.json")
    assert read.model.shape.outline == pytest.approx(touched.model.shape.outline)
    file = json.loads((tmp_path / "o1.json").read_text())
    assert np.array(file["outline"]) == pytest.approx(bulged)
    assert np.array(file["touched_outline"]) == pytest.approx(touched.model.shape.outline)
