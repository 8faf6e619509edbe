"""Experiments paths, knocks and chain: a known object along a line, and what the pages say of results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from push_ident.planning.path_planner import PathPlanner
from push_ident.planning.path_steps import PathSteps
from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.common.plate import plate_in_bullet
from push_ident_sim.studies.common.pushed import PushedObject
from push_ident_sim.studies.common.random_objects import random_object
from push_ident_sim.studies.paths.run import PATHS, SPEED, follow, named_path
from push_ident_sim.studies.paths.steered import HALF_WIDTH, Knock, follow_steered
from push_ident_sim.studies.registry import EXPERIMENTS


def test_known_object_follows_a_line_in_bullet_and_the_page_says_how_closely(tmp_path: Path) -> None:
    pushed = PushedObject(plate_in_bullet(random_object(np.random.default_rng(1))), "truth", np.random.default_rng(5))
    outcome = follow(pushed, PathPlanner(pushed.truth.shape, pushed.settings, SPEED), "line")
    pushed.close()
    row = outcome.values()
    assert row["end"] == "ARRIVED" and row["contacts"] <= 6 and row["rms_m"] < 0.006 and row["followed"] > 0.97
    study, case = EXPERIMENTS["paths"], Case("uneven", 1, "truth")
    values = {"paths": [row | {"name": name} for name in PATHS]}
    summary = study.summarise([CaseResult(case, values)])
    assert "1 of 1" in study.tables(summary) and f"{1e3 * row['rms_m']:.1f} mm" in study.tables(summary)
    assert (tmp_path / next(iter(study.draw(summary, tmp_path)))).stat().st_size > 1000


def test_known_object_is_steered_along_a_line_in_one_contact_and_brought_back_to_it_after_a_knock(tmp_path: Path) -> None:
    pushed = PushedObject(plate_in_bullet(random_object(np.random.default_rng(3))), "truth", np.random.default_rng(5))
    planner, knock = PathSteps(pushed.truth.shape, pushed.settings, HALF_WIDTH), Knock()
    steered = follow_steered(pushed, planner, "ahead", 0.2).values()
    knocked = follow_steered(pushed, planner, "ahead", 0.2, knock).values()
    pushed.close()
    assert steered["end"] == "ARRIVED" and steered["contacts"] == 1 and steered["rms_m"] < 0.003 and steered["rms_rad"] < np.radians(2.0)
    assert knocked["end"] == "ARRIVED" and knocked["largest_m"] > 0.03 and knock.at > 0.5 and knock.back - knock.at < 3.0
    study = EXPERIMENTS["knocks"]
    runs = [knocked | {"back_s": 2.0, "contacts_to_be_back": 0}, knocked | {"back_s": None, "contacts_to_be_back": 3}]
    summary = study.summarise([CaseResult(Case("uneven", 1, "truth"), {"paths": runs})])
    assert "1 of 2" in study.tables(summary) and "2.0 s" in study.tables(summary)
    assert (tmp_path / next(iter(study.draw(summary, tmp_path)))).stat().st_size > 1000


def test_paths_have_the_heading_along_them_and_no_jumps() -> None:
    for name in ("circle", "eight"):
        path = named_path(name)
        step = np.diff(path.poses, axis=0)
        heading = np.arctan2(step[:, 1], step[:, 0])
        assert np.max(np.abs(np.angle(np.exp(1j * (heading - path.poses[:-1, 2]))))) < 0.1
    assert named_path("eight").length == pytest.approx(2 * named_path("circle").length, rel=1e-3)


def test_page_of_chains_counts_goals_whole_chains_and_causes(tmp_path: Path) -> None:
    study = EXPERIMENTS["chain"]
    good = {"reached": [True] * 28, "pushes": [2] * 28, "time_s": [4.0] * 28, "ends": ["ARRIVED"] * 28}
    bad = {**good, "reached": [False, *[True] * 27], "ends": ["UNREACHABLE", *["ARRIVED"] * 27]}
    summary = study.summarise([CaseResult(Case("uneven", k, "identified"), values) for k, values in enumerate((good, bad))])
    text = study.tables(summary)
    assert "55 of 56" in text and "1 of 2" in text and "1 UNREACHABLE" in text and summary["falls"] == 0
    assert (tmp_path / next(iter(study.draw(summary, tmp_path)))).stat().st_size > 1000
