"""Experiment goals: what scripts read of it, and that a known object is brought to its goal."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from push_ident.cli.main import app
from push_ident_sim.studies.goals.run import LEVELS


def test_result_has_what_scripts_read(tmp_path: Path) -> None:
    file = tmp_path / "goals.json"
    arguments = ["experiment", "goals", "--objects", "1", "--goals", "1", "--seed", "11", "--jobs", "1", "--variants", "truth"]
    run = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "out"), "--json", str(file)])
    assert run.exit_code == 0, run.output
    result = json.loads(file.read_text(encoding="utf-8"))
    assert set(result["success"]["truth"]) == set(LEVELS) == {"20mm_0.1rad", "10mm_5deg", "5mm_2deg"}
    assert result["success"]["truth"] == dict.fromkeys(LEVELS, 1.0)
    assert 0 <= result["pushes_mean"] <= 6 and result["time_mean_s"] >= 0 and result["falls"] == 0
    assert (result["models"], result["goals"], result["seed"]) == (1, 1, 11)
    assert result["summary"]["goals"] == {"truth": 1}


def test_number_of_goals_is_checked(tmp_path: Path) -> None:
    run = CliRunner().invoke(app, ["experiment", "goals", "--objects", "1", "--goals", "0", "--out", str(tmp_path)])
    assert run.exit_code != 0 and "goals" in run.output
