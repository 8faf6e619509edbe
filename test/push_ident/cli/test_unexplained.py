"""Commands on bags whose pushes cannot be explained: a sentence, an exit status, and results that are marked."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes
from push_ident.bags.records import write_records
from push_ident.cli.main import main
from push_ident.fleet.job import FleetOptions, identify_bag
from push_ident.types import ObjectShape, PushRecord

RECORDS = simulated_pushes(4, 3)


def run(*args: object) -> tuple[int, str]:
    """Exit status and standard error of one command."""
    error, code = io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()), redirect_stderr(error):
        patch.setattr(sys, "argv", ["push-ident", *map(str, args)])
        try:
            main()
        except SystemExit as ended:
            code = int(ended.code or 0)
    return code, error.getvalue()


def written(path: Path, records: list[PushRecord]) -> Path:
    write_records(path, records)
    return path


def with_outline(change: Callable[[np.ndarray], np.ndarray]) -> list[PushRecord]:
    return [replace(r, shape=ObjectShape(r.shape.cells, change(r.shape.outline))) for r in RECORDS]


def crossed(outline: np.ndarray) -> np.ndarray:
    order = np.arange(len(outline))
    order[[1, len(outline) // 2]] = order[[len(outline) // 2, 1]]
    return outline[order]


@pytest.fixture(scope="module")
def wide_pusher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag whose pusher is five times as wide as the one that pushed."""
    records = [replace(record, pusher=replace(record.pusher, radius=0.04)) for record in RECORDS]
    return written(tmp_path_factory.mktemp("wide") / "bag", records)


@pytest.mark.parametrize(
    ("change", "reason"),
    [(lambda o: 2.0 * o, "cells"), (lambda o: 0.5 * o, "cell"), (crossed, "crosses itself"), (lambda o: 1e3 * o, "expected at most")],
    ids=["twice", "half", "crossed", "millimetres"],
)
@pytest.mark.parametrize("command", ["identify", "diagnose", "replay"])
def test_outline_that_cannot_be_is_refused_at_reading(tmp_path: Path, command: str, change: Callable, reason: str) -> None:  # type: ignore[type-arg]
    code, error = run(command, written(tmp_path / "bag", with_outline(change)))
    assert code == 1
    assert reason in error and "Traceback" not in error


def test_radius_that_cannot_be_is_refused_at_reading(tmp_path: Path) -> None:
    records = [replace(record, pusher=replace(record.pusher, radius=8.0)) for record in RECORDS]
    code, error = run("identify", written(tmp_path / "bag", records))
    assert code == 1 and "radius of a pusher is 8" in error


def test_fit_that_explains_nothing_exits_with_a_sentence_and_marked_results(wide_pusher: Path, tmp_path: Path) -> None:
    code, error = run("identify", wide_pusher, "--json", tmp_path / "r.json", "--out", tmp_path / "out")
    assert code == 1
    assert "rests" in error and "inside the object" in error and "Likely causes" in error and "radius" in error
    content = json.loads((tmp_path / "r.json").read_text())
    assert content["status"] == "unexplained"
    assert any("Likely causes" in note for note in content["notes"])
    assert len(set(content["map"]["friction"])) == 1  # the prior
    assert "does not explain its own training pushes" in (tmp_path / "out" / "report.html").read_text()
    assert json.loads((tmp_path / "out" / "model.json").read_text())["status"] == "unexplained"
    _, warned = run("predict", tmp_path / "out" / "model.json", wide_pusher)
    assert "the model is only the prior" in warned


def test_diagnosis_of_impossible_contacts_is_not_trustworthy(wide_pusher: Path, tmp_path: Path) -> None:
    run("diagnose", wide_pusher, "--json", tmp_path / "d.json")
    assert json.loads((tmp_path / "d.json").read_text())["verdict"] == "not_trustworthy"


def test_bag_of_a_fleet_that_is_not_explained_has_failed_with_its_reason(wide_pusher: Path) -> None:
    outcome = identify_bag(wide_pusher, FleetOptions())
    assert outcome["state"] == "failed" and "Likely causes" in outcome["error"]
    assert outcome["result"]["status"] == "unexplained"
