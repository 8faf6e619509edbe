"""Real node processes with the arm of a robot file: six joints instead of seven, and its description from a file."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from helpers.robots import robot_path
from push_ident.cli.push import contact_goal
from push_ident.cli.robot import robot_for
from push_ident.cli.supervisor import Supervisor, node_command
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.client.cell_client import CellClient
from push_ident_msgs.action import ExecutePush

pytestmark = pytest.mark.alone


def await_plan(client: CellClient, goal: ExecutePush.Goal) -> None:
    """Wait until the executor can plan a push: it knows arm and object then."""
    goal.dry_run = True
    deadline = time.monotonic() + 60.0
    while (result := client.execute_push(goal)).error_code != ExecutePush.Result.NONE:
        assert time.monotonic() < deadline, result.error_text
        time.sleep(0.2)
    goal.dry_run = False


def test_ur5e_of_its_file_pushes_the_object_in_the_simulated_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "ROS_DOMAIN_ID", str(own_domain()))
    simulated = robot_for("sim", robot_path("ur5e")).parameters(tmp_path, ())["sim_cell_node"]
    executor = robot_for("arm", robot_path("ur5e")).parameters(tmp_path, ())["push_executor_node"]
    quick = {"object": "toolbox", "camera_rate": 0.0, "truth_as_perception": True, "real_time_factor": 0.3, "sensor": "plain"}
    # A slow clock: a pause of the machine is a short one for the arm, which would cut a corner to catch up and push further.
    patient = {"use_sim_time": True, "arm_timeout": 1.0, "tracking_lag": 1.0, "home_posture": [0.4, *executor["home_posture"][1:]]}
    patient |= {"settle": 0.1, "rest": 0.2, "free_speed": 0.5}
    commands = [node_command("sim_cell_node", simulated | quick), node_command("push_executor_node", executor | patient)]
    with Supervisor(commands, log_dir=tmp_path / "log") as supervisor, CellClient(check=supervisor.check) as client:
        object_id = client.wait_for_object()
        goal = contact_goal(np.array([-0.15, 0.0]), 0.0, object_id=object_id, distance=0.04, speed=0.15)
        await_plan(client, goal)
        before = client.poses(object_id)[-1][1]
        result = client.execute_push(goal)
        assert result.error_code == ExecutePush.Result.NONE, result.error_text
        after = client.poses(object_id)[-1][1]
    assert after[0] - before[0] == pytest.approx(0.04, abs=5e-3)
