"""Node processes of the simulated cell with a table that ends: an object is pushed out over its edge, and held there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.client.cell_client import CellClient

pytestmark = [
    pytest.mark.alone,
    pytest.mark.long,
]  # quicker: test_goal_session.py, test_goal_pushing.py and test_push_collector.py have its parts

CLI = [sys.executable, "-c", "from push_ident.cli.main import main; main()"]
END = 0.10
"""Where the table ends [m]."""
CELL = {
    "object": "toolbox",
    "seed": 1,
    "table": [-0.8, END, -0.7, 0.7],
    "start_pose": [0.0, 0.0, 0.0],
    "camera_rate": 0.0,
    "truth_as_perception": True,
}


def test_object_is_pushed_out_over_the_edge_and_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "ROS_DOMAIN_ID", str(own_domain()))
    unused = ("perception_node", "gap_diagnosis_node")
    commands = [command for command in node_commands("sim", parameters={"sim_cell_node": CELL}) if command.name not in unused]
    with Supervisor(commands, log_dir=tmp_path / "log") as supervisor, CellClient(check=supervisor.check) as client:
        object_id = client.wait_for_object()
        options = ["--edge", "--explore", "1", "--overhang-mm", "30", "--time-limit", "200", "--out", str(tmp_path / "out")]
        done = subprocess.run([*CLI, "push-to", *options], capture_output=True, text=True, timeout=240.0)
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
        left_out = "no push over the edge was left out"
        client.wait(lambda: client.values_of("identification").get("pushes refused", "0") != "0", 150.0, left_out)
        outline, pose = client.shape(object_id).outline, client.poses(object_id)[-1][1]
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert content["code"] == "SUCCESS" and content["object_id"] == object_id
    # Whatever the nodes say: it overhangs, and a cell that has lost its object would publish no pose.
    over = float(transform_points(pose, outline)[:, 0].max()) - END
    assert 0.01 < over < 0.05 and over == pytest.approx(content["overhang_m"], abs=0.003)
    assert content["margin_m"] > 0.01 and all(push["risk"] is None or push["risk"] <= 0.01 for push in content["pushes"])
    assert content["pushes"][-1]["expected"] is not None and content["edge"] == pytest.approx(np.array([[END, -0.7], [END, 0.7]]), abs=1e-6)
    assert "edge of the table" in (tmp_path / "out" / "report.html").read_text()
