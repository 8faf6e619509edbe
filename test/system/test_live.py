"""Real node processes over real DDS: bags that are played, the demo, and pushes in simulated cells."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.bags import copy_renamed
from helpers.commands import run_here
from helpers.objects import hammer, random_records
from helpers.paths import ROOT
from helpers.robots import robot_path
from push_ident.bags.pushes import count_pushes
from push_ident.bags.reader import read_bag
from push_ident.bags.records import write_records
from push_ident.cli.push import contact_goal
from push_ident.cli.robot import robot_for
from push_ident.cli.supervisor import Supervisor, node_command, node_commands
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.client.cell_client import CellClient
from push_ident_msgs.action import ExecutePush

CLI = [sys.executable, "-c", "from push_ident.cli.main import main; main()"]
FILES = {"bag", "model.json", "report.html", "result.json", "log"}
"""Of a demo."""


def run(*args: object, timeout: float = 300.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*CLI, *map(str, args)], capture_output=True, text=True, timeout=timeout)


def succeeded(*args: object, timeout: float = 300.0) -> str:
    """What a command prints that ends well."""
    done = run(*args, timeout=timeout)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "ROS_DOMAIN_ID", str(own_domain()))


@pytest.mark.live
def test_no_image_of_a_bag_is_lost_however_fast_it_is_played_and_the_map_is_that_found_offline(tmp_path: Path) -> None:
    said = succeeded("replay", ROOT / "bags" / "hammer_depth", "--rate", 0, "--json", tmp_path / "live.json")
    shares = [int(share) for share in re.findall(r"^played (\d+) %$", said, re.MULTILINE)]
    assert shares and shares == sorted(set(shares)) and shares[-1] <= 100, said
    live = json.loads((tmp_path / "live.json").read_text())
    assert live["n_pushes"] == 4 and live["counts"]["pushes"] == "4"
    offline = json.loads((Path(__file__).parent / "baseline" / "identify-hammer_depth.json").read_text())["content"]
    products = [np.array(x["map"]["mass_friction"]) for x in (live, offline)]
    products = [p / p.sum() for p in products]
    deviation = np.array(offline["map"]["mass_friction_std"]) / np.sum(offline["map"]["mass_friction"])
    # The same data, warm-started push by push: well within the uncertainty of the fit, in most cells far within it.
    differences = np.abs(products[0] - products[1]) / deviation
    assert np.max(differences) < 1.0 and np.sqrt(np.mean(differences**2)) < 0.3


@pytest.mark.live
def test_replay_counts_what_was_not_learned(tmp_path: Path) -> None:
    (push,) = random_records(hammer(1), 1, 1)
    away = replace(push.pusher, position=push.pusher.position + 0.4)
    write_records(tmp_path / "bag", [push, replace(push, pusher=away)])
    live = run("replay", tmp_path / "bag", "--rate", 0, "--out", tmp_path / "live")
    assert live.returncode == 1 and "1 of 2 pushes of the bag were learned; 1 without contact" in live.stderr, live.stdout + live.stderr
    assert (tmp_path / "live" / "model.json").exists()


@pytest.mark.live
def test_replay_takes_topics_of_other_names(tmp_path: Path) -> None:
    write_records(tmp_path / "bag", random_records(hammer(1), 2, 1))
    foreign = copy_renamed(tmp_path / "bag", tmp_path / "foreign", {"/objects/1/pose": "/body", "/pusher/pose": "/tool"})
    refused = run("replay", foreign, "--rate", 0)
    assert refused.returncode == 1 and "--map /body=pose:ID, and --map /tool=pusher" in refused.stderr, refused.stderr
    succeeded("replay", foreign, "--rate", 0, "--map", "/body=pose:1", "--map", "/tool=pusher", "--json", tmp_path / "live.json")
    assert json.loads((tmp_path / "live.json").read_text())["n_pushes"] == 2


def test_doctor_names_what_is_missing_when_nothing_runs(tmp_path: Path) -> None:
    assert run_here("doctor", "--seconds", 1, "--json", tmp_path / "doctor.json").returncode == 0
    content = json.loads((tmp_path / "doctor.json").read_text())
    assert content["ros"]["middleware"] == "rmw_fastrtps_cpp"
    assert any("push-ident up sim" in problem for problem in content["problems"])


@pytest.mark.alone
def test_demo_sees_pushes_identifies_and_predicts_in_the_live_simulated_cell(tmp_path: Path) -> None:
    said = succeeded("demo", "--n-train", 1, "--n-test", 1, "--out", tmp_path, "--json", tmp_path / "demo.json")
    content = json.loads((tmp_path / "demo.json").read_text())
    assert len(content["training"]) == 1 and len(content["per_push"]) == 1
    # One push determines little, but the pose, the outline and the prediction must hang together.
    assert content["per_push"][0]["predicted_m"] < 0.02 and content["per_push"][0]["ways"]
    assert "push 2 predicted, expected to" in said
    folder = next(path for path in tmp_path.iterdir() if path.is_dir())
    # Console, numbers, page and bag have one list of pushes and one score.
    assert {path.name for path in folder.iterdir()} >= FILES and count_pushes(read_bag(folder / "bag")) == 2
    page, score = (folder / "report.html").read_text(), [f"{1e3 * content[key]:.1f} mm" for key in ("identified_m", "uniform_m")]
    assert all(error in said for error in score) and "recording of 2 pushes" in said and "The true map beside" in page
    assert "From 2 pushes: " in page
    assert f"predicted from those before to {score[0]}, by equal cells with nominal values to {score[1]}" in page


@pytest.mark.alone
@pytest.mark.long  # quicker: nodes/test_goal_pushing.py
def test_unknown_object_is_pushed_to_a_goal_in_the_live_simulated_cell(tmp_path: Path) -> None:
    out = ("--out", tmp_path, "--json", tmp_path / "goal.json")
    said = succeeded("demo", "--goal", "0.04,0.05,0.4", "--n-train", 1, *out, timeout=400.0)
    content = json.loads((tmp_path / "goal.json").read_text())
    assert content["reached"] and content["position_error_m"] < 0.02 and content["yaw_error_rad"] < 0.1
    pushes = content["pushes"]
    assert 1 <= len(pushes) == content["n_pushes"]
    # One line for each push, and the push that arrived was predicted to.
    assert all(f"push {push['number']}: " in said for push in pushes)
    assert pushes[-1]["expected"] is not None and pushes[-1]["chance"] > 0.2
    folder = next(path for path in tmp_path.iterdir() if path.is_dir())
    assert {path.name for path in folder.iterdir()} >= FILES


END = 0.10
"""Where the table ends [m]."""


@pytest.mark.alone
@pytest.mark.long  # quicker: planning/test_goal_session.py, nodes/test_goal_pushing.py and nodes/test_push_collector.py
def test_object_is_pushed_out_over_the_edge_and_held(tmp_path: Path, domain: None) -> None:
    cell = {"object": "toolbox", "seed": 1, "table": [-0.8, END, -0.7, 0.7], "start_pose": [0.0, 0.0, 0.0]}
    cell |= {"camera_rate": 0.0, "truth_as_perception": True}
    unused = ("perception_node", "gap_diagnosis_node")
    commands = [command for command in node_commands("sim", parameters={"sim_cell_node": cell}) if command.name not in unused]
    with Supervisor(commands, log_dir=tmp_path / "log") as supervisor, CellClient(check=supervisor.check) as client:
        object_id = client.wait_for_object()
        options = ("--edge", "--explore", 1, "--overhang-mm", 30, "--time-limit", 200, "--out", tmp_path / "out")
        succeeded("push-to", *options)
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


@pytest.mark.alone
@pytest.mark.long  # quicker: pushing/robot/test_checks.py and nodes/test_refused_starts.py
def test_ur5e_of_its_file_pushes_the_object_in_the_simulated_cell(tmp_path: Path, domain: None) -> None:
    """Six joints instead of seven."""
    simulated, executor = (robot_for(kind, robot_path("ur5e")).parameters(tmp_path, ()) for kind in ("sim", "arm"))
    quick = {"object": "toolbox", "camera_rate": 0.0, "truth_as_perception": True, "real_time_factor": 0.3, "sensor": "plain"}
    # A slow clock: a pause of the machine is a short one for the arm, which would cut a corner to catch up and push further.
    patient = {"use_sim_time": True, "arm_timeout": 1.0, "tracking_lag": 1.0, "settle": 0.1, "rest": 0.2, "free_speed": 0.5}
    arm = executor["push_executor_node"]
    arm |= patient | {"home_posture": [0.4, *arm["home_posture"][1:]]}
    commands = [node_command("sim_cell_node", simulated["sim_cell_node"] | quick), node_command("push_executor_node", arm)]
    with Supervisor(commands, log_dir=tmp_path / "log") as supervisor, CellClient(check=supervisor.check) as client:
        object_id = client.wait_for_object()
        goal = contact_goal(np.array([-0.15, 0.0]), 0.0, object_id=object_id, distance=0.04, speed=0.15)
        goal.dry_run, deadline = True, time.monotonic() + 60.0
        while (result := client.execute_push(goal)).error_code != ExecutePush.Result.NONE:  # it has to hear of arm and object first
            assert time.monotonic() < deadline, result.error_text
            time.sleep(0.2)
        goal.dry_run, before = False, client.poses(object_id)[-1][1]
        result = client.execute_push(goal)
        assert result.error_code == ExecutePush.Result.NONE, result.error_text
        after = client.poses(object_id)[-1][1]
    assert after[0] - before[0] == pytest.approx(0.04, abs=5e-3)
