"""Commands on bags that cannot be right: of pushes that nothing explains, and of poses that no push can have made."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.commands import run_here
from helpers.diagnosis import simulated_pushes
from push_ident.bags.records import write_records
from push_ident.fleet.job import FleetOptions, identify_bag
from push_ident.offline.loading import load_pushes
from push_ident.types import PushRecord

Pushes = list[PushRecord]


@pytest.fixture(scope="module")
def pushes() -> Pushes:
    return simulated_pushes(4, 3)


def written(path: Path, records: Pushes) -> Path:
    write_records(path, records)
    return path


@pytest.fixture(scope="module")
def wide_pusher(tmp_path_factory: pytest.TempPathFactory, pushes: Pushes) -> Path:
    """A bag whose pusher is five times as wide as the one that pushed."""
    wide = [replace(push, pusher=replace(push.pusher, radius=0.04)) for push in pushes[:2]]
    return written(tmp_path_factory.mktemp("wide") / "bag", wide)


def test_fit_that_explains_nothing_exits_with_a_sentence_and_marked_results(wide_pusher: Path, tmp_path: Path) -> None:
    done = run_here("identify", wide_pusher, "--json", tmp_path / "r.json", "--out", tmp_path / "out")
    assert done.returncode == 1
    assert all(word in done.stderr for word in ("rests", "inside the object", "Likely causes", "radius"))
    content = json.loads((tmp_path / "r.json").read_text())
    assert content["status"] == "unexplained"
    assert any("Likely causes" in note for note in content["notes"])
    assert len(set(content["map"]["friction"])) == 1  # the prior
    assert "does not explain its own training pushes" in (tmp_path / "out" / "report.html").read_text()
    assert json.loads((tmp_path / "out" / "model.json").read_text())["status"] == "unexplained"
    assert "the model is only the prior" in run_here("predict", tmp_path / "out" / "model.json", wide_pusher).stderr


def test_diagnosis_of_impossible_contacts_is_not_trustworthy_and_the_bag_of_a_fleet_has_failed(wide_pusher: Path, tmp_path: Path) -> None:
    run_here("diagnose", wide_pusher, "--json", tmp_path / "d.json")
    assert json.loads((tmp_path / "d.json").read_text())["verdict"] == "not_trustworthy"
    outcome = identify_bag(wide_pusher, FleetOptions(pages=False))
    assert outcome["state"] == "failed" and "Likely causes" in outcome["error"]
    assert outcome["result"]["status"] == "unexplained"


def displaced(record: PushRecord, by: list[float], frames: int | None = None) -> PushRecord:
    """So many of its poses from the middle on, or all of them."""
    pose, middle = record.poses.pose.copy(), len(record.poses.time) // 2
    pose[middle:][:frames] += by
    return replace(record, poses=replace(record.poses, pose=pose))


def test_excursion_and_push_that_jumps_are_left_out_and_named(tmp_path: Path, pushes: Pushes) -> None:
    """The map is then that without them: `identification/test_possible_poses.py`."""
    excursion, jump = displaced(pushes[1], [0.05, 0.0, 0.0], 12), displaced(pushes[3], [0.0, 0.0, np.pi])
    bag = written(tmp_path / "bag", [pushes[0], excursion, pushes[2], jump])
    done = run_here("identify", bag, "--json", tmp_path / "r.json")
    content = json.loads((tmp_path / "r.json").read_text())
    (note,) = (note for note in content["notes"] if "bag push 4" in note)
    assert done.returncode == 0 and "no push can have made its poses" in note and "bag push 4" in done.stderr
    assert any("bag push 2: 12 of" in note for note in content["notes"]) and len(content["train"]["pushes"]) == 3
    loaded = load_pushes([bag], possible_with=FleetOptions().prior)  # as a fleet does
    assert [len(load_pushes([bag])), len(loaded)] == [4, 3] and note in loaded.notes


def test_bag_whose_pushes_are_mostly_impossible_keeps_them_for_the_fit_to_judge(tmp_path: Path, pushes: Pushes) -> None:
    """Then frames, units or clocks are wrong, which the fit explains."""
    bag = written(tmp_path / "bag", [displaced(push, [0.15, 0.2, 0.0]) for push in pushes])
    loaded = load_pushes([bag], possible_with=FleetOptions().prior)
    assert len(loaded) == 4 and any("4 of 4 pushes are impossible" in note and "frames, units and clocks" in note for note in loaded.notes)
