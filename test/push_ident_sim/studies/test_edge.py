"""Experiment edge: what scripts read of it, and that a known object is pushed out over the edge and held."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from push_ident.cli.main import app
from push_ident_sim.studies.common.reaching import causes_in_words, failures, mean_of, share
from push_ident_sim.studies.registry import EXPERIMENTS


def test_result_has_what_scripts_read(tmp_path: Path) -> None:
    file = tmp_path / "edge.json"
    arguments = ["experiment", "edge", "--objects", "book", "--models", "1", "--goals", "2", "--seed", "11", "--jobs", "1"]
    run = CliRunner().invoke(app, [*arguments, "--variants", "truth", "--out", str(tmp_path / "out"), "--json", str(file)])
    assert run.exit_code == 0, run.output
    result = json.loads(file.read_text(encoding="utf-8"))
    row = result["summary"]["kinds"]["truth"]
    assert result["falls"] == row["falls"] == 0 and row["success"]["share"] == 1.0 and row["causes"] == {}
    assert row["pushes"] >= 1 and row["least_margin_m"] > 0.0
    pictures = EXPERIMENTS["edge"].draw(result["summary"], tmp_path)
    assert all((tmp_path / name).stat().st_size > 1000 for name in pictures)
    assert "2 of 2" in EXPERIMENTS["edge"].tables(result["summary"])


def test_shares_have_the_exact_interval() -> None:
    # Clopper and Pearson (1934): 9 of 10 lie within 55.5 to 99.7 %; none of 500 below 0.74 %.
    row = share([True] * 9 + [False])
    assert (row["low"], row["high"]) == (0.555, 0.9975)
    assert share([False] * 500)["high"] == 0.0074 and share([])["share"] is None
    assert causes_in_words(failures(["A", "B", "B", "good"], "good")) == "2 B, 1 A"
    assert mean_of([1.0, None, 2.0]) == 1.5 and mean_of([None]) is None
