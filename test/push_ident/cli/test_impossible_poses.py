"""Bags with poses that no push can have made: named, left out by `identify` and a fleet, kept for a diagnosis."""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes
from push_ident.bags.records import write_records
from push_ident.cli.main import main
from push_ident.fleet.job import FleetOptions, identify_bag
from push_ident.offline.loading import load_pushes
from push_ident.types import PushRecord

RECORDS = simulated_pushes(4, 3)


def identified(bag: Path, out: Path, records: list[PushRecord]) -> tuple[dict[str, Any], str]:
    """JSON and standard error of `push-ident identify` for a new bag."""
    write_records(bag, records)
    error = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()), redirect_stderr(error):
        patch.setattr(sys, "argv", ["push-ident", "identify", str(bag), "--json", str(out)])
        with pytest.raises(SystemExit, match="0"):
            main()
    return json.loads(out.read_text()), error.getvalue()


def displaced(record: PushRecord, frames: slice, by: list[float]) -> PushRecord:
    pose = record.poses.pose.copy()
    pose[frames] += by
    return replace(record, poses=replace(record.poses, pose=pose))


@pytest.mark.parametrize("by", [[0.15, 0.2, 0.0], [0.0, 0.0, np.pi]], ids=["25 cm aside", "half a turn"])
def test_map_is_that_of_the_bag_without_the_push_that_jumps(tmp_path: Path, by: list[float]) -> None:
    middle = len(RECORDS[3].poses.time) // 2
    bag = tmp_path / "bag"
    jumping, error = identified(bag, tmp_path / "jumping.json", [*RECORDS[:3], displaced(RECORDS[3], slice(middle, None), by)])
    without, _ = identified(tmp_path / "without", tmp_path / "without.json", RECORDS[:3])
    (note,) = (note for note in jumping["notes"] if "bag push 4" in note)
    assert "no push can have made its poses" in note and "bag push 4" in error
    assert jumping["map"] == without["map"]
    outcome = identify_bag(bag, FleetOptions())
    assert outcome["state"] == "done" and note in outcome["result"]["notes"]
    assert [len(load_pushes([bag]).records), len(load_pushes([bag], possible_with=FleetOptions().prior).records)] == [4, 3]


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
