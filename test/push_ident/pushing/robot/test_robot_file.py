"""Robot files: what is read, what is refused, and the description that is made of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.robots import NAMES, changed, robot_path
from push_ident.errors import InputError
from push_ident.geometry.arm_shape import ArmShape
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.robot.description import cell_description, read_urdf
from push_ident.pushing.robot.node_parameters import node_parameters
from push_ident.pushing.robot.robot_file import motion_settings, read_robot

URDF = """<?xml version="1.0"?>
<robot name="two_axes">
  <link name="base"/>
  <link name="upper"><collision><geometry><mesh filename="package://two_axes/meshes/upper.stl"/></geometry></collision></link>
  <link name="lower"/>
  <joint name="first" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit effort="1" velocity="2" drake:acceleration="3"/></joint>
  <joint name="second" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.3 0 0.5"/><axis xyz="0 1 0"/>
    <limit effort="1" velocity="2" lower="-1" upper="1"/></joint>
  <drake:joint name="first"/>
</robot>
"""


def two_axes(folder: Path, urdf: str = URDF, **joints: Any) -> Path:
    """A robot of two joints whose first one turns without end."""
    (folder / "two_axes" / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "two_axes" / "meshes" / "upper.stl").write_text("")
    (folder / "two_axes" / "arm.urdf").write_text(urdf)

    def change(content: dict[str, Any]) -> None:
        content["description"] = {"file": "two_axes/arm.urdf", "root": "base"}
        content["joints"] = {"names": ["first", "second"], "neutral": [0.0, 0.1], "home": [1.0, 0.0], "acceleration": [3.0], **joints}
        content["tool"]["link"] = "lower"

    return changed(folder, change)


@pytest.mark.parametrize("name", NAMES)
def test_tip_of_the_description_is_where_the_file_places_it(name: str) -> None:
    robot = read_robot(robot_path(name))
    file = robot.file
    description = cell_description(robot, read_urdf(robot))
    arm, carrier = (ArmKinematics(description, link, file.joints.neutral) for link in ("tool_tip", file.tool.link))
    assert arm.root_frame == "table" and arm.joint_names == tuple(file.joints.names)
    for posture in (file.joints.neutral, file.joints.home):
        expected = carrier.forward(posture) @ [*file.tool.tip_position, 1.0]
        np.testing.assert_allclose(arm.forward(posture)[:3, 3], expected[:3], atol=1e-12)
    if file.joints.lower is not None:
        np.testing.assert_allclose(arm.position_lower, file.joints.lower)
    np.testing.assert_allclose(arm.velocity_limit, file.joints.velocity)
    # What masks the arm in the images reads the same text, and has the pusher in it.
    rods = ArmShape(description).at(dict(zip(file.joints.names, file.joints.neutral, strict=True)))
    tip = arm.forward(file.joints.neutral)[:3, 3]
    assert min(float(np.linalg.norm(rod.end - tip)) for rod in rods) < 1e-9


def test_nodes_get_one_value_from_one_place(tmp_path: Path) -> None:
    robot = read_robot(changed(tmp_path, lambda c: c["parameters"]["push_executor_node"].update(acceleration=1.0)))
    nodes = node_parameters(robot, tmp_path / "robot.urdf")
    assert nodes["perception_node"]["robot_description_file"] == nodes["push_executor_node"]["robot_description_file"]
    assert nodes["perception_node"]["camera_position"] == nodes["bag_recorder_node"]["camera_position"] == [0.55, 0.0, 0.85]
    assert nodes["perception_node"]["tool_reach"] == [0.012, 0.132]
    assert nodes["push_executor_node"]["workspace"] == nodes["goal_pushing_node"]["workspace"]
    assert len(nodes["push_executor_node"]["home_posture"]) == 6 and nodes["push_executor_node"]["acceleration"] == 1.0
    assert motion_settings(robot).acceleration == 1.0


def test_joint_that_turns_without_end_gets_the_limits_of_the_file_and_foreign_prefixes_are_left_out(tmp_path: Path) -> None:
    robot = read_robot(two_axes(tmp_path, lower=[-2.0, -1.0], upper=[2.0, 0.9]))
    urdf = read_urdf(robot)
    assert not [element.tag for element in urdf.root.iter() if ":" in element.tag]
    assert next(urdf.root.iter("mesh")).get("filename") == str(tmp_path / "two_axes" / "meshes" / "upper.stl")
    arm = ArmKinematics(cell_description(robot, urdf), "tool_tip", robot.file.joints.neutral)
    np.testing.assert_allclose(arm.position_lower, [-2.0, -1.0])
    np.testing.assert_allclose(arm.position_upper, [2.0, 0.9])


def test_description_that_is_no_urdf_or_not_there_is_refused(tmp_path: Path) -> None:
    entities = URDF.replace("<robot", '<!DOCTYPE robot [<!ENTITY a "b">]><robot', 1)
    for text, why in ((entities, "declares entities"), ("<robot", "cannot be read"), ("<world/>", "no element `robot`")):
        with pytest.raises(InputError, match=why):
            read_urdf(read_robot(two_axes(tmp_path, text)))
    for package, why in (
        ({}, "no file"),
        ({"package": "no_such_package"}, "which is not installed"),
        ({"package": "push_ident"}, "which the package push_ident does not have"),
    ):
        description = {"file": "ur5e.urdf", "root": "base_link", **package}
        with pytest.raises(InputError, match=why):
            read_urdf(read_robot(changed(tmp_path, lambda c, described=description: c.update(description=described))))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda c: c.pop("tool"), "tool is missing"),
        (lambda c: c["camera"].update(focal=1.0), "camera.focal is no key"),
        (lambda c: c["joints"].update(home=[0.0] * 7), "joints.home has 7 numbers, expected 6"),
        (lambda c: c["joints"].update(acceleration=[1.0, 2.0]), "joints.acceleration has 2 numbers, expected 6"),
        (lambda c: c["joints"].update(names=["elbow_joint"] * 6), "a name twice"),
        (lambda c: c["tool"].update(pusher_radius=-0.01), "tool.pusher_radius is -0.01"),
        (lambda c: c["camera"].update(quaternion=[1.0, 1.0, 0.0, 0.0]), "unit quaternion"),
        (lambda c: c.update(push_height=0.2), "heights must rise"),
        (lambda c: c.update(workspace=[0.1, -0.1, 0.0, 0.1]), "x_min < x_max"),
        (lambda c: c["parameters"].update(push_executor_node={"clearance": "3 cm"}), "expected numbers"),
        (lambda c: c["parameters"].update(push_executor_node={"pusher_radius": 0.02}), "is given by the robot file elsewhere"),
    ],
)
def test_file_with_a_mistake_is_refused_in_one_line(tmp_path: Path, change: Callable[[dict[str, Any]], object], why: str) -> None:
    path = changed(tmp_path, change)
    with pytest.raises(InputError) as refused:
        node_parameters(read_robot(path), tmp_path / "robot.urdf")
    text = str(refused.value)
    assert why in text and str(path) in text and "\n" not in text
    for content in ("a: [", "- 1\n", ""):
        path.write_text(content)
        with pytest.raises(InputError):
            read_robot(path)
