"""Faults of the arm and of the node that moves it."""

from __future__ import annotations

import signal
import time
from typing import Final

import numpy as np
from builtin_interfaces.msg import Duration
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from push_ident.cli.supervisor import NodeCommand
from push_ident.pushing.push import PushCode
from push_ident_msgs.action import ExecutePush
from push_ident_sim.cell.robot import JOINT_NAMES, robot_description
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.cell import ARM_CELL
from push_ident_sim.faults.harness.proxy import changed, drop

__all__ = ["FAULTS"]

_EXECUTOR: Final = "push_executor_node"
_FASTEST: Final = 1.3
"""Default of the executor's `max_joint_velocity` [rad/s]."""
_BY_HAND: Final = 0.3
"""How far the arm is moved while it is not heard [rad]: fifteen times the start tolerance."""


def _expect_code(trial: Trial, result: ExecutePush.Result, *codes: PushCode) -> None:
    names = " or ".join(code.name for code in codes)
    trial.expect(result.error_code in codes, f"the push ended with code {result.error_code} ({result.error_text}), expected {names}")
    trial.note = trial.note or result.error_text


def _arm_silent(trial: Trial) -> None:
    cell = trial.cell
    cell.set_parameter(_EXECUTOR, "arm_timeout", 0.1)
    try:
        sent = cell.begin()
        since = cell.proxy.set("joint_states", drop)
        result = cell.end(sent)
        trial.expect_hold(since)
    finally:
        cell.proxy.clear()
        cell.set_parameter(_EXECUTOR, "arm_timeout", 0.5)
    _expect_code(trial, result, PushCode.ARM_SILENT)
    trial.lost = "the push under way"


def _moved(q: np.ndarray, seconds: float) -> JointTrajectory:
    """A trajectory that another commander sends: the first joint turns by `_BY_HAND` from `q` [rad]."""
    aim = q + np.eye(len(q))[0] * _BY_HAND
    point = JointTrajectoryPoint(positions=aim.tolist(), velocities=[0.0] * len(q))
    point.time_from_start = Duration(sec=int(seconds), nanosec=int(1e9 * (seconds % 1)))
    return JointTrajectory(joint_names=list(JOINT_NAMES), points=[point])


def _arm_moved_by_hand(trial: Trial) -> None:
    cell = trial.cell
    cell.proxy.set("joint_states", drop)
    cell.monitor.publish("joint_trajectory", _moved(cell.monitor.states()[-1].q, 1.0))
    trial.wait(1.5)
    cell.monitor.withdraw()
    trial.wait(1.0)  # until the executor has seen that nobody else commands the arm
    since = time.monotonic()
    cell.proxy.clear()
    trial.wait(0.2)
    _expect_code(trial, cell.push(), PushCode.NONE)
    states = cell.monitor.states(since)
    fastest = max(float(abs(state.velocity).max()) for state in states)
    trial.expect(fastest < 1.2 * _FASTEST, f"a joint turned at {fastest:.2f} rad/s, limit {_FASTEST} rad/s: the arm jumped")
    trial.note = f"fastest joint {fastest:.2f} rad/s"


