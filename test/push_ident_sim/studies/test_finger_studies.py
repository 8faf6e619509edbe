"""Studies of pushes with two fingers: recorded ones of two supports, and stable ones in Bullet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.finger_logs import arc, write_run
from push_ident.bags.importers.cmu_fingers import published_shape
from push_ident.errors import InputError
from push_ident.identification.fitting.budget import Budget
from push_ident.types import ObjectModel, PoseTrack, PushRecord
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings
from push_ident_sim.studies.registry import EXPERIMENTS
from push_ident_sim.studies.two_fingers import find_finger_sets, pressure_span, split_runs

STUDY = EXPERIMENTS["two-fingers"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    for name in ("bigrect_3pts", "bigrect_ridge"):
        for seed in range(6):
            write_run(folder / name / f"run_{seed}" / f"log_{seed}.txt", seed)
    write_run(folder / "bigrect_3pts" / "run" / "log.txt", 9)
    (folder / "butter").mkdir()
    (folder / "butter" / "log.txt").write_text("")
    return folder


def settings_of(folder: Path) -> CaseSettings:
    return CaseSettings(folder, Budget(max_seconds=5.0), TruthSettings(), CameraNoise(), recordings=folder, goals=1)


def test_runs_are_either_trained_on_or_predicted_and_each_draw_is_another(folder: Path, tmp_path: Path) -> None:
    sets = find_finger_sets(folder)
    assert set(sets) == {"bigrect_3pts", "bigrect_ridge"}
    split = split_runs(sets["bigrect_3pts"], 0)
    assert (len(split.train), len(split.test)) == (10, 4)
    sources = [{record.poses.pose[0].tobytes() for record in part} for part in (split.train, split.test)]
    assert not sources[0] & sources[1] and {len(record.poses.time) for record in (*split.train, *split.test)} == {2}
    assert split_runs(sets["bigrect_3pts"], 1).test[0].poses.pose[0].tobytes() != split.test[0].poses.pose[0].tobytes()
    with pytest.raises(InputError, match="robot_exp_logs"):
        find_finger_sets(tmp_path)


def test_simulated_logs_are_predicted_and_their_equal_supports_not_told_apart(folder: Path) -> None:
    results = [
        CaseResult(case, STUDY.run(case, settings_of(folder)))
        for case in (Case(name, draw, "whole-base") for name in ("bigrect_3pts", "bigrect_ridge") for draw in (0, 1))
    ]
    summary = STUDY.summarise(results)
    row = summary["predicted"]["bigrect_3pts, whole-base"]
    assert row["draws"] == 2 and row["pushes"] == [10, 4] and row["moved_m"] > 0.05
    # The pushes are exact; what is left is the registration of the camera.
    assert row["scalar"] < 1.5e-3 and row["pressure_m"] >= 0.0
    assert len(summary["told_apart"]) == 2 and all(abs(row["mean_m"]) < 1e-3 for row in summary["told_apart"].values())
    assert "bigrect_ridge" in STUDY.tables(summary) and "in 0 of 2 cases" in STUDY.answer(summary)


def test_pressure_shows_in_a_push_that_slips_and_not_in_one_that_is_stable() -> None:
    shape = published_shape([Path("bigrect/log.txt")])
    n = len(shape.cells)
    spans = []
    for mu, spin in ((1.0, 0.05), (0.05, 0.6)):
        path = arc(np.zeros(3), spin)
        poses = PoseTrack(path.time[[0, -1]], np.zeros((2, 3)), np.tile(1e-6 * np.eye(3), (2, 1, 1)))
        model = ObjectModel(shape, np.full(n, 0.2 / n), np.full(n, 0.3), mu)
        spans.append(pressure_span(model, [PushRecord("1", shape, poses, path)]))
    assert spans[0] < 2e-4 < 1e-3 < spans[1]


def test_stable_pushes_are_made_in_bullet_and_counted() -> None:
    study = EXPERIMENTS["stable-pushes"]
    results = [
        CaseResult(case, study.run(case, settings_of(Path()))) for case in (Case("toolbox", 3, variant) for variant in ("exact", "map"))
    ]
    summary = study.summarise(results)
    for variant in ("exact", "map"):
        row = summary["by_variant"][variant]
        assert row["objects"] == row["goals"] == 1 and 0 <= row["there"] <= row["pushes"] <= 1
    assert "map" in study.tables(summary) and "planned pushes end there" in study.answer(summary)
