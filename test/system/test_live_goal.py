"""The whole suite as processes: an unknown object in front of a simulated camera is pushed until it is at a goal."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.alone, pytest.mark.long]  # quicker: test_live_edge.py, test_live.py and test_goal_pushing.py have its parts

CLI = [sys.executable, "-c", "from push_ident.cli.main import main; main()"]


def run(*args: object, timeout: float) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*CLI, *map(str, args)], capture_output=True, text=True, timeout=timeout)


def test_unknown_object_is_pushed_to_a_goal_in_the_live_simulated_cell(tmp_path: Path) -> None:
    goal = "0.04,0.05,0.4"
    done = run("demo", "--goal", goal, "--n-train", 1, "--out", tmp_path, "--json", tmp_path / "goal.json", timeout=400.0)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    content = json.loads((tmp_path / "goal.json").read_text())
    assert content["reached"] and content["code"] == "SUCCESS"
    assert content["position_error_m"] < 0.02 and content["yaw_error_rad"] < 0.1
    pushes = content["pushes"]
    assert 1 <= len(pushes) == content["n_pushes"]
    # One line for each push, and the push that arrived was predicted to.
    assert all(f"push {push['number']}: " in done.stdout for push in pushes)
    assert pushes[-1]["expected"] is not None and pushes[-1]["chance"] > 0.2
    folder = next(path for path in tmp_path.iterdir() if path.is_dir())
    files = {"bag", "model.json", "report.html", "result.json", "log"}
    assert files <= {path.name for path in folder.iterdir()}


def test_command_without_a_cell_says_what_is_missing() -> None:
    done = run("push-to", "--x", 0.0, "--y", 0.0, "--yaw", 0.0, timeout=60.0)
    assert done.returncode == 1
    assert "push_to_goal is not served" in done.stderr and "goal_pushing_node" in done.stderr
