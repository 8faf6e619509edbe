"""What is said to push_executor_node is not true: it holds the arm, says why, and never moves it because of that."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from helpers.corrupted_states import shares_of_commands
from helpers.executor_cell import CONTACT, PARKED, QUICK, Cell, begin_push, send, start_node, wait_for, wait_until_ready
from push_ident.pushing.motion import MotionSettings, joint_limits
from push_ident.pushing.push import PushCode

pytestmark = pytest.mark.alone

Lie = Callable[[JointState], None]
MOTION = MotionSettings(home=tuple(PARKED), max_joint_velocity=QUICK["max_joint_velocity"])
LONG_PUSH = {"distance": 0.12, "speed": 0.1}


@pytest.fixture(scope="module")
def node(domain: int, the_cell: Cell) -> Iterator[subprocess.Popen[str]]:
    process = start_node(domain, stamp_commands=True)
    try:
        wait_until_ready(the_cell)
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def cell(node: subprocess.Popen[str], the_cell: Cell) -> Cell:
    the_cell.reset()
    the_cell.box[0] = 0.06  # room for the longest push
    time.sleep(0.3)
    return the_cell


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


def frozen() -> Lie:
    kept: list[object] = []

    def change(state: JointState) -> None:
        kept.append(kept[0] if kept else list(state.position))
        state.position = kept[0]

    return change


LIES = {
    "joint 1 for 40 ms": lambda: few(4, turned(0, 0.3)),
    "joint 1 twice": lambda: few(2, turned(0, 0.3)),
    "wrist by 0.05 rad": lambda: few(2, turned(6, 0.05)),
    "a spike": lambda: few(1, turned(1, 1.5)),
    "names swapped for 40 ms": lambda: few(4, swapped),
    "names swapped": lambda: swapped,
    "encoders frozen": frozen,
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_joint_states_that_are_not_true_end_the_push_and_break_no_limit(cell: Cell, lie: Callable[[], Lie]) -> None:
    call = begin_push(cell, **LONG_PUSH)
    start = cell.states[0][1]
    cell.lie, began = lie(), time.monotonic()
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


def test_states_that_are_wrong_from_one_push_to_the_next_move_the_arm_slowly_and_are_believed_when_they_are_right(cell: Cell) -> None:
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


@pytest.mark.parametrize("force", [1e6, float("nan")])
def test_force_that_cannot_be_trusted_ends_the_push_and_refuses_the_next(cell: Cell, force: float) -> None:
    call = begin_push(cell, **LONG_PUSH)
    cell.force, since = force, time.monotonic()
    result = call.end()
    assert result.error_code == PushCode.FORCE and "cannot be trusted" in result.error_text
    wait_for(lambda: cell.holds)
    assert cell.holds[0][0] - since < 0.3
    n_commands = len(cell.commands)
    refused = send(cell, **CONTACT).end()
    assert refused.error_code == PushCode.FORCE and "force" in refused.error_text and len(cell.commands) == n_commands
    cell.force = 1.0
    wait_for(lambda: send(cell, dry_run=True, **CONTACT).end().error_code == 0)


def test_wrench_that_repeats_itself_counts_as_silent(cell: Cell) -> None:
    call = begin_push(cell, **LONG_PUSH)
    cell.felt_at = cell.get_clock().now().to_msg()
    result = call.end()
    assert result.error_code == PushCode.FORCE and "no force that can be trusted" in result.error_text
    assert send(cell, **CONTACT).end().error_code == PushCode.FORCE


def test_object_whose_place_is_uncertain_is_not_pushed(cell: Cell) -> None:
    cell.pose_variance = 1.0
    time.sleep(0.2)
    result = send(cell, **CONTACT).end()
    assert result.error_code == PushCode.UNKNOWN_OBJECT and "too uncertain" in result.error_text and result.push_id == 0
    cell.pose_variance = 1e-6
    wait_for(lambda: send(cell, dry_run=True, **CONTACT).end().error_code == 0)
    call = begin_push(cell)
    cell.pose_variance = 1.0
    result = call.end()
    assert result.error_code == PushCode.NO_CONTACT and "no more than its poses are uncertain" in result.error_text


def test_recorder_that_is_stopped_ends_the_push_and_refuses_the_next(cell: Cell, domain: int, tmp_path: Path) -> None:
    recorder = subprocess.Popen(
        [sys.executable, "-m", "push_ident.nodes", "bag_recorder_node", "--ros-args", "-p", f"bag:={tmp_path / 'bag'}"],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain)},
    )
    try:
        wait_for(lambda: cell.recorded)
        time.sleep(1.2)  # twice its period
        call = begin_push(cell, distance=0.12, speed=0.04)
        recorder.send_signal(signal.SIGSTOP)
        result = call.end()
        assert result.error_code == PushCode.RECORDING and "fell silent" in result.error_text
        assert send(cell, **CONTACT).end().error_code == PushCode.RECORDING
        recorder.send_signal(signal.SIGCONT)
        wait_for(lambda: send(cell, dry_run=True, **CONTACT).end().error_code == 0)
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(20.0) == 0
        time.sleep(2.5)
        assert send(cell, **CONTACT).end().error_code == 0, "nobody asks for a recording any more"
    finally:
        recorder.send_signal(signal.SIGCONT)
        recorder.kill()
        recorder.wait(5.0)
