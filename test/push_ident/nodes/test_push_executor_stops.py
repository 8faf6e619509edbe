"""The arm stops whatever becomes of push_executor_node, a real process, and whatever joint states and descriptions say meanwhile."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from helpers.corrupted_states import shares_of_commands
from helpers.executor_cell import (
    CONTACT,
    LATCHED,
    PARKED,
    QUICK,
    Cell,
    Stalls,
    ask,
    begin_push,
    is_hold,
    send,
    start_node,
    wait_for,
    wait_until_ready,
)
from helpers.lifecycle import Lifecycle
from push_ident.pushing.motion import MotionSettings, joint_limits
from push_ident.pushing.push import PushCode
from push_ident_sim.cell.robot import robot_description

pytestmark = pytest.mark.alone

UNASKED = 0.1
"""Longest motion that nobody asks for [s]; braking comes on top."""
ACCELERATION = 10.0
"""Limit of every joint [rad/s^2]: the default of joint_acceleration_limits."""
MOTION = MotionSettings(home=tuple(PARKED), max_joint_velocity=QUICK["max_joint_velocity"])
Lie = Callable[[JointState], None]
SLOW_PUSH = {"distance": 0.12, "speed": 0.1}


@pytest.fixture(scope="module")
def processes(domain: int) -> Iterator[list[subprocess.Popen[str]]]:
    """The executor, and those before it that were killed."""
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def node(domain: int, the_cell: Cell, processes: list[subprocess.Popen[str]]) -> subprocess.Popen[str]:
    """The executor, started again if it was killed; the cell at home, with nothing recorded yet."""
    the_cell.reset()
    the_cell.box[0] = 0.06  # room for the longest push
    if not processes or processes[-1].poll() is not None:
        the_cell.diagnostics.clear()
        processes.append(start_node(domain, stamp_commands=True))
        wait_until_ready(the_cell)
    time.sleep(0.2)
    return processes[-1]


def motion_after(all_states: list[tuple[float, np.ndarray]], event: float) -> tuple[float, float, float]:
    """Time until the arm stands [s], and the largest joint motion [rad] and speed [rad/s] after the time that it may move unasked."""
    states = [(t, q) for t, q in all_states if t >= event - 0.05]
    time, q = np.array([t for t, _ in states]), np.array([q for _, q in states])
    moving = np.flatnonzero(np.max(np.abs(np.diff(q, axis=0)), axis=1) > 1e-9)
    still = time[moving[-1] + 1] - event if len(moving) else 0.0
    first = np.searchsorted(time, event + UNASKED)
    speed = np.abs(np.diff(q, axis=0)[: first + 1]) / np.diff(time)[: first + 1, None]
    return float(still), float(np.max(np.abs(q[-1] - q[min(first, len(q) - 1)]))), float(np.max(speed))


def assert_stopped(states: list[tuple[float, np.ndarray]], event: float, stalls: Stalls) -> None:
    still, moved, speed = motion_after(states, event)
    braking = speed / ACCELERATION + 0.02  # the shortest braking
    assert still < UNASKED + braking + 2 * stalls.worst, f"stands after {1e3 * still:.0f} ms"
    # A uniform deceleration from `speed`, and what it makes in the time that the machine stood still.
    assert moved < 0.5 * speed * braking + speed * 2 * stalls.worst


def test_killed_executor_leaves_no_motion_beyond_a_tenth_of_a_second_and_braking(the_cell: Cell, node: subprocess.Popen[str]) -> None:
    cell = the_cell
    begin_push(cell, **SLOW_PUSH)
    time.sleep(0.4)
    with Stalls() as stalls:
        node.send_signal(signal.SIGKILL)
        killed = time.monotonic()
        node.wait(5.0)
        time.sleep(0.6)
    assert_stopped(list(cell.states), killed, stalls)
    box = cell.box.copy()
    time.sleep(0.2)
    assert np.array_equal(cell.box, box) and cell.records == []
    assert cell.commands[-1][0] < killed + 0.1 + 2 * stalls.worst


def test_executor_that_does_not_run_for_a_moment_goes_on_with_the_push(the_cell: Cell, node: subprocess.Popen[str]) -> None:
    cell = the_cell
    call = begin_push(cell, **SLOW_PUSH)
    time.sleep(0.3)
    with Stalls() as stalls:
        node.send_signal(signal.SIGSTOP)
        stopped = time.monotonic()
        time.sleep(0.25)
        states = list(cell.states)
        node.send_signal(signal.SIGCONT)
    assert_stopped(states, stopped, stalls)
    result = call.end()
    assert result.error_code == 0, result.error_text
    assert cell.holds == []
    wait_for(lambda: cell.records)
    record = cell.records[0]
    seconds = [t.sec + 1e-9 * t.nanosec for t in (record.start, record.contact, record.stop, record.end)]
    assert np.all(np.diff(seconds) > 0)
    # As planned, with the pause in it: it moved for the horizon of its last command.
    assert seconds[2] - seconds[0] > QUICK["settle"] + (0.03 + SLOW_PUSH["distance"]) / SLOW_PUSH["speed"] + 0.1
    pushed = [(m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec, m.pose.position.x, m.pose.position.y) for m in cell.pusher]
    path = np.array([row[1:] for row in pushed])
    line = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])
    across = (path - path[0]) @ np.array([-line[1], line[0]])
    assert np.abs(across).max() < 5e-4
    assert seconds[0] - 0.2 < pushed[0][0] < seconds[0] + 0.2 and abs(pushed[-1][0] - seconds[3]) < 0.2


def test_executor_that_has_just_started_waits_for_the_first_joint_states_and_their_description(
    domain: int, the_cell: Cell, node: subprocess.Popen[str], processes: list[subprocess.Popen[str]]
) -> None:
    """Of a cell that has just started the topics come in any order: here a goal, the joint states and then their description."""
    node.kill()
    node.wait(5.0)
    the_cell.silent = True
    the_cell.diagnostics.clear()
    processes.append(start_node(domain, remap=("robot_description", "later_description")))
    later = the_cell.create_publisher(String, "later_description", LATCHED)
    try:
        wait_until_ready(the_cell)
        call = send(the_cell, **CONTACT)
        time.sleep(1.6)  # longer than an arm that was heard before may be silent
        assert not call.result.done(), call.end()
        the_cell.silent = False
        time.sleep(0.3)
        assert not call.result.done(), call.end()
        later.publish(String(data=robot_description()))
        result = call.end()
        assert result.error_code == 0, result.error_text
    finally:
        ask(the_cell, lambda: the_cell.destroy_publisher(later))
        processes[-1].kill()
        processes[-1].wait(5.0)


def test_motion_that_was_not_watched_for_long_does_not_go_on(the_cell: Cell, node: subprocess.Popen[str]) -> None:
    call = begin_push(the_cell, **SLOW_PUSH)
    node.send_signal(signal.SIGSTOP)
    time.sleep(1.5)
    n_commands = len(the_cell.commands)
    node.send_signal(signal.SIGCONT)
    result = call.end()
    assert result.error_code in (PushCode.TRACKING, PushCode.ARM_SILENT), result.error_text
    time.sleep(0.3)
    assert [is_hold(msg) for _, msg in the_cell.commands[n_commands:]] == [True]


def test_description_of_other_joints_during_a_push_is_refused_after_it(the_cell: Cell, node: subprocess.Popen[str]) -> None:
    cell, name = the_cell, the_cell.kinematics.joint_names[2]
    other = robot_description().replace(f'"{name}"', '"renamed"')
    call = begin_push(cell, **SLOW_PUSH)
    cell.describe(other)
    time.sleep(0.3)
    call.handle.cancel_goal_async()
    assert call.end().error_code == PushCode.CANCELED
    time.sleep(0.3)
    assert len(cell.holds) == 1 and is_hold(cell.commands[-1][1])
    assert all(tuple(msg.joint_names) == cell.kinematics.joint_names for _, msg in cell.commands)
    assert np.ptp([q for _, q in cell.states[-10:]], axis=0).max() < 1e-9
    wait_for(lambda: any("robot_description refused: its joints renamed" in m.status[0].message for m in list(cell.diagnostics)))
    cell.describe(robot_description())
    assert send(cell, **CONTACT).end().error_code == 0


def test_description_of_another_tool_is_used_once_the_arm_stands(the_cell: Cell, node: subprocess.Popen[str]) -> None:
    cell = the_cell
    call = begin_push(cell)
    cell.describe("<robot")
    at_80_mm = '<child link="tool_tip" /><origin xyz="0 0 0.08" />'
    assert at_80_mm in robot_description()
    cell.describe(robot_description().replace(at_80_mm, at_80_mm.replace("0.08", "0.09")))
    assert call.end().error_code == 0
    assert min(m.pose.position.z for m in cell.pusher) > QUICK.get("push_height", 0.012) - 1e-3
    home = cell.kinematics.forward(cell.q)[2, 3]
    wait_for(lambda: cell.tool[-1].pose.position.z == pytest.approx(home - 0.01, abs=1e-4))
    cell.describe(robot_description())
    wait_for(lambda: cell.tool[-1].pose.position.z == pytest.approx(home, abs=1e-4))


def few(n: int, change: Lie) -> Lie:
    """Change so many states, and then none."""
    left = [n]

    def lie(state: JointState) -> None:
        left[0] -= 1
        if left[0] >= 0:
            change(state)

    return lie


def turned(joint: int, angle: float) -> Lie:
    def change(state: JointState) -> None:
        state.position[joint] += angle

    return change


def swapped(state: JointState) -> None:
    names = list(state.name)
    names[1], names[3] = names[3], names[1]
    state.name = names


LIES: dict[str, Lie] = {"joint 1 for 40 ms": few(4, turned(0, 0.3)), "names swapped": swapped}
"""Any others, on an arm in memory: `pushing/test_corrupted_states.py`."""


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_joint_states_that_are_not_true_end_the_push_and_break_no_limit(the_cell: Cell, node: subprocess.Popen[str], lie: Lie) -> None:
    cell = the_cell
    call = begin_push(cell, **SLOW_PUSH)
    start = cell.states[0][1]
    cell.lie, began = lie, time.monotonic()
    result = call.end()
    assert result.error_code == PushCode.TRACKING, result.error_text
    time.sleep(0.3)
    assert_limits_kept(cell, start)
    states = [(t, q) for t, q in cell.states if t > began]
    stood = next(t for (t, q), (_, later) in zip(states, states[20:], strict=False) if np.array_equal(q, later))
    assert stood - began < 0.8
    wait_for(lambda: cell.records)
    assert cell.records[-1].error_code == PushCode.TRACKING


def assert_limits_kept(cell: Cell, start: np.ndarray) -> None:
    commands = [msg for _, msg in cell.commands]
    velocity, acceleration, aside = shares_of_commands(commands, start, joint_limits(cell.kinematics, MOTION))
    assert velocity < 1.01 and acceleration < 1.01 and aside < 2e-3


def test_states_that_are_wrong_from_one_push_to_the_next_move_the_arm_slowly_and_are_believed_when_right(
    the_cell: Cell, node: subprocess.Popen[str]
) -> None:
    cell = the_cell
    assert send(cell, **CONTACT).end().error_code == 0
    start = cell.q.copy()
    cell.commands.clear()
    cell.lie = turned(0, 0.3)
    time.sleep(1.5)  # a jump is believed after a second
    result = send(cell, **CONTACT).end()
    assert result.error_code == PushCode.TRACKING and "not believed" in result.error_text
    assert "not believed" in send(cell, **CONTACT).end().error_text
    assert cell.commands
    assert_limits_kept(cell, start)
    cell.lie = lambda state: None
    time.sleep(1.5)
    assert send(cell, **CONTACT).end().error_code == 0


def test_node_that_is_shut_down_in_the_middle_of_a_push_holds_the_arm_first(the_cell: Cell, node: subprocess.Popen[str]) -> None:
    with Lifecycle.of("push_executor_node", the_cell.context.get_domain_id()) as lifecycle:
        lifecycle.wait()
        call = begin_push(the_cell, **SLOW_PUSH)
        assert lifecycle.change("shutdown")
        result = call.end()
        assert result.error_code == PushCode.CANCELED and "stopped" in result.error_text
    time.sleep(0.5)  # for what was sent before it, and for braking
    stands, n_commands = the_cell.q.copy(), len(the_cell.commands)
    time.sleep(0.3)
    assert (the_cell.q == stands).all() and len(the_cell.commands) == n_commands
    assert node.poll() is None
    node.send_signal(signal.SIGINT)
    assert node.wait(10.0) == 0


@pytest.mark.long
def test_interrupt_during_a_transition_ends_the_node_cleanly(the_cell: Cell, node: subprocess.Popen[str]) -> None:
    begin_push(the_cell, **SLOW_PUSH)
    change = the_cell.create_client(ChangeState, "push_executor_node/change_state")
    wait_for(change.service_is_ready)
    change.call_async(ChangeState.Request(transition=Transition(label="deactivate")))
    time.sleep(0.02)
    node.send_signal(signal.SIGINT)
    output, _ = node.communicate(timeout=10.0)
    assert node.returncode == 0 and "Traceback" not in output, output
