"""push_executor_node as a real process, with an arm and an object that the test plays on the other side of the topics."""

from __future__ import annotations

import signal
import subprocess
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from shape_msgs.msg import SolidPrimitive
from trajectory_msgs.msg import JointTrajectory

from helpers.executor_cell import (
    ARM_TIMEOUT,
    CONTACT,
    FIST,
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
from helpers.wrong_poses import wrong_poses
from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident.nodes.push_executor.arm_lease import ArmLease
from push_ident.nodes.push_executor.hand_port import RobotiqHand
from push_ident.nodes.push_executor.parameters import PARAMETERS
from push_ident.pushing.push import PushCode
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushRecord
from push_ident_sim.cell.sim_hand_node import SimHandNode

pytestmark = pytest.mark.alone

NOWHERE = CONTACT | {"object_id": "nothing"}
"""Refused at once for what it names, unless for what comes before."""


@pytest.fixture(scope="module")
def node(domain: int, the_cell: Cell) -> Iterator[subprocess.Popen[str]]:
    process = start_node(domain)
    try:
        wait_until_ready(the_cell)
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            output, _ = process.communicate(timeout=10.0)
        finally:
            process.kill()
    assert process.returncode == 0 and "Traceback" not in output and "exception" not in output, output


@pytest.fixture
def cell(node: subprocess.Popen[str], the_cell: Cell) -> Cell:
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


def test_silence_of_a_tenth_of_a_second_is_the_default_limit() -> None:
    assert next(row.default for row in PARAMETERS if row.name == "arm_timeout") == 0.1


def test_dry_run_plans_through_the_contact_and_moves_nothing(cell: Cell) -> None:
    result = send(cell, dry_run=True, **CONTACT).end()
    assert result.error_code == 0 and result.error_text == ""
    contact = transform_points(cell.box, [[0.05, 0.0]])[0]
    assert (result.contact_point.x, result.contact_point.y) == pytest.approx(contact, abs=1e-6)
    assert result.direction == pytest.approx(np.pi + 0.3) and result.speed == 0.2
    path = result.tool_path
    assert path.header.frame_id == "table" and stamp_from_msg(path.poses[0].header.stamp) == 0.0
    ends = np.array([[p.pose.position.x, p.pose.position.y] for p in (path.poses[0], path.poses[-1])])
    heading = np.array([np.cos(result.direction), np.sin(result.direction)])
    assert ends == pytest.approx(contact + np.outer([-RADIUS - 0.03, 0.06 - RADIUS], heading), abs=1e-3)
    time.sleep(0.2)
    assert cell.commands == [] and cell.records == []


def test_push_moves_the_object_and_is_recorded(cell: Cell, stalls: Stalls) -> None:
    before = cell.box.copy()
    call = send(cell, **CONTACT)
    result = call.end()
    assert result.error_code == 0, result.error_text
    assert np.linalg.norm(cell.box[:2] - before[:2]) == pytest.approx(0.06, abs=0.005)
    assert sorted(set(call.feedback)) == call.feedback[:1] + sorted(set(call.feedback[1:])) == [0, 1, 2, 3, 4]
    assert call.feedback == sorted(call.feedback)

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
    assert min(m.pose.position.z for m in cell.pusher) > 0.01 and max(m.pose.position.z for m in cell.pusher) < 0.02
    assert len(cell.tool) > 2 * len(cell.pusher)


def test_pusher_shape_is_latched(cell: Cell) -> None:
    assert cell.shapes[0].type == SolidPrimitive.CYLINDER
    assert list(cell.shapes[0].dimensions) == [0.08, RADIUS]


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

    # The arm stands low beside the box: the next push first goes up from there.
    low = cell.kinematics.forward(cell.q)[:3, 3]
    cell.tool.clear()
    assert send(cell, **CONTACT).end().error_code == 0
    path = np.array([[getattr(m.pose.position, axis) for axis in "xyz"] for m in cell.tool])
    rising = path[: np.argmax(path[:, 2] > 0.1)]
    assert len(rising) > 3 and rising[:, :2] == pytest.approx(np.tile(low[:2], (len(rising), 1)), abs=1e-3)


def test_silent_arm_is_held_and_the_goal_aborted(cell: Cell, stalls: Stalls) -> None:
    call = send(cell, **CONTACT)
    wait_for(lambda: cell.commands)
    time.sleep(0.5)
    cell.silent, silent_since = True, time.monotonic()
    wait_for(lambda: cell.holds)
    assert cell.holds[0][0] - silent_since < ARM_TIMEOUT + 0.2 + 2 * stalls.worst
    result = call.end()
    assert result.error_code == PushCode.ARM_SILENT and "joint_states" in result.error_text
    refused = send(cell, **CONTACT).end()
    assert refused.error_code == PushCode.ARM_SILENT and is_hold(cell.commands[-1][1])


def test_arm_that_deviates_from_its_path_is_held(cell: Cell) -> None:
    call = begin_push(cell)
    cell.offset = np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    result = call.end()
    assert result.error_code == PushCode.TRACKING and "mm from its path" in result.error_text
    assert_held_once(cell)


def assert_held_once(cell: Cell) -> None:
    wait_for(lambda: cell.holds)  # a result may be taken before the command that was sent before it
    time.sleep(0.1)
    assert len(cell.holds) == 1 and is_hold(cell.commands[-1][1])


def test_force_over_the_limit_is_held(cell: Cell, stalls: Stalls) -> None:
    call = begin_push(cell)
    cell.force, since = 31.0, time.monotonic()
    result = call.end()
    assert result.error_code == PushCode.FORCE and "31.0 N" in result.error_text, result.error_text
    time.sleep(0.3)
    assert_held_once(cell)
    assert cell.holds[0][0] - since < 0.1 + 2 * stalls.worst
    wait_for(lambda: cell.records)
    assert cell.records[0].error_code == PushCode.FORCE


def test_force_that_is_not_measured_any_more_is_held(cell: Cell) -> None:
    call = begin_push(cell)
    cell.feels = False
    result = call.end()
    assert result.error_code == PushCode.FORCE and "no force that can be trusted on pusher/wrench" in result.error_text
    time.sleep(0.2)
    assert_held_once(cell)


@pytest.mark.parametrize("fault", ["not seen", "outside"])
def test_object_lost_during_a_push_stops_it_and_the_arm_leaves_on_a_checked_path(cell: Cell, fault: str) -> None:
    call = begin_push(cell, distance=0.12, speed=0.1)
    before = cell.box.copy()
    if fault == "not seen":
        cell.sees_box = False
    else:
        cell.box_sticks = False
        cell.box[0] = 0.35
    result = call.end()
    assert result.error_code == PushCode.OBJECT_LOST and "went home" in result.error_text, result.error_text
    push, retreat = ([msg for _, msg in motion] for motion in cell.motions)
    assert is_hold(push[-1])
    assert len(push) > 20 and len(retreat) > 20
    assert cell.q == pytest.approx(PARKED, abs=0.02)
    if fault == "not seen":
        assert np.linalg.norm(cell.box[:2] - before[:2]) < 0.1  # half a second at most, of the twelve centimetres asked for
    heights = [cell.kinematics.forward(point.positions)[2, 3] for piece in retreat for point in piece.points[:1]]
    assert min(heights) > 0.011 and max(heights) > 0.11
    wait_for(lambda: cell.records)
    record = cell.records[0]
    assert record.error_code == PushCode.OBJECT_LOST and stamp_from_msg(record.start) < stamp_from_msg(record.end)
    time.sleep(0.3)
    assert len(cell.motions) == 2 and len(cell.holds) == 1


def test_arm_moved_by_hand_while_it_was_silent_starts_from_where_it_is_now(cell: Cell) -> None:
    call = begin_push(cell)
    cell.silent = True
    assert call.end().error_code == PushCode.ARM_SILENT
    assert_held_once(cell)
    cell.commands.clear()
    cell.place_arm(np.array(PARKED) + 0.15 * np.array([1.0, -1.0, 0.5, 0.0, 0.5, 0.0, 1.0]))
    moved = cell.q.copy()
    cell.box[:] = 0.0, 0.02, 0.3
    cell.silent = False
    time.sleep(1.0)
    assert send(cell, **CONTACT).end().error_code == 0
    assert len(cell.motions) == 1
    assert list(cell.commands[0][1].points[0].positions) == pytest.approx(moved, abs=5e-3)


def test_hand_that_is_no_fist_refuses_a_push_and_holds_a_running_one(cell: Cell) -> None:
    cell.fist["g_pra"] = 0
    wait_for(lambda: "the hand is open" in said(cell))
    result = send(cell, **CONTACT).end()
    assert result.error_code == PushCode.HAND and "the hand is open" in result.error_text and cell.commands == []
    assert send(cell, dry_run=True, **CONTACT).end().error_code == 0
    cell.fist = dict(FIST)
    wait_for(lambda: "the hand is open" not in said(cell))
    call = begin_push(cell, distance=0.12, speed=0.1)
    cell.fist["g_flt"] = 0x0D
    result = call.end()
    assert result.error_code == PushCode.HAND and "0x0D" in result.error_text
    time.sleep(0.2)
    assert_held_once(cell)


def said(cell: Cell) -> str:
    """What the executor says of itself now; it looks each second."""
    return cell.diagnostics[-1].status[0].message


def test_recording_that_fails_holds_the_push_and_refuses_the_next(cell: Cell) -> None:
    call = begin_push(cell)
    cell.recording.publish(DiagnosticStatus(level=DiagnosticStatus.ERROR, message="disk full"))
    result = call.end()
    assert result.error_code == PushCode.RECORDING and "disk full" in result.error_text
    assert_held_once(cell)
    assert send(cell, **CONTACT).end().error_code == PushCode.RECORDING and is_hold(cell.commands[-1][1])
    cell.recording.publish(DiagnosticStatus(level=DiagnosticStatus.OK))
    wait_for(lambda: send(cell, dry_run=True, **CONTACT).end().error_code == 0)


def test_object_near_the_edge_is_first_pushed_back_to_the_middle_in_a_push_of_its_own_purpose(cell: Cell) -> None:
    cell.box[:] = 0.05, 0.20, 0.0
    time.sleep(1.0)  # for some thirty of its poses to come, which nobody acknowledges
    call = send(cell, mode=ExecutePush.Goal.MODE_RANDOM, seed=1)
    result = call.end(30.0)
    assert result.error_code == 0, result.error_text
    wait_for(lambda: len(cell.records) == 2)
    first, second = cell.records
    assert (first.push_id, second.push_id) == (result.recentre_push_id, result.push_id)
    assert (first.purpose, second.purpose) == (PushRecord.PURPOSE_RECENTRE, PushRecord.PURPOSE_REQUESTED)
    assert np.sin(first.direction) < -0.5  # towards the middle
    assert ExecutePush.Feedback.PHASE_RECENTRE in call.feedback
    assert call.feedback[-1] == ExecutePush.Feedback.PHASE_RETREAT
    # A push that is possible nowhere moves nothing; one in the table frame is made as it was asked for, or not at all.
    for kept in (cell.records, cell.commands):
        kept.clear()
    cell.box[:] = 0.05, 0.20, 0.0
    time.sleep(1.0)
    assert send(cell, **(CONTACT | {"direction": 0.0})).end().error_code == PushCode.INVALID_GOAL
    in_table = {"object_id": "box", "contact_point": Point(x=0.05, y=0.23), "direction": -np.pi / 2}
    assert send(cell, **in_table).end().error_code == PushCode.LIMIT
    assert cell.commands == []
    result = send(cell, mode=ExecutePush.Goal.MODE_RECENTRE).end()
    assert result.error_code == 0 and result.recentre_push_id == 0
    assert cell.box[1] < 0.14
    wait_for(lambda: cell.records)
    assert cell.records[0].purpose == PushRecord.PURPOSE_RECENTRE


def test_command_is_what_a_trajectory_controller_of_ros2_control_takes(cell: Cell) -> None:
    assert send(cell, **CONTACT).end().error_code == 0
    limits = cell.kinematics
    assert len(cell.commands) > 40
    for _, command in cell.commands:
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in command.points])
        position, velocity = (np.array([list(getattr(p, name)) for p in command.points]) for name in ("positions", "velocities"))
        assert tuple(command.joint_names) == limits.joint_names and stamp_from_msg(command.header.stamp) == 0.0
        assert 2 <= len(times) <= 25 and times[0] > 0.0 and np.all(np.diff(times) > 0)
        assert np.all(velocity[-1] == 0.0)  # the controller refuses to end in motion
        assert np.all((position >= limits.position_lower) & (position <= limits.position_upper))
        assert np.all(np.abs(velocity) <= 2.0 + 1e-3)
        # Cubics through the points: velocities are the derivative of the positions.
        slope = np.diff(position, axis=0) / np.diff(times)[:, None]
        assert np.abs(slope - 0.5 * (velocity[1:] + velocity[:-1])).max() < 0.05


