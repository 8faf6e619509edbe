"""A path followed in the live simulated cell: real nodes, Bullet's arm, and corrections of the tool at the rate of the poses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.domains import own_domain
from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.nodes.client import CellClient

pytestmark = [pytest.mark.alone, pytest.mark.long]

NODES = ("sim_cell_node", "push_executor_node", "identification_node", "goal_pushing_node")
PARAMETERS: dict[str, dict[str, object]] = {
    "sim_cell_node": {"object": "book", "seed": 3, "camera_rate": 0.0, "truth_as_perception": True},
    "push_executor_node": {"hand": "none"},
}
CLI = [sys.executable, "-c", "from push_ident.cli.main import main; main()"]


def test_object_is_pushed_along_a_line_in_the_live_simulated_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "ROS_DOMAIN_ID", str(own_domain()))
    line = tmp_path / "line.csv"
    line.write_text("# x, y, yaw\n-0.05, 0.0, 0.0\n0.07, 0.0, 0.0\n")
    commands = [c for c in node_commands("sim", parameters=PARAMETERS, log_level="warn") if c.name in NODES]
    with Supervisor(commands) as supervisor, CellClient(check=supervisor.check) as client:
        client.wait_for_object()
        options = ["push-to", "--path", line, "--explore", 2, "--json", tmp_path / "path.json", "--time-limit", 250]
        done = subprocess.run([*CLI, *map(str, options)], capture_output=True, text=True, timeout=320.0)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    content = json.loads((tmp_path / "path.json").read_text())
    assert content["reached"] and content["kind"] == "path" and content["done"] == 1.0
    # Two to explore, and few contacts: one holds the object for most of the way, where straight pushes need some seven.
    assert content["n_corrections"] > 20 and content["n_pushes"] <= 8
    # The exploring pushes leave it some 50 mm beside the line, and the root mean square holds the way back to it.
    assert content["rms_position_m"] < 0.03
