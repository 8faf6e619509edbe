"""A path followed in the live simulated cell: real nodes, Bullet's arm, and corrections of the tool at the rate of the poses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.client.cell_client import CellClient

pytestmark = [pytest.mark.alone, pytest.mark.long]

NODES = ("sim_cell_node", "push_executor_node", "identification_node", "goal_pushing_node")
PARAMETERS: dict[str, dict[str, object]] = {
    "sim_cell_node": {"object": "book", "seed": 3, "camera_rate": 0.0, "truth_as_perception": True},
    "push_executor_node": {"hand": "none"},
}
LENGTH = 0.08
"""Of the line [m]."""
CLI = [sys.executable, "-c", "from push_ident.cli.main import main; main()"]


def test_object_is_pushed_along_a_line_in_the_live_simulated_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "ROS_DOMAIN_ID", str(own_domain()))
    commands = [c for c in node_commands("sim", parameters=PARAMETERS, log_level="warn") if c.name in NODES]
    with Supervisor(commands) as supervisor, CellClient(check=supervisor.check) as client:
        object_id = client.wait_for_object()
        explored = subprocess.run([*CLI, "push", "--random", "2", "--seed", "1"], capture_output=True, text=True, timeout=120.0)
        assert explored.returncode == 0, explored.stdout + explored.stderr
        client.wait_for_map(object_id, 2, 60.0)
        # From where it lies, in its heading, to the other side of the middle: the error of the way is then that of following.
        x, y, yaw = client.pose_at_rest(object_id, after=-np.inf)
        ahead = -np.copysign(LENGTH, x * np.cos(yaw) + y * np.sin(yaw))
        line = tmp_path / "line.csv"
        line.write_text(f"# x, y, yaw\n{x}, {y}, {yaw}\n{x + ahead * np.cos(yaw)}, {y + ahead * np.sin(yaw)}, {yaw}\n")
        options = ["push-to", "--path", line, "--explore", 0, "--json", tmp_path / "path.json", "--time-limit", 250]
        done = subprocess.run([*CLI, *map(str, options)], capture_output=True, text=True, timeout=320.0)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    content = json.loads((tmp_path / "path.json").read_text())
    assert content["reached"] and content["kind"] == "path" and content["done"] == 1.0
    # One contact or two hold the object for the whole way, where straight pushes need some five; one or two more end at the last pose.
    assert content["n_corrections"] > 20 and content["n_pushes"] <= 4
    assert content["rms_position_m"] < 0.003 and content["rms_yaw_rad"] < np.radians(2.0)
