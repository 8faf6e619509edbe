"""The files for joint_trajectory_controller beside the robot files: read as a controller does, compared with limits of the executor."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node

from helpers.paths import SOURCE
from helpers.robots import NAMES, robot_path
from push_ident.nodes.push_executor.parameters import PARAMETERS
from push_ident.nodes.push_executor.settings import EXECUTOR
from push_ident.pushing.push_request import WatchLimits

FOLDER = SOURCE / "push_ident" / "config" / "ros2_controllers"
DRIVER_NAMES = {"iiwa": ("lbr_iiwa_joint_", "lbr_A"), "ur5e": ("_joint", "_joint"), "franka": ("panda_", "fr3_")}
"""What the example, whose URDF is one of PyPI, has in place of the names of the driver; its comment says so."""
OF_CONTROLLER = {
    "type",
    "joints",
    "command_interfaces",
    "state_interfaces",
    "interpolate_from_desired_state",
    "allow_nonzero_velocity_at_trajectory_end",
    "allow_partial_joints_goal",
    "action_monitor_rate",
    "cmd_timeout",
    "gains",
    "constraints",
}
"""Of the parameters of joint_trajectory_controller (ros2_controllers 4.42, joint_trajectory_controller_parameters.yaml)."""
OF_SCALED = OF_CONTROLLER | {"speed_scaling_interface_name"}
"""And of ur_controllers/ScaledJointTrajectoryController (ur_robot_driver, branch jazzy)."""
OF_CONSTRAINTS = {"goal_time", "stopped_velocity_tolerance", "decelerate_on_cancel"}
OF_JOINTS = {"trajectory", "goal", "max_deceleration_on_cancel"}


def default(name: str) -> Any:
    return next(parameter.default for parameter in PARAMETERS if parameter.name == name)


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def robot(name: str) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load(robot_path(name).read_text())
    return content


@pytest.fixture
def controller(name: str, robot: dict[str, Any]) -> str:
    """Its name, that of the topic of the robot file."""
    return str(robot["topics"]["joint_trajectory"]).split("/")[-2].replace(*DRIVER_NAMES[name])


@pytest.fixture
def parameters(name: str, controller: str) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    return dict(content[f"/**/{controller}"]["ros__parameters"])


def test_joints_are_those_of_the_robot_file_as_the_driver_names_them(name: str, robot: dict[str, Any], parameters: dict[str, Any]) -> None:
    ours, theirs = DRIVER_NAMES[name]
    assert parameters["joints"] == [joint.replace(ours, theirs) for joint in robot["joints"]["names"]]
    assert all(text in robot_path(name).read_text() for text in (theirs, ours))


def test_controller_is_loaded_under_the_name_of_the_topic_and_has_no_parameter_of_another_name(
    name: str, controller: str, parameters: dict[str, Any]
) -> None:
    content = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    manager = content["/**/controller_manager"]["ros__parameters"]
    assert manager[controller]["type"] == parameters["type"] and manager["joint_state_broadcaster"]["type"]
    assert parameters.keys() <= (OF_SCALED if "Scaled" in parameters["type"] else OF_CONTROLLER)
    joints = set(parameters["joints"])
    assert parameters["constraints"].keys() == OF_CONSTRAINTS | joints
    assert all(parameters["constraints"][joint].keys() == OF_JOINTS for joint in joints)
    assert parameters.get("gains", dict.fromkeys(joints)).keys() == joints


def test_a_node_of_that_name_in_any_namespace_gets_them(name: str, controller: str, parameters: dict[str, Any]) -> None:
    context = Context()
    rclpy.init(context=context)
    arguments = ["--ros-args", "--params-file", str(FOLDER / f"{name}.yaml")]
    node = Node(controller, namespace="lbr", context=context, cli_args=arguments, automatically_declare_parameters_from_overrides=True)
    try:
        assert list(node.get_parameter("joints").value) == parameters["joints"]
        for joint in parameters["joints"]:
            assert node.get_parameter(f"constraints.{joint}.trajectory").value == parameters["constraints"][joint]["trajectory"]
    finally:
        node.destroy_node()
        context.try_shutdown()


def test_tolerances_fit_the_limits_that_the_executor_watches(robot: dict[str, Any], parameters: dict[str, Any]) -> None:
    limits, constraints = WatchLimits(), parameters["constraints"]
    acceleration = np.broadcast_to(robot["joints"]["acceleration"], len(parameters["joints"]))
    allowed = limits.start_tolerance + default("max_joint_velocity") * limits.tracking_lag
    for joint, most in zip(parameters["joints"], acceleration, strict=True):
        own = constraints[joint]
        assert limits.start_tolerance < own["trajectory"] <= allowed, "no stricter beside the path, no wider than the largest delay"
        assert 0.0 < own["goal"] <= limits.start_tolerance, "the next motion begins within it"
        assert own["max_deceleration_on_cancel"] == most
    assert 0.0 < constraints["goal_time"] < limits.arrival_timeout, "the controller says first what is wrong"
    assert constraints["stopped_velocity_tolerance"] == EXECUTOR.standing_speed
    assert parameters["cmd_timeout"] == 0.0 and parameters["interpolate_from_desired_state"]
    assert not parameters["allow_nonzero_velocity_at_trajectory_end"]
    assert 1.0 / parameters["action_monitor_rate"] <= limits.period
