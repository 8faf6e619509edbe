"""Experiment pusht: the frame of the block, motions of the disc, and what is said where the game is not installed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.pusht.disc import actions, way_around
from push_ident_sim.studies.pusht.game import BLOCK, GOAL, RADIUS, TICK, Game
from push_ident_sim.studies.registry import EXPERIMENTS


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


def test_disc_goes_around_the_block() -> None:
    outline = transform_points(GOAL, BLOCK.outline)
    for start, end in (((0.1, 0.25), (0.4, 0.25)), ((0.25, 0.1), (0.25, 0.45)), ((0.05, 0.05), (0.06, 0.4))):
        way = way_around(outline, np.array(start), np.array(end))
        assert way is not None
        np.testing.assert_array_equal(way[-1], end)
        places = np.vstack([np.linspace(a, b, 50) for a, b in zip([np.array(start), *way], way, strict=False)])
        assert float(signed_distance(places, outline).min()) > RADIUS
    touching = outline[0] + 1e-4
    leaving = way_around(outline, touching, np.array([0.45, 0.45]))
    assert leaving is not None and signed_distance(leaving[0][None], outline)[0] > RADIUS
    assert way_around(outline, np.array([0.1, 0.1]), outline.mean(axis=0)) is None


def test_absent_game_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gym_pusht", None)
    with pytest.raises(InputError, match="gym_pusht is not installed; run `.*pip install"):
        Game.new()


def test_summary_has_shares_and_laws(tmp_path: Path) -> None:
    def run(seed: int, won: bool) -> dict[str, object]:
        poses = [[0.2, 0.3, 0.5], GOAL.tolist()]
        return {
            "seed": seed,
            "won": won,
            "coverage": 0.96 if won else 0.5,
            "ticks": 100,
            "pushes": 1,
            "end": "WON" if won else "TIME",
            "poses": poses,
        }

    values = {"law": "viscous", "errors_m": {"dry": 3e-3, "viscous": 5e-4}, "starts": [run(1, True), run(2, True), run(3, False)]}
    study = EXPERIMENTS["pusht"]
    summary = study.summarise([CaseResult(Case("T", 0, "identified"), values)])
    assert summary["kinds"]["identified"]["success"]["successes"] == 2
    table = study.tables(summary)
    assert "2 of 3" in table and "1 TIME" in table and "0.50 mm" in table
    assert [run["seed"] for run in summary["runs"]] == [3, 1, 2]
    assert all((tmp_path / name).stat().st_size > 1000 for name in study.draw(summary, tmp_path))
