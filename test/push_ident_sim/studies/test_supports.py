"""Plates on feet and whole bases, and objects with loads of their own: balanced, seeded, pushed by an engine that agrees with the model."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from helpers.paths import ROOT
from push_ident.cli.main import app
from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.outline import cells_in_outline, signed_distance
from push_ident.identification.identify import identify
from push_ident.identification.solvers import gauss_newton
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY
from push_ident.types import PusherPath, SolveStatus
from push_ident_sim.engines.planar import LoadedBody, PlanarWorld
from push_ident_sim.objects import Part, object_from_picture
from push_ident_sim.studies.common.calibration import calibration_row
from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.registry import EXPERIMENTS
from push_ident_sim.studies.supports.plates import KINDS, SHAPES, feet_errors, make_plate, make_push, simulate_known_supports

PLATES = [(kind, seed) for kind in KINDS for seed in range(12)]


def square(friction: float = 0.3, pusher_friction: float = 0.25) -> LoadedBody:
    """A plate of 100 mm and 0.6 kg on 10 x 10 equal cells."""
    half, steps = 0.05, (np.arange(10) - 4.5) * 0.01
    return LoadedBody(
        outline=np.array([[-half, -half], [half, -half], [half, half], [-half, half]]),
        place=np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2),
        share=np.full(100, 0.01),
        mass=0.6,
        inertia=0.6 * 0.1**2 / 6,
        friction=friction,
        pusher_friction=pusher_friction,
    )


# --- the engine


def test_push_through_the_centre_takes_the_weight_times_friction_and_does_not_turn() -> None:
    path = PusherPath(np.array([0.0, 1.5]), np.array([[-0.06, 0.0], [-0.03, 0.0]]), 0.005)
    motion = square().push(np.zeros(3), path)
    # The pusher starts 5 mm from the face.
    np.testing.assert_allclose(motion.pose[-1], [0.025, 0.0, 0.0], atol=5e-5)
    sliding = (motion.time > 0.5) & (motion.time < 1.4)
    np.testing.assert_allclose(motion.force[sliding].mean(axis=0), [0.3 * 0.6 * GRAVITY, 0.0], atol=2e-3)


def test_body_with_the_loads_of_the_bed_moves_as_the_object_on_the_bed() -> None:
    thing = object_from_picture("square", ["q" * 10] * 10, {"q": Part(0.6, 0.3, 0.03)}, 0.01, 0.25)
    path = PusherPath(np.array([0.0, 0.5]), np.array([[-0.07, 0.02], [-0.02, 0.03]]), 0.005)
    on_bed = PlanarWorld(thing, path.radius).push((0.0, 0.0, 0.2), path)
    given = square().push((0.0, 0.0, 0.2), path)
    assert abs(given.pose[-1, 2] - 0.2) > 0.1
    np.testing.assert_allclose(given.pose[-1], on_bed.pose[-1], atol=1e-6)


def test_shares_that_do_not_bear_the_weight_are_refused() -> None:
    for share in (np.full(100, 0.02), np.full(99, 1 / 99), np.r_[-0.01, np.full(99, 1.01 / 99)]):
        with pytest.raises(InputError, match="sum 1"):
            LoadedBody(square().outline, square().place, share, 0.6, 1e-3, 0.3, 0.3)


@pytest.mark.parametrize(("kind", "seed"), [("tripod", 3), ("tripod", 7), ("base", 1)])
def test_engine_that_pushes_and_engine_that_identifies_agree_to_a_third_of_a_millimetre(kind: str, seed: int) -> None:
    plate = make_plate(kind, seed)
    for number in range(3):
        record = make_push(plate, number).exact
        start, end = record.poses.pose
        known = simulate_known_supports(plate, PushScenario(record.pusher, start, record.poses.time[-1:])).pose[-1]
        assert cell_error(plate.shape.cells, start, end) >= 0.004
        assert 1e-6 < cell_error(plate.shape.cells, known, end) < 3e-4


# --- plates and pushes


@pytest.mark.parametrize(("kind", "seed"), PLATES)
def test_plate_is_balanced_on_what_it_stands_on(kind: str, seed: int) -> None:
    plate = make_plate(kind, seed)
    body = plate.body
    np.testing.assert_allclose(body.share @ body.place, 0.0, atol=1e-8)
    assert body.share.sum() == pytest.approx(1.0) and body.share.min() > 0.0
    inside = -signed_distance(body.place, body.outline)
    if kind == "tripod":
        assert len(body.share) == 3 and body.share.min() > 0.1 and inside.min() > 0.008
    else:
        assert len(body.share) > 1.8 * len(plate.shape.cells) and inside.min() > 0.0
    assert 80 <= len(plate.shape.cells) <= 120
    assert 0.1 <= body.mass <= 2.0 and all(0.15 <= mu <= 0.45 for mu in (body.friction, body.pusher_friction))
    # The mass lies evenly over the area.
    assert body.inertia == pytest.approx(body.mass * np.mean(np.sum(cells_in_outline(body.outline, 0.001).centres ** 2, axis=1)), rel=0.02)


def test_plates_differ_in_shape_support_pusher_and_noise_and_are_seeded() -> None:
    plates = [make_plate(*which) for which in PLATES]
    assert {plate.form for plate in plates} == set(SHAPES)
    assert {plate.pusher_radius for plate in plates} == {0.002, 0.00475}
    assert {plate.speed_range for plate in plates} == {(0.01, 0.03), (0.05, 0.05)}
    assert all(3e-4 <= plate.pose_std[0] <= 1e-3 for plate in plates)
    spread = [np.ptp(plate.body.share) / plate.body.share.mean() for plate in plates if len(plate.body.share) > 3]
    assert min(spread) < 0.1 and max(spread) > 0.5
    again = make_plate("base", 3)
    np.testing.assert_array_equal(again.body.share, make_plate("base", 3).body.share)
    assert again.body.mass != make_plate("base", 4).body.mass


def test_push_is_observed_twice_with_the_noise_of_its_plate_and_does_not_depend_on_other_pushes() -> None:
    plate = make_plate("tripod", 5)
    pushes = [make_push(plate, number) for number in range(40)]
    np.testing.assert_array_equal(make_push(plate, 7).record.poses.pose, pushes[7].record.poses.pose)
    errors = np.array([push.record.poses.pose[1] - push.exact.poses.pose[1] for push in pushes]) / plate.pose_std
    np.testing.assert_allclose(errors.std(axis=0), 1.0, atol=0.25)
    for push in pushes:
        poses, path = push.record.poses, push.record.pusher
        assert len(poses.time) == 2 and cell_error(plate.shape.cells, poses.pose[0], poses.pose[1]) > 0.001
        speed = np.linalg.norm(np.diff(path.position, axis=0), axis=1) / np.diff(path.time)
        assert speed[0] == speed[2] == 0.0
        low, high = plate.speed_range
        assert low - 1e-9 <= speed[1] <= high + 1e-9


def test_feet_that_were_named_in_another_order_have_no_error() -> None:
    plate = make_plate("tripod", 2)
    order = [2, 0, 1]
    place, share = plate.body.place[order], plate.body.share[order]
    assert feet_errors(place, share, plate) == (0.0, 0.0)
    moved = feet_errors(place + np.array([0.003, 0.004]), share + np.array([0.03, -0.03, 0.0]), plate)
    assert moved == pytest.approx((0.005, 0.02))


# --- the studies


def command(*arguments: object) -> None:
    app(["experiment", *map(str, arguments)], standalone_mode=False)


def test_calibration_counts_pushes_over_all_cases() -> None:
    values = {"end_levels": [0.2, 0.95], "expected_m": [3e-3, 1e-3], "actual_m": [1e-3, 4e-3], "not_predicted": 1}
    row = calibration_row([CaseResult(Case("tripod", model, "2-pushes"), values) for model in (0, 1)])
    assert row["within_90"] == row["beyond_3"] == 0.5 and row["pushes"] == 4 and row["not_predicted"] == 2
    assert row["actual_m"] == pytest.approx(np.sqrt(8.5) * 1e-3, abs=1e-6)


def test_supports_compares_four_models_on_a_tripod_and_a_base_and_resumes(tmp_path: Path) -> None:
    out, file = tmp_path / "out", tmp_path / "supports.json"
    call = ["supports", "--models", 1, "--seed", 23, "--variants", "2-pushes", "--jobs", 1, "--out", out, "--json", file]
    command(*call)
    content = json.loads(file.read_text())
    assert content["objects"] == list(KINDS) and content["failed"] == []
    for kind in KINDS:
        row = content["summary"][kind]["2"]
        noisy, exact = ({model: own["mean_m"] for model, own in row[key].items()} for key in ("errors", "exact_errors"))
        assert 0.0 < exact["truth"] < 3e-4 < min(exact[model] for model in ("uniform", "scalar", "identified"))
        assert exact["truth"] < noisy["truth"] < 4e-3
        assert row["calibration"]["pushes"] == 16 and sum(row["solve"]["priors"].values()) == 1
    written = {path: path.stat().st_mtime_ns for path in (out / "supports").glob("*.json")}
    command(*call)
    assert len(written) == 2 and all(path.stat().st_mtime_ns == time for path, time in written.items())
    study = EXPERIMENTS["supports"]
    assert "three feet, 2 pushes" in study.tables(content["summary"])
    (name,) = study.draw(content["summary"], tmp_path)
    assert (tmp_path / name).stat().st_size > 5000


def test_loads_compares_the_identified_maps_with_the_true_loads(tmp_path: Path) -> None:
    file = tmp_path / "loads.json"
    command("loads", "--objects", "wrench", "--models", 1, "--seed", 0, "--jobs", 1, "--out", tmp_path / "out", "--json", file)
    summary = json.loads(file.read_text())["summary"]
    errors = {model: row["mean_m"] for model, row in summary["wrench"]["errors"].items()}
    # True loads leave the noise of the poses only.
    assert errors["truth"] < 1e-3 < errors["uniform"] and errors["truth"] < errors["weight"]
    assert summary["all"]["calibration"]["pushes"] == 12
    assert "true maps and loads" in EXPERIMENTS["loads"].tables(summary)
    (name,) = EXPERIMENTS["loads"].draw(summary, tmp_path)
    assert (tmp_path / name).stat().st_size > 5000


def test_object_of_another_study_is_refused_with_those_that_there_are() -> None:
    for study, wrong, named in (("supports", "hammer", "tripod"), ("loads", "tripod", "hammer")):
        with pytest.raises(InputError, match=named):
            command(study, "--objects", wrong)


def test_published_seeds_are_not_those_of_tuning() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert "experiment supports --seed 1000 --models 50" in makefile and "experiment loads --seed 3000 --models 8" in makefile


def test_solve_that_prefers_equal_cells_ends_as_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter time steps raise the cost of the best candidate: that makes it no worse than others."""
    monkeypatch.setattr(gauss_newton, "EVEN_ODDS", 1.0)  # two pushes of a plate prefer nothing else to them
    result = identify([make_push(make_plate("base", 1001), number).record for number in range(2)])
    assert max(result.candidates, key=lambda candidate: candidate.probability).name.startswith("equal cells")
    assert result.status is SolveStatus.CONVERGED
