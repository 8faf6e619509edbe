"""`--robot FILE` of `up` and `doctor`: what is written, what the nodes get, what a running cell shows, and the exit status."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, JointState
from trajectory_msgs.msg import JointTrajectory

from helpers.commands import check_refused, run_here
from helpers.robots import changed, robot_path
from helpers.spinning import spinning
from push_ident.cli.overrides import overrides_of
from push_ident.cli.robot import robot_for
from push_ident.cli.robot_doctor import check_parameters, find_live
from push_ident.cli.supervisor import node_commands, node_names
from push_ident.nodes.base.network import own_domain
from push_ident.pushing.robot.checks import Finding, Level
from push_ident.pushing.robot.robot_file import Robot, read_robot

COARSE = ("--spacing", 0.4, "--seconds", 0.5)


class Driver(Node):
    """Driver of an arm and of a camera, with the names of the UR5e's file."""

    def __init__(self, context: Context) -> None:
        super().__init__("driver", context=context)
        file = read_robot(robot_path("ur5e")).file
        self.joints = JointState(name=["finger_joint", *reversed(file.joints.names)], position=[0.0, *reversed(file.joints.home)])
        self.frame = file.camera.frame
        self._states = self.create_publisher(JointState, "joint_states", 10)
        self._images = self.create_publisher(Image, file.topics["depth/image_rect"], qos_profile_sensor_data)
        self._infos = self.create_publisher(CameraInfo, file.topics["depth/camera_info"], qos_profile_sensor_data)
        self.create_subscription(JointTrajectory, file.topics["joint_trajectory"], lambda msg: None, 10)
        self.create_timer(0.05, self._tick)

    def _tick(self) -> None:
        self._states.publish(self.joints)
        image = Image(height=8, width=16, encoding="16UC1", step=32, data=[0xE8, 0x03] * 128)
        info = CameraInfo(height=8, width=16, k=[8.5, 0.0, 7.5, 0.0, 7.2, 3.5, 0.0, 0.0, 1.0])
        image.header.frame_id = info.header.frame_id = self.frame
        image.header.stamp = info.header.stamp = self.get_clock().now().to_msg()
        self._infos.publish(info)
        self._images.publish(image)


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number := own_domain()))
    return number


def test_right_file_ends_well_says_that_no_cell_runs_and_leaves_picture_and_files_for_the_nodes(domain: int, tmp_path: Path) -> None:
    done = run_here("doctor", "--robot", robot_path("ur5e"), *COARSE, "--out", tmp_path / "out", "--json", tmp_path / "found.json")
    assert done.returncode == 0, done.stdout + done.stderr
    content = json.loads((tmp_path / "found.json").read_text())
    assert content["reach"]["along_x"] == [[0, 0], [0, 0]] and content["robot"] == "ur5e"
    unchecked = [finding for finding in content["findings"] if finding["level"] == "not checked"]
    assert [finding["about"] for finding in unchecked] == ["arm", "camera"] and "nothing publishes on" in unchecked[0]["what"]
    assert "along x: 100 %" in (tmp_path / "out" / "reach.html").read_text(encoding="utf-8")
    parameters = tmp_path / "out" / "parameters.yaml"
    overrides_of([parameters], (), node_names("arm"))  # `up --params` takes it
    (executor,) = (node for name, node in yaml.safe_load(parameters.read_text()).items() if name.endswith("push_executor_node"))
    values = executor["ros__parameters"]
    assert values["home_posture"] == [1.3, -1.58, 1.754, -1.745, -1.5708, 0.0]
    assert values["robot_description_file"] == str(tmp_path / "out" / "robot.urdf")