def test_object_that_stays_is_no_contact(cell: Cell) -> None:
    cell.box_sticks = False
    result = send(cell, **CONTACT).end()
    assert result.error_code == PushCode.NO_CONTACT, result.error_text
    wait_for(lambda: cell.records)
    assert cell.records[0].error_code == PushCode.NO_CONTACT and stamp_from_msg(cell.records[0].contact) == 0.0


def test_random_push_is_reproduced_by_its_seed(cell: Cell) -> None:
    first, again, other = (send(cell, mode=ExecutePush.Goal.MODE_RANDOM, seed=seed, dry_run=True).end() for seed in (3, 3, 4))
    assert first.error_code == 0, first.error_text
    assert first.contact_point == again.contact_point and first.direction == again.direction
    assert first.contact_point != other.contact_point


@pytest.mark.parametrize(
    ("change", "code", "text"),
    [
        ({"object_id": "cup"}, PushCode.UNKNOWN_OBJECT, "known: box"),
        ({"frame_id": "camera"}, PushCode.INVALID_GOAL, "frame_id is `camera`"),
        ({"direction": float("nan")}, PushCode.INVALID_GOAL, "direction"),
        ({"direction": 0.0}, PushCode.INVALID_GOAL, "does not push into"),
        ({"distance": 0.24}, PushCode.LIMIT, "leaves the workspace"),
        ({"speed": 9.0}, PushCode.INVALID_GOAL, "speed is 9.000"),
        ({"mode": 7}, PushCode.INVALID_GOAL, "mode is 7"),
    ],
)
def test_bad_goal_is_refused_with_its_code_and_nothing_moves(cell: Cell, change: dict[str, object], code: PushCode, text: str) -> None:
    result = send(cell, **(CONTACT | change)).end()
    assert result.error_code == code and text in result.error_text, result.error_text
    assert cell.commands == [] and result.push_id == 0


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


