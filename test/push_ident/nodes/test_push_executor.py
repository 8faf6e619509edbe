"""push_executor_node as a real process, with an arm and an object that the test plays on the other side of the topics."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from shape_msgs.msg import SolidPrimitive
from trajectory_msgs.msg import JointTrajectory

from helpers.executor_cell import (
    ARM_TIMEOUT,
    CONTACT,
    PARKED,
    RADIUS,
    Cell,
    Stalls,
    begin_push,
    is_hold,
    send,
    start_node,
    wait_for,
    wait_until_ready,
)
from helpers.lifecycle import Lifecycle
from helpers.node_process import NodeProcess
from helpers.wrong_poses import wrong_poses
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident.pushing.push import PushCode

pytestmark = pytest.mark.alone

NOWHERE = CONTACT | {"object_id": "nothing"}
"""Refused at once for what it names, unless for what comes before."""
FULL = DiagnosticStatus(level=DiagnosticStatus.ERROR, message="disk full")


@pytest.fixture(scope="module")
def node(domain: int, the_cell: Cell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeProcess]:
    process = start_node(domain, tmp_path_factory.mktemp("node"))
    try:
        wait_until_ready(the_cell)
        yield process
    finally:
        code = process.stop()
    assert code == 0 and "Traceback" not in process.output and "exception" not in process.output, process.output


@pytest.fixture
def cell(node: NodeProcess, the_cell: Cell) -> Cell:
    """At home, with nothing recorded yet."""
    the_cell.reset()
    tip = the_cell.kinematics.forward(np.array(PARKED))[:2, 3]
    wait_for(lambda: the_cell.tool and np.hypot(*(tip - [the_cell.tool[-1].pose.position.x, the_cell.tool[-1].pose.position.y])) < 1e-6)
    time.sleep(0.2)  # for the poses of the box
    return the_cell


@pytest.fixture
def stalls() -> Iterator[Stalls]:
    with Stalls() as watch:
        yield watch


def test_push_is_planned_moves_the_object_and_is_recorded(cell: Cell, stalls: Stalls) -> None:
    before, planned = cell.box.copy(), send(cell, dry_run=True, **CONTACT).end()
    contact = transform_points(before, [[0.05, 0.0]])[0]
    heading = np.array([np.cos(planned.direction), np.sin(planned.direction)])
    ends = np.array([[p.pose.position.x, p.pose.position.y] for p in (planned.tool_path.poses[0], planned.tool_path.poses[-1])])
    assert planned.error_code == 0 and planned.direction == pytest.approx(np.pi + 0.3)
    assert ends == pytest.approx(contact + np.outer([-RADIUS - 0.03, 0.06 - RADIUS], heading), abs=1e-3)
    time.sleep(0.2)
    assert cell.commands == [] and cell.records == [], "a dry run moves nothing"
    call = send(cell, **CONTACT)
    for wrong in wrong_poses().values():
        cell.poses.publish(wrong)
        time.sleep(0.03)  # the executor keeps the latest few only
    result = call.end()
    assert result.error_code == 0, result.error_text
    assert np.linalg.norm(cell.box[:2] - before[:2]) == pytest.approx(0.06, abs=0.005)
    assert sorted(set(call.feedback)) == [0, 1, 2, 3, 4] and call.feedback == sorted(call.feedback)
    wait_for(lambda: cell.records)
    record = cell.records[0]
    assert record.push_id == result.push_id and record.object_id == "box" and record.error_code == 0
    start, contact, stop, end = (stamp_from_msg(t) for t in (record.start, record.contact, record.stop, record.end))
    assert start < contact < stop < end
    later = 0.1 + 2 * stalls.worst + cell.delays()
    assert -0.1 < contact - start - (0.2 + 0.03 / 0.2 + 0.05) < later
    assert -0.1 < stop - contact - (0.06 / 0.2 + 0.05) < later

    stamps = np.array([stamp_from_msg(m.header.stamp) for m in cell.pusher])
    assert np.all((stamps > start - 0.2) & (stamps < end + 0.2))
    late = 0.15 + 2 * stalls.worst
    assert stamps[0] < start + late and stamps[-1] > end - late
    assert 20 <= len(stamps) / (end - start) <= 62
    at_contact = np.array([np.interp(contact, stamps, [getattr(m.pose.position, axis) for m in cell.pusher]) for axis in "xy"])
    touched = np.array([record.contact_point.x, record.contact_point.y])
    assert np.linalg.norm(at_contact - touched) == pytest.approx(RADIUS, abs=0.001)
    assert all(0.01 < m.pose.position.z < 0.02 for m in cell.pusher) and len(cell.tool) > 2 * len(cell.pusher)
    assert cell.shapes[0].type == SolidPrimitive.CYLINDER and list(cell.shapes[0].dimensions) == [0.08, RADIUS]
    assert_commands_are_those_of_ros2_control(cell)


def assert_commands_are_those_of_ros2_control(cell: Cell) -> None:
    limits = cell.kinematics
    assert len(cell.commands) > 40
    for _, command in cell.commands:
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in command.points])
        position, velocity = (np.array([list(getattr(p, name)) for p in command.points]) for name in ("positions", "velocities"))
        assert tuple(command.joint_names) == limits.joint_names and stamp_from_msg(command.header.stamp) == 0.0
        # A point every 10 ms: 0.1 s of motion at most, then braking from 2 rad/s at 10 rad/s^2; and two ends.
        assert 2 <= len(times) <= 2 + (0.1 + 2.0 / 10.0) / 0.01
        assert times[0] > 0.0 and np.all(np.diff(times) > 0)
        assert np.all(velocity[-1] == 0.0)  # the controller refuses to end in motion
        assert np.all((position >= limits.position_lower) & (position <= limits.position_upper))
        assert np.all(np.abs(velocity) <= 2.0 + 1e-3)
        # Cubics through the points: velocities are the derivative of the positions.
        slope = np.diff(position, axis=0) / np.diff(times)[:, None]
        assert np.abs(slope - 0.5 * (velocity[1:] + velocity[:-1])).max() < 0.05


def test_second_goal_is_refused_during_a_push_and_cancel_holds_within_100_ms(cell: Cell, stalls: Stalls) -> None:
    call = begin_push(cell, speed=0.05)
    assert send(cell, **CONTACT).end().error_code == PushCode.BUSY
    assert cell.holds == []
    asked = time.monotonic()
    call.handle.cancel_goal_async()
    wait_for(lambda: cell.holds)
    received, hold = cell.holds[0]
    assert received - asked < 0.1 + 2 * stalls.worst
    assert call.end().error_code == PushCode.CANCELED
    wait_for(lambda: cell.records)
    assert cell.records[0].error_code == PushCode.CANCELED
    time.sleep(0.3)
    assert cell.commands[-1][1] is hold and cell.q == pytest.approx(list(hold.points[0].positions), abs=1e-9)
    wait_for(lambda: np.ptp([m.pose.position.x for m in cell.tool[-5:]]) < 1e-9)


@pytest.mark.parametrize(
    ("name", "value", "code", "text", "within"),
    [("silent", True, PushCode.ARM_SILENT, "joint_states", ARM_TIMEOUT + 0.2), ("force", 31.0, PushCode.FORCE, "31.0 N", 0.1)],
)
def test_input_that_fails_holds_the_arm_once(
    cell: Cell, stalls: Stalls, name: str, value: float, code: PushCode, text: str, within: float
) -> None:
    """What else ends a push: `pushing/test_execution.py`, on a cell in memory, and `make faults`."""
    call = begin_push(cell, distance=0.12, speed=0.1)
    setattr(cell, name, value)
    failed_at = time.monotonic()
    result = call.end()
    assert result.error_code == code and text in result.error_text, result.error_text
    wait_for(lambda: cell.holds and cell.records)  # a result may be taken before the command that was sent before it
    assert cell.holds[0][0] - failed_at < within + 2 * stalls.worst
    assert cell.records[0].error_code == code
    time.sleep(0.2)
    assert len(cell.holds) == 1 and is_hold(cell.commands[-1][1])
    cell.reset()
    wait_for(lambda: send(cell, dry_run=True, **CONTACT).end().error_code == 0)


def test_no_push_begins_with_an_open_hand_or_a_full_disk(cell: Cell) -> None:
    for fail, code, text in (
        (lambda: cell.fist.update(g_flt=0x0D), PushCode.HAND, "0x0D"),
        (lambda: cell.recording.publish(FULL), PushCode.RECORDING, "disk full"),
    ):
        fail()
        wait_for(lambda code=code: send(cell, **NOWHERE).end().error_code == code)
        result = send(cell, **CONTACT).end()
        assert result.error_code == code and text in result.error_text and cell.commands == []
        cell.reset()
        cell.recording.publish(DiagnosticStatus(level=DiagnosticStatus.OK))
        wait_for(lambda code=code: send(cell, **NOWHERE).end().error_code != code)


WRONG_GOALS = (
    ({"object_id": "cup"}, PushCode.UNKNOWN_OBJECT, "known: box"),
    ({"frame_id": "camera"}, PushCode.INVALID_GOAL, "frame_id is `camera`"),
    ({"direction": 0.0}, PushCode.INVALID_GOAL, "does not push into"),
    ({"distance": 0.24}, PushCode.LIMIT, "leaves the workspace"),
    ({"speed": 9.0}, PushCode.INVALID_GOAL, "speed is 9.000"),
)


def test_wrong_goals_and_objects_of_unknown_pose_are_refused_with_their_code_and_nothing_moves(cell: Cell) -> None:
    for change, code, text in WRONG_GOALS:
        result = send(cell, **(CONTACT | change)).end()
        assert result.error_code == code and text in result.error_text, result.error_text
        assert result.push_id == 0
    cell.pose_variance = 1.0
    time.sleep(0.2)
    result = send(cell, **CONTACT).end()
    assert result.error_code == PushCode.UNKNOWN_OBJECT and "too uncertain" in result.error_text and result.push_id == 0
    assert cell.commands == []


def test_arm_that_another_node_commands_is_not_commanded(cell: Cell) -> None:
    rival = Node("rival", context=cell.context)
    rival.create_publisher(JointTrajectory, "joint_trajectory", 10)
    try:
        # Who it is comes after the news that there is one more.
        wait_for(lambda: "/rival commands the arm" in send(cell, **NOWHERE).end().error_text)
        result = send(cell, **CONTACT).end()
    finally:
        rival.destroy_node()
    assert result.error_code == PushCode.BUSY and "/rival commands the arm" in result.error_text and cell.commands == []
    wait_for(lambda: send(cell, **NOWHERE).end().error_code != PushCode.BUSY)


def test_node_that_is_deactivated_in_the_middle_of_a_push_holds_the_arm_first(cell: Cell) -> None:
    with Lifecycle("push_executor_node", cell.context.get_domain_id()) as lifecycle:
        call = begin_push(cell)
        assert lifecycle.change("deactivate")
        result = call.end()
        assert result.error_code == PushCode.CANCELED and "stopped" in result.error_text
        time.sleep(0.5)  # for what was sent before it, and for braking
        stands, n_commands = cell.q.copy(), len(cell.commands)
        time.sleep(0.3)
        assert (cell.q == stands).all() and len(cell.commands) == n_commands
        refused = send(cell, **CONTACT).end()
        assert refused.error_code == PushCode.BUSY and "not active" in refused.error_text
        assert lifecycle.change("activate")
        wait_for(lambda: send(cell, dry_run=True, **CONTACT).end().error_code == 0)


def test_interrupt_in_the_middle_of_a_push_holds_the_arm_and_ends_cleanly(cell: Cell, node: NodeProcess, stalls: Stalls) -> None:
    begin_push(cell, distance=0.12, speed=0.1)
    os.kill(node.pid, signal.SIGINT)
    asked = time.monotonic()
    wait_for(lambda: cell.holds)
    assert cell.holds[0][0] - asked < 0.2 + 2 * stalls.worst
    assert node.wait(10.0) == 0  # by itself: it ends by force, and not with 0, after 1.8 s