def test_wrong_file_ends_with_status_1_and_all_that_is_wrong_and_that_the_nodes_would_refuse(domain: int, tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content["joints"]["home"][1] = 0.5
        content["joints"]["velocity"][0] = 9.0
        content["tool"]["pusher_height"] = 0.7
        content["parameters"]["push_executor_node"] = {"push_sped": 0.1, "free_speed": 1}

    file = changed(tmp_path, change)
    done = run_here("doctor", "--robot", file, *COARSE, "--json", tmp_path / "found.json")
    assert done.returncode == 1
    findings = json.loads((tmp_path / "found.json").read_text())["findings"]
    wrong = [finding["what"] for finding in findings if finding["level"] == "wrong" and finding["about"] == "limits"]
    assert len(wrong) == 2 and "joints.velocity of shoulder_pan_joint" in wrong[0] and "joints.home has shoulder_lift_joint" in wrong[1]
    assert any(finding["about"] == "reach" and finding["level"] == "not checked" for finding in findings)
    texts = [finding.text for finding in check_parameters(read_robot(file))]
    assert len(texts) == 3, texts
    assert any("push_executor_node.pusher_height is 0.7" in text and "expected 0.001 to 0.5" in text for text in texts)
    assert any("no parameter push_sped; did you mean push_speed?" in text for text in texts)
    assert any("free_speed is 1" in text and "expected float, write 1.0" in text for text in texts)


def test_command_that_cannot_be_meant_is_told_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for command, reason in (
        (("doctor", "--robot", "nothing.yaml"), "cannot be read"),
        (("doctor", "--out", "out"), "give --robot FILE"),
        (("up", "replay", "bag", "--robot", robot_path("ur5e")), "a replay has none"),
        (
            ("up", "arm", "--robot", changed(tmp_path, lambda c: c["parameters"].update(push_executer_node={}))),
            "the node push_executer_node",
        ),
    ):
        check_refused(reason, *command)


def test_nodes_of_a_real_cell_get_description_postures_and_topics_and_the_simulated_one_the_file(tmp_path: Path) -> None:
    real, simulated = robot_for("arm", robot_path("ur5e")), robot_for("sim", robot_path("ur5e"))
    assert "depth/image_rect:=/camera/camera/depth/image_rect_raw" in real.remaps and simulated.remaps == ()
    values = real.parameters(tmp_path, ())
    assert values["push_executor_node"]["robot_description_file"] == str(tmp_path / "robot.urdf")
    assert '<link name="tool_tip"' in (tmp_path / "robot.urdf").read_text()
    commands = {command.name: command.argv for command in node_commands("sim", parameters=simulated.parameters(tmp_path, ()))}
    assert f'robot:="{robot_path("ur5e")}"' in commands["sim_cell_node"]
    assert "home_posture:=[1.3, -1.58, 1.754, -1.745, -1.5708, 0.0]" in commands["push_executor_node"]
    assert not any("robot_description_file" in word for word in commands["push_executor_node"])
    # The hand of the real cell is not asked for in the simulated one, whose hand is rigid.
    path = changed(tmp_path, lambda c: c["tool"].update(hand="robotiq_3f"))
    hands = {kind: robot_for(kind, path).parameters(tmp_path, ())["push_executor_node"]["hand"] for kind in ("arm", "sim")}
    assert hands == {"arm": "robotiq_3f", "sim": "none"}


def await_findings(robot: Robot, is_expected: Callable[[list[Finding]], bool]) -> None:
    """Until what is found is the expected, at most a minute: a busy machine may take more than the 2 s of one try to find the driver."""
    deadline = time.monotonic() + 60.0
    while not is_expected(findings := find_live(robot, None, 2.0)):
        assert time.monotonic() < deadline, findings


def are_wrong(findings: list[Finding], *texts: tuple[str, ...]) -> bool:
    """Whether as many findings as `texts` are wrong, and each has all of its texts."""
    wrong = [finding.text for finding in findings if finding.level is Level.WRONG]
    return len(wrong) == len(texts) and all(part in text for text, parts in zip(wrong, texts, strict=True) for part in parts)


def test_running_arm_and_camera_are_compared_with_the_file_and_a_controller_that_does_not_listen_is_wrong(
    domain: int, tmp_path: Path
) -> None:
    robot = read_robot(robot_path("ur5e"))
    deaf = read_robot(changed(tmp_path, lambda c: c["topics"].update(joint_trajectory="/another/joint_trajectory")))
    with spinning(Driver, domain) as driver:
        well = {("arm", Level.OK), ("camera", Level.OK)}
        await_findings(robot, lambda findings: {(finding.about, finding.level) for finding in findings} == well)
        await_findings(deaf, lambda findings: are_wrong(findings, ("nobody listens to /another/joint_trajectory",)))
        driver.joints = JointState(name=driver.joints.name, position=[math.nan] * len(driver.joints.name))
        await_findings(robot, lambda findings: are_wrong(findings, ("the driver has no data of the arm yet", "shoulder_pan_joint")))
        driver.joints = JointState(name=["A1", "A2"], position=[0.0, 0.0])
        driver.frame = "camera_link"
        joints = ("no joint shoulder_pan_joint", "it has A1, A2")
        frame = ("its images are in the frame camera_link; expected camera.frame, camera_depth_optical_frame",)
        await_findings(robot, lambda findings: are_wrong(findings, joints, frame))
        driver.frame = ""
        await_findings(robot, lambda findings: any("its images have no frame_id" in finding.text for finding in findings))
