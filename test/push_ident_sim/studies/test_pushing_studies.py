"""Studies that push objects over an edge, along paths and in Push-T, each on its smallest size; and the demo."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.outline import polygon_area
from push_ident.geometry.se2 import transform_points
from push_ident.identification.fitting.budget import Budget
from push_ident.planning.path_steps import PathSteps
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings
from push_ident_sim.studies.common.objects import plate_in_bullet, random_object
from push_ident_sim.studies.common.pushed import PushedObject
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings
from push_ident_sim.studies.paths import HALF_WIDTH, PATHS, Displacement, follow_steered
from push_ident_sim.studies.pusht import BLOCK, GOAL, TICK, Game, actions
from push_ident_sim.studies.registry import EXPERIMENTS

# --- edge


def test_known_object_is_pushed_out_over_the_edge_and_held(tmp_path: Path) -> None:
    settings = CaseSettings(tmp_path, Budget(), TruthSettings(), CameraNoise(), goals=1)
    study, case = EXPERIMENTS["edge"], Case("book", 11, "truth")
    summary = study.summarise([CaseResult(case, study.run(case, settings))])
    row = summary["kinds"]["truth"]
    assert row["falls"] == 0 and row["success"]["share"] == 1.0 and row["causes"] == {}
    assert row["pushes"] >= 1 and row["least_margin_m"] > 0.0
    assert "1/1" in study.tables(summary)


# --- paths


@pytest.fixture(scope="module")
def pushed() -> Iterator[PushedObject]:
    with closing(PushedObject(plate_in_bullet(random_object(np.random.default_rng(3))), "truth", np.random.default_rng(5))) as pushed:
        yield pushed


def test_known_object_is_steered_along_a_line_in_one_contact_and_returns_to_it_after_a_displacement(pushed: PushedObject) -> None:
    planner, displacement = PathSteps(pushed.truth.shape, pushed.settings, HALF_WIDTH), Displacement()
    steered = follow_steered(pushed, planner, "ahead", 0.2)
    displaced = follow_steered(pushed, planner, "ahead", 0.2, displacement)
    assert steered["end"] == "ARRIVED" and steered["contacts"] == 1 and steered["rms_m"] < 0.003 and steered["rms_rad"] < np.radians(2.0)
    assert displaced["end"] == "ARRIVED" and displacement.at > 0.5 and displaced["back_s"] < 3.0
    study, case = EXPERIMENTS["paths"], Case("uneven", 1, "truth")
    results = [
        CaseResult(case, {"paths": [steered | {"name": name} for name in PATHS]}),
        CaseResult(replace(case, variant="displaced"), {"paths": [displaced, displaced | {"back_s": None}]}),
    ]
    text = study.tables(study.summarise(results))
    assert "1/1" in text and f"{1e3 * steered['rms_m']:.1f} mm" in text and "1/2" in text


# --- Push-T


def test_block_is_the_t_of_the_game() -> None:
    assert polygon_area(BLOCK.outline) == pytest.approx(0.12 * 0.03 + 0.03 * 0.09)
    # Ends of bar and stem in the frame of the game, which lies at (256, 256) pixels, turned by 45 degrees, at the goal.
    corners = np.array([[-0.06, 0.0], [0.06, 0.03], [-0.015, 0.12]])
    expected = transform_points(np.array([0.256, 0.256, np.pi / 4]), corners)
    gaps = np.linalg.norm(transform_points(GOAL, BLOCK.outline)[:, None] - expected, axis=2)
    np.testing.assert_allclose(gaps.min(axis=0), 0.0, atol=1e-9)


@pytest.mark.parametrize("length", [0.002, 0.05, 0.3])
def test_disc_is_led_along_a_line_to_rest(length: float) -> None:
    start, heading = np.array([0.2, 0.3]), np.array([0.6, -0.8])
    place, velocity, along = start.copy(), np.zeros(2), []
    targets = actions(start, start + length * heading, 0.15)
    for target in targets:
        for _ in range(10):
            velocity = velocity + 0.01 * (100.0 * (target - place) - 20.0 * velocity)
            place = place + 0.01 * velocity
            along.append(float((place - start) @ heading))
    np.testing.assert_allclose(place, start + length * heading, atol=1e-9)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-8)
    # Never back, and never beyond the end.
    assert np.min(np.diff(along)) > -1e-3 * length and max(along) < 1.001 * length
    assert len(targets) * TICK <= length / 0.15 + 0.3


def test_absent_game_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gym_pusht", None)
    with pytest.raises(InputError, match="gym_pusht is not installed; run `.*pip install"):
        Game.new()


# --- demo


def test_pushes_and_runs_of_the_demo_are_counted() -> None:
    def run(*pushes: tuple[float, float, float, int]) -> dict[str, object]:
        keys = ("predicted_m", "expected_m", "uniform_m")
        test = [dict(zip(keys, push, strict=False)) | {"ways": push[3] * [{"chance": 1.0 / push[3]}]} for push in pushes]
        return {"training": [{"moved_m": 0.05}, test[0]], "per_push": test[1:], "time_s": 100.0}

    first = (0.001, 0.001, 0.01, 1)
    good, bad = (
        run(first, (0.001, 0.001, 0.008, 1), (0.002, 0.001, 0.008, 2)),
        run(first, (0.009, 0.001, 0.004, 1), (0.001, 0.002, 0.002, 1)),
    )
    study = EXPERIMENTS["demo"]
    summary = study.summarise([CaseResult(Case("hammer", seed, "plain"), values) for seed, values in enumerate((good, bad))])
    assert (summary["pushes"], summary["far"], summary["within"], summary["two_ways"], summary["worse"]) == (6, 1, 4, 1, 1)
