"""Commands on bags that cannot be right: of pushes that nothing explains, and of poses that no push can have made."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.commands import run_here
from helpers.diagnosis import simulated_pushes
from push_ident.bags.records import write_records
from push_ident.fleet.job import FleetOptions, identify_bag
from push_ident.offline.loading import load_pushes
from push_ident.types import ObjectShape, PushRecord

RECORDS = simulated_pushes(4, 3)


def written(path: Path, records: list[PushRecord]) -> Path:
    write_records(path, records)
    return path


@pytest.fixture(scope="module")
def wide_pusher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag whose pusher is five times as wide as the one that pushed."""
    records = [replace(record, pusher=replace(record.pusher, radius=0.04)) for record in RECORDS]
    return written(tmp_path_factory.mktemp("wide") / "bag", records)


@pytest.mark.parametrize("command", ["identify", "diagnose", "replay"])
def test_outline_and_radius_that_cannot_be_are_refused_at_reading(tmp_path: Path, command: str) -> None:
    for name, part, reason in (
        ("outline", {"shape": ObjectShape(RECORDS[0].shape.cells, 2.0 * RECORDS[0].shape.outline)}, "cells"),
        ("radius", {"pusher": replace(RECORDS[0].pusher, radius=8.0)}, "radius of a pusher is 8"),
    ):
        done = run_here(command, written(tmp_path / name, [replace(RECORDS[0], **part)]))  # type: ignore[arg-type]
        assert done.returncode == 1 and reason in done.stderr and "Traceback" not in done.stderr


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


def test_diagnosis_of_impossible_contacts_is_not_trustworthy(wide_pusher: Path, tmp_path: Path) -> None:
    run_here("diagnose", wide_pusher, "--json", tmp_path / "d.json")
    assert json.loads((tmp_path / "d.json").read_text())["verdict"] == "not_trustworthy"


def test_bag_of_a_fleet_that_is_not_explained_has_failed_with_its_reason(wide_pusher: Path) -> None:
    outcome = identify_bag(wide_pusher, FleetOptions(pages=False))
    assert outcome["state"] == "failed" and "Likely causes" in outcome["error"]
    assert outcome["result"]["status"] == "unexplained"


def identified(bag: Path, out: Path, records: list[PushRecord]) -> tuple[dict[str, Any], str]:
    """JSON and standard error of `push-ident identify` for a new bag."""
    done = run_here("identify", written(bag, records), "--json", out)
    assert done.returncode == 0
    return json.loads(out.read_text()), done.stderr


def displaced(record: PushRecord, frames: slice, by: list[float]) -> PushRecord:
    pose = record.poses.pose.copy()
    pose[frames] += by
    return replace(record, poses=replace(record.poses, pose=pose))


def test_map_is_that_of_the_bag_without_the_push_that_jumps(tmp_path: Path) -> None:
    middle = len(RECORDS[3].poses.time) // 2
    bag = tmp_path / "bag"
    turned = displaced(RECORDS[3], slice(middle, None), [0.0, 0.0, np.pi])
    jumping, error = identified(bag, tmp_path / "jumping.json", [*RECORDS[:3], turned])
    without, _ = identified(tmp_path / "without", tmp_path / "without.json", RECORDS[:3])
    (note,) = (note for note in jumping["notes"] if "bag push 4" in note)
    assert "no push can have made its poses" in note and "bag push 4" in error
    assert jumping["map"] == without["map"]
    loaded = load_pushes([bag], possible_with=FleetOptions().prior)  # as a fleet does
    assert [len(load_pushes([bag])), len(loaded)] == [4, 3] and note in loaded.notes


def test_excursion_is_named_and_left_out(tmp_path: Path) -> None:
    middle = len(RECORDS[1].poses.time) // 2
    records = [RECORDS[0], displaced(RECORDS[1], slice(middle, middle + 12), [0.05, 0.0, 0.0]), *RECORDS[2:]]
    content, _ = identified(tmp_path / "bag", tmp_path / "result.json", records)
    assert any("bag push 2: 12 of" in note for note in content["notes"]) and len(content["train"]["pushes"]) == 4


def test_bag_whose_pushes_are_mostly_impossible_keeps_them_for_the_fit_to_judge(tmp_path: Path) -> None:
    """Then frames, units or clocks are wrong, which the fit explains."""
    bag = tmp_path / "bag"
    write_records(bag, [displaced(record, slice(len(record.poses.time) // 2, None), [0.15, 0.2, 0.0]) for record in RECORDS])
    loaded = load_pushes([bag], possible_with=FleetOptions().prior)
    assert len(loaded) == 4 and any("4 of 4 pushes are impossible" in note and "frames, units and clocks" in note for note in loaded.notes)
