"""Robot files: what is refused, what their check finds, where an arm can push, and the description that is made of them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.robots import NAMES, changed, endless, robot_path, with_urdf
from push_ident.errors import InputError
from push_ident.geometry.arm_shape import ArmShape
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.robot.checks import Finding, Level, check_reach, check_robot
from push_ident.pushing.robot.description import cell_description, read_urdf
from push_ident.pushing.robot.node_parameters import node_parameters
from push_ident.pushing.robot.reach import Outcome, Reach, find_reach
from push_ident.pushing.robot.reach_page import write_reach_page
from push_ident.pushing.robot.robot_file import Robot, motion_settings, push_settings, read_robot


def reach_of(path: Path, spacing: float) -> tuple[Robot, Reach, list[Finding]]:
    """Where the arm of a file can push, and what the check finds of that."""
    robot = read_robot(path)
    _, kinematics = check_robot(robot)
    assert kinematics is not None
    reach = find_reach(kinematics, motion_settings(robot), push_settings(robot), spacing=spacing)
    return robot, reach, list(check_reach(reach, push_settings(robot).workspace))


@pytest.mark.parametrize("name", NAMES)
def test_examples_are_right_and_reach_all_of_their_workspace(name: str) -> None:
    robot, reach, more = reach_of(robot_path(name), 0.2)
    findings, _ = check_robot(robot)
    assert {finding.about for finding in findings} == {"description", "frames", "joints", "limits", "posture", "camera"}
    assert [finding.text for finding in findings + more if finding.level is not Level.OK] == []
    assert reach.largest == pytest.approx(robot.file.workspace)


def without_the_elbow(content: dict[str, Any]) -> None:
    joints = content["joints"]
    joints |= {name: values[:2] + values[3:] for name, values in joints.items() if len(values) == 6}


@pytest.mark.parametrize(
    ("change", "about", "texts"),
    [
        (lambda c: c["joints"]["names"].__setitem__(2, "elbow"), "joints", ("no joint elbow", "elbow_joint", "correct joints.names")),
        (without_the_elbow, "joints", ("elbow_joint moves between base_link and the tool", "add it")),
        (lambda c: c["joints"]["names"].reverse(), "joints", ("another order", "shoulder_pan_joint, shoulder_lift_joint")),
        (lambda c: c["joints"]["names"].__setitem__(0, "wrist_3-flange"), "joints", ("wrist_3-flange is a fixed joint",)),
        (lambda c: c["tool"].update(link="tool1"), "frames", ("no link tool1", "tool0", "correct it")),
        (lambda c: c["description"].update(root="flange"), "frames", ("description.root is flange", "base_link")),
        (lambda c: c.pop("base"), "frames", ("base is missing",)),
        (lambda c: c["joints"]["upper"].__setitem__(2, 7.0), "limits", ("joints.upper of elbow_joint is 7.0", "3.142", "narrow it")),
        (lambda c: c["joints"]["velocity"].__setitem__(0, 9.0), "limits", ("joints.velocity of shoulder_pan_joint is 9.0", "3.142")),
        (lambda c: c["joints"]["lower"].__setitem__(4, 4.0), "limits", ("wrist_2_joint has limits 4.000 to 3.140 rad",)),
        (lambda c: c["joints"]["home"].__setitem__(1, 0.2), "limits", ("joints.home has shoulder_lift_joint at 0.200 rad", "change")),
        (lambda c: c["joints"]["neutral"].__setitem__(3, -0.3), "posture", ("degrees from straight down", "the tool upright")),
        (lambda c: c["joints"]["home"].__setitem__(1, -1.1), "posture", ("home: tip at", "free_height", "raise joints.home")),
        (lambda c: c["camera"].update(position=[0.55, 1.2, 0.85]), "camera", ("out of its view", "turn or raise")),
        (lambda c: c["camera"].update(position=[0.55, 0.0, -0.85]), "camera", ("above the table",)),
        (lambda c: c["joints"].update(home=c["joints"]["neutral"]), "camera", ("the arm at home hides",)),
    ],
)
def test_mistake_is_found_with_what_is_expected_and_what_to_do(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], about: str, texts: tuple[str, ...]
) -> None:
    findings, _ = check_robot(read_robot(changed(tmp_path, change)))
    wrong = [finding for finding in findings if finding.level is not Level.OK and finding.about == about]
    assert any(all(text in finding.text for text in texts) for finding in wrong), [finding.text for finding in findings]


def test_joint_without_end_needs_limits_in_the_file(tmp_path: Path) -> None:
    without_limits = lambda content: (content["joints"].pop("lower"), content["joints"].pop("upper"))  # noqa: E731
    findings, kinematics = check_robot(read_robot(with_urdf(tmp_path, endless, without_limits)))
    assert kinematics is None
    assert [finding.what for finding in findings if finding.about == "limits"] == ["wrist_3_joint turns without end"]
    assert any("meshes are no files" in finding.what and finding.level is Level.WARNING for finding in findings)


def test_a_velocity_of_zero_is_none_and_that_of_the_file_counts(tmp_path: Path) -> None:
    unknown = lambda text: re.sub('velocity="[^"]*"', 'velocity="0"', text)  # noqa: E731
    findings, _ = check_robot(read_robot(with_urdf(tmp_path, unknown)))
    assert not [finding.text for finding in findings if finding.about == "limits" and finding.level is Level.WRONG]
    without = lambda content: content["joints"].pop("velocity")  # noqa: E731
    findings, _ = check_robot(read_robot(with_urdf(tmp_path, unknown, without)))
    assert any("no velocity limit" in finding.text and "data sheet" in finding.text for finding in findings)


def test_places_that_the_arm_cannot_push_at_are_told_and_drawn_and_a_smaller_workspace_is_proposed(tmp_path: Path) -> None:
    robot, reach, findings = reach_of(changed(tmp_path, lambda c: c.update(workspace=[0.0, 0.45, -0.15, 0.15])), 0.15)
    assert reach.outcome.shape == (2, 4, 3)
    assert np.all(reach.outcome[1, -1] == Outcome.UNREACHABLE) and np.all(reach.outcome[:, 0] == Outcome.POSSIBLE)
    assert reach.largest is not None and reach.largest[1] < 0.45
    texts = [finding.text for finding in findings if finding.level is Level.WRONG]
    assert any("pushes along y are possible at 75 %" in text and "the largest workspace without a gap" in text for text in texts)
    assert any("the tool cannot reach (0.4" in text for text in texts)
    write_reach_page(tmp_path / "reach.html", reach, robot)
    page = (tmp_path / "reach.html").read_text(encoding="utf-8")
    assert page.count('class="unreachable"') == int(np.sum(reach.outcome == Outcome.UNREACHABLE))


def test_push_beyond_the_acceleration_of_the_joints_is_a_limit_and_not_out_of_reach(tmp_path: Path) -> None:
    _, reach, findings = reach_of(changed(tmp_path, lambda c: c["joints"].update(acceleration=[0.5])), 0.4)
    assert np.all(reach.outcome[0] == Outcome.LIMIT)
    assert not any(finding.level is Level.WRONG for finding in findings)
    assert all(outcome is Outcome.LIMIT and "would accelerate" in reason for outcome, reason in reach.reasons)


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
    (folder := tmp_path / "arm").mkdir()
    (folder / "shoulder.obj").touch()
    robot = read_robot(
        with_urdf(
            folder,
            lambda text: (
                endless(text)
                .replace("visual/shoulder.obj", "package://arm/shoulder.obj")
                .replace("</robot>", '<drake:joint drake:acceleration="3"/></robot>')
            ),
        )
    )
    urdf = read_urdf(robot)
    assert not [element.tag for element in urdf.root.iter() if ":" in element.tag]
    assert str(folder / "shoulder.obj") in {mesh.get("filename") for mesh in urdf.root.iter("mesh")}
    arm = ArmKinematics(cell_description(robot, urdf), "tool_tip", robot.file.joints.neutral)
    np.testing.assert_allclose([arm.position_lower, arm.position_upper], [robot.file.joints.lower, robot.file.joints.upper])


def test_description_that_is_no_urdf_or_not_there_is_refused(tmp_path: Path) -> None:
    entities = '<!DOCTYPE robot [<!ENTITY a "b">]><robot name="a"><link name="b"/></robot>'
    xacro = '<robot name="a" xmlns:xacro="http://wiki.ros.org/xacro"><link name="b"/><xacro:arm parent="b"/></robot>'
    refused = (
        (entities, "declares entities"),
        ("<robot", "cannot be read"),
        ("<world/>", "no element `robot`"),
        (xacro, "Expand it first"),
    )
    for text, why in refused:
        with pytest.raises(InputError, match=why):
            read_urdf(read_robot(with_urdf(tmp_path, lambda _, text=text: text)))
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
        (lambda c: c["tool"].update(finger_distance=0.015), "finger_distance is 0.015 m, expected more than 0.02 m"),
        (lambda c: c["tool"].update(finger_distance=-0.05), "tool.finger_distance is -0.05"),
        (lambda c: c["tool"].update(plate_length="5 cm"), "tool.plate_length is '5 cm'"),
        (lambda c: c["tool"].update(finger_distance=0.05, plate_length=0.05), "expected one of them; take the other out"),
        (lambda c: c["tool"].update(finger_distance=0.05, hand="robotiq_3f"), "gripper_action"),
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


@pytest.mark.parametrize("name", ["finger_distance", "plate_length"])
def test_tool_with_two_contacts_is_in_parameters_and_description(tmp_path: Path, name: str) -> None:
    robot = read_robot(changed(tmp_path, lambda c: c["tool"].update({name: 0.05})))
    executor, perception = (node_parameters(robot)[f"{node}_node"] for node in ("push_executor", "perception"))
    sizes = {key: executor[key] for key in ("pusher_radius", "finger_distance", "plate_length")}
    assert sizes == {"pusher_radius": 0.01, "finger_distance": 0.0, "plate_length": 0.0} | {name: 0.05}
    assert perception["tool_radius"] == pytest.approx(0.035)
    described = ET.fromstring(cell_description(robot, read_urdf(robot)))
    (pusher,) = (link for link in described.findall("link") if link.get("name") == "tool_pusher")
    solids = [(next(iter(solid.find("geometry"))).tag, solid.find("origin").get("xyz")) for solid in pusher.findall("collision")]
    ends = [("cylinder", "0.0 0.025 0.06"), ("cylinder", "0.0 -0.025 0.06")]
    assert solids == ends + ([("box", "0.0 0.0 0.06")] if name == "plate_length" else [])
