"""What the check of a robot file finds, and where an arm can push."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.robots import NAMES, changed, robot_path
from push_ident.pushing.robot.checks import Finding, Level, check_reach, check_robot
from push_ident.pushing.robot.description import read_urdf
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
    urdf = read_urdf(read_robot(robot_path("ur5e")))
    text = urdf.path.read_text().replace('name="wrist_3_joint" type="revolute"', 'name="wrist_3_joint" type="continuous"')
    (tmp_path / "arm.urdf").write_text(text)

    def change(content: dict[str, Any]) -> None:
        content["description"] = {"file": "arm.urdf", "root": "base_link"}  # a copy without its meshes
        del content["joints"]["lower"], content["joints"]["upper"]

    findings, kinematics = check_robot(read_robot(changed(tmp_path, change)))
    assert kinematics is None
    assert [finding.what for finding in findings if finding.about == "limits"] == ["wrist_3_joint turns without end"]
    assert any("meshes are no files" in finding.what and finding.level is Level.WARNING for finding in findings)


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