def _two_executors(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    first = cell.processes[_EXECUTOR]
    second = cell.add(NodeCommand("second_executor", (*first.command.argv, "-r", "__node:=second_executor")))
    try:
        code = second.wait(20.0)
        trial.expect(code == 1, f"the second executor ended with {code}, expected 1")
        trial.expect("executor" in second.output and "stop it first" in second.output, "the second executor does not say who has the arm")
        trial.note = second.output.strip().splitlines()[-1][-120:] if second.output else ""
    finally:
        cell.remove("second_executor")
    result = cell.end(sent)
    trial.note = "the first goes on"
    _expect_code(trial, result, PushCode.NONE)


def _other_commander(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin(after=0.05)
    since = cell.monitor.publish("joint_trajectory", _moved(cell.monitor.states()[-1].q, 0.5))
    result = cell.end(sent)
    if result.error_code == 0:
        trial.note = "the next piece took the arm back before the tool left its tolerance; the push was made"
        return
    trial.expect_hold(since)
    _expect_code(trial, result, PushCode.TRACKING, PushCode.BUSY)
    trial.lost = "the push under way"


def _force(trial: Trial) -> None:
    cell = trial.cell

    def stronger(msg: object) -> object:
        msg.wrench.force.x = 500.0  # type: ignore[attr-defined]
        return msg

    sent = cell.begin()
    since = cell.proxy.set("pusher/wrench", changed("pusher/wrench", stronger))
    result = cell.end(sent)
    trial.expect_hold(since)
    _expect_code(trial, result, PushCode.FORCE)
    trial.lost = "the push under way"


def _goals_out_of_reach(trial: Trial) -> None:
    cell = trial.cell
    commands = len(cell.monitor.commands)
    for changes in (
        {"frame_id": "table", "direction": float("nan")},
        {"distance": 3.0},
        {"speed": 30.0},
        {"frame_id": "no_such_frame"},
        {"object_id": "no_such_object"},
        {"mode": 77},
        {"distance": 0.24, "direction": 3.1},
    ):
        goal = cell.goal()
        for name, value in changes.items():
            setattr(goal, name, value)
        result = cell.push(goal)
        trial.expect(result.error_code < 0 and result.error_text, f"the goal with {changes} was not refused")
        trial.expect(result.push_id == 0, f"the goal with {changes} moved the arm")
    trial.expect(len(cell.monitor.commands) == commands, "the arm was commanded")
    trial.note = "7 goals refused, no command sent"


def _executor_killed(trial: Trial) -> None:
    cell = trial.cell
    cell.begin()
    since = cell.processes[_EXECUTOR].kill()
    trial.expect_hold(since)
    cell.recover()
    trial.lost = "the push under way"
    trial.note = f"a joint moved on by {trial.held.moved:.3f} rad" if trial.held else ""


def _executor_frozen(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    process = cell.processes[_EXECUTOR]
    since = process.signal(signal.SIGSTOP)
    try:
        trial.expect_hold(since)
    finally:
        woken = process.signal(signal.SIGCONT)
    result = cell.end(sent)
    trial.expect(result.error_code != 0, "the push was reported as made")
    trial.wait(0.5)
    states = cell.monitor.states(woken)
    moved = max((float(abs(s.q - states[0].q).max()) for s in states), default=0.0)
    trial.expect(moved < 0.02, f"the arm moved by {moved:.3f} rad when the executor went on")
    trial.note, trial.lost = result.error_text, "the push under way"


def _cancelled(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    since = time.monotonic()
    sent.handle.cancel_goal_async()
    trial.expect_hold(since)
    _expect_code(trial, cell.end(sent), PushCode.CANCELED)
    trial.lost = "the push under way"


def _description_changed(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin(after=0.05)
    text = robot_description().replace(JOINT_NAMES[0], "another_joint")
    cell.monitor.publish("robot_description", String(data=text))
    since = time.monotonic()
    sent.handle.cancel_goal_async()
    trial.expect_hold(since)
    cell.end(sent)
    cell.monitor.publish("robot_description", String(data=robot_description()))
    trial.lost = "the push under way"
    cell.whole_push()


def _interrupted(trial: Trial) -> None:
    cell = trial.cell
    cell.begin()
    process = cell.processes[_EXECUTOR]
    since = process.signal(signal.SIGINT)
    code = process.wait(5.0)
    took = time.monotonic() - since
    trial.expect(code == 0, f"exit code {code}, expected 0")
    trial.expect(took < 2.0, f"the process ended after {took:.1f} s, limit 2 s")
    trial.expect_hold(since)
    trial.note, trial.lost = f"ended after {took:.1f} s", "the push under way"
    cell.recover()


FAULTS: Final = (
    Fault(
        number=15,
        name="arm-silent",
        what="joint states stop in the middle of a push (arm_timeout 0.1 s)",
        holds="the watch over the moving arm",
        expected="aborted; held within 100 ms of the last joint state",
        run=_arm_silent,
        cell=ARM_CELL,
        within=0.1,
    ),
    Fault(
        number=16,
        name="arm-moved-by-hand",
        what=f"the arm is moved by {_BY_HAND} rad while its states are not heard",
        holds="the start tolerance; the push is planned from where the arm is",
        expected="the next push succeeds without a jump",
        run=_arm_moved_by_hand,
        cell=ARM_CELL,
    ),
    Fault(
        number=17,
        name="two-executors",
        what="a second executor starts during a push",
        holds="the lease of the arm",
        expected="the second ends with one line; the push goes on",
        run=_two_executors,
        cell=ARM_CELL,
    ),
    Fault(
        number=20,
        name="force",
        what="500 N on pusher/wrench in the middle of a push",
        holds="the watch over the moving arm",
        expected="FORCE; held at once",
        run=_force,
        cell=ARM_CELL,
        within=0.0,
    ),
    Fault(
        number=26,
        name="executor-killed",
        what="SIGKILL to the executor in the middle of a push",
        holds="short trajectories that end in a stop; a push without an end record is not learned",
        expected="the arm stands within 100 ms and braking",
        run=_executor_killed,
        cell=ARM_CELL,
        within=0.0,
        fast=True,
    ),
    Fault(
        number=28,
        name="description-changed",
        what="another robot_description in the middle of a push, then a cancel",
        holds="the description is fixed while the arm moves",
        expected="held at once, in the arm's own joint names",
        run=_description_changed,
        cell=ARM_CELL,
        within=0.0,
        fast=True,
    ),
    Fault(
        number=24,
        name="interrupt",
        what="Ctrl-C to the executor in the middle of a push",
        holds="the node's end holds the arm first",
        expected="held; exit 0 within 2 s, no traceback",
        run=_interrupted,
        cell=ARM_CELL,
        within=0.0,
    ),
    Fault(
        number=34,
        name="goals-out-of-reach",
        what="goals that are not finite, too long, too fast, of unknown objects, frames and modes",
        holds="checks before the motion",
        expected="each refused with a code; no command",
        run=_goals_out_of_reach,
        cell=ARM_CELL,
        fast=True,
    ),
    Fault(
        number=35,
        name="cancel",
        what="the client cancels in the middle of a push",
        holds="the watch over the moving arm",
        expected="CANCELED; held at once",
        run=_cancelled,
        cell=ARM_CELL,
        within=0.0,
        fast=True,
    ),
    Fault(
        number=36,
        name="executor-frozen",
        what="SIGSTOP to the executor in the middle of a push, SIGCONT seconds later",
        holds="short trajectories that end in a stop",
        expected="the arm stands within 100 ms and braking, and does not go on",
        run=_executor_frozen,
        cell=ARM_CELL,
        within=0.0,
    ),
    Fault(
        number=37,
        name="other-commander",
        what="another node commands the arm in the middle of a push",
        holds="pieces of the path that are sent again and again; the tracking tolerance of the watch",
        expected="back on the path within the tolerance, or aborted and held",
        run=_other_commander,
        cell=ARM_CELL,
        within=0.3,
    ),
)