def test_wrong_poses_in_the_middle_of_a_push_are_refused_and_end_neither_push_nor_node(cell: Cell, node: subprocess.Popen[str]) -> None:
    first, *others = wrong_poses().values()
    wrong = cell.create_publisher(PoseWithCovarianceStamped, "objects/box/pose", 10)

    def values() -> dict[str, str]:
        return {v.key: v.value for v in cell.diagnostics[-1].status[0].values}

    def n_refused() -> int:
        return int(values()["refused"])

    def is_heard() -> bool:
        # A publisher may know its subscriber before that knows it, and is not heard until then.
        wrong.publish(first)
        time.sleep(0.2)
        return n_refused() > before

    try:
        before = n_refused()
        wait_for(is_heard)
        call = begin_push(cell)
        before = n_refused()
        for message in others:
            wrong.publish(message)
        assert call.end().error_code == 0
        wait_for(lambda: n_refused() > before)
    finally:
        cell.destroy_publisher(wrong)
    assert values()["last refusal"].startswith("/objects/box/pose") and node.poll() is None


def test_interrupt_in_the_middle_of_a_push_holds_the_arm_and_ends_cleanly(cell: Cell, node: subprocess.Popen[str], stalls: Stalls) -> None:
    begin_push(cell, distance=0.12, speed=0.1)
    node.send_signal(signal.SIGINT)
    asked = time.monotonic()
    wait_for(lambda: cell.holds)
    assert cell.holds[0][0] - asked < 0.2 + 2 * stalls.worst
    wait_for(lambda: node.poll() is not None, 10.0)  # by itself: it ends by force, and not with 0, after 1.8 s
    assert node.returncode == 0


def test_of_two_executors_that_start_at_once_one_gets_the_arm_and_a_killed_one_leaves_it_free() -> None:
    domain = own_domain()  # without a cell: the lease needs none
    both = [start_node(domain) for _ in range(2)]
    try:
        wait_for(lambda: any(process.poll() is not None for process in both), 60.0)
        loser, winner = sorted(both, key=lambda process: process.poll() is None)
        output, _ = loser.communicate(timeout=5.0)
        assert loser.returncode == 1 and f"process {winner.pid}" in output and "Traceback" not in output
        time.sleep(0.5)
        assert winner.poll() is None
        with pytest.raises(InputError, match=f"process {winner.pid}"):
            ArmLease(domain, "/joint_trajectory")
        ArmLease(domain, "/left/joint_trajectory").release()  # another arm
        winner.kill()
        winner.wait(5.0)
        ArmLease(domain, "/joint_trajectory").release()
    finally:
        for process in both:
            process.kill()
            process.wait(5.0)


def test_simulated_hand_is_activated_and_closed_to_a_fist() -> None:
    context = Context()
    rclpy.init(context=context, domain_id=own_domain())
    times = [f"{name}:=0.3" for name in ("activation_time", "closing_time")]
    arguments = ["--ros-args", "-p", "closed:=false", *(item for time in times for item in ("-p", time))]
    hand = SimHandNode(context=context, cli_args=arguments)
    user = Node("user", context=context)
    executor = SingleThreadedExecutor(context=context)
    for node in (hand, user):
        executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        port = RobotiqHand(user, "simulated", timeout=2.0, callback_group=user.default_callback_group)
        wait_for(lambda: "not activated" in port.why_no_fist())
        assert port.close_fist(5.0, lambda: False) == ""
        with pytest.raises(InputError, match="robotiq_3f_gripper_ros2_interfaces"):
            RobotiqHand(user, "robotiq_3f", timeout=2.0, callback_group=user.default_callback_group)
    finally:
        executor.shutdown()
        thread.join(2.0)
        for node in (hand, user):
            node.destroy_node()
        context.try_shutdown()
