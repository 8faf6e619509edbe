"""Faults of the arm and of the node that moves it."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
from builtin_interfaces.msg import Duration
from std_msgs.msg import String
from system.faults.cell import EXECUTOR
from system.faults.proxy import drop
from system.faults.suite import Trial, fault
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from push_ident.cli.supervisor import NodeCommand
from push_ident.pushing.push import PushCode
from push_ident.types import Float64Array
from push_ident_sim.cell.robot import JOINT_NAMES, robot_description

KILLS = int(os.environ.get("KILLS", "1"))
"""How often a node is killed at a random moment of a push; `make faults` sets 20."""
LASTS = 0.5
"""Of the motion of a push [s]."""
BY_HAND = 0.3
"""How far the arm is moved while it is not heard [rad]: fifteen times the start tolerance."""


@fault(15, "joint states stop during a push (arm_timeout 0.1 s)", "aborted; held within 100 ms of the last joint state", within=0.1)
def test_arm_silent(trial: Trial) -> None:
    cell = trial.cell
    with cell.with_parameter(EXECUTOR, "arm_timeout", 0.1, usual=0.5):
        sent = cell.begin()
        since = cell.proxy.set("joint_states", drop)
        result = cell.end(sent)
        trial.expect_hold(since)
        cell.proxy.clear()
    trial.expect_code(result, PushCode.ARM_SILENT)


def turned(q: Float64Array, seconds: float) -> JointTrajectory:
    """A trajectory that another commander sends: the first joint turns by `BY_HAND` from `q` [rad]."""
    aim = q + np.eye(len(q))[0] * BY_HAND
    point = JointTrajectoryPoint(positions=aim.tolist(), velocities=[0.0] * len(q))
    point.time_from_start = Duration(sec=int(seconds), nanosec=int(1e9 * (seconds % 1)))
    return JointTrajectory(joint_names=list(JOINT_NAMES), points=[point])


@fault(
    16, f"the arm is moved by {BY_HAND} rad while its states are not heard", "the next push succeeds without a jump", only_executor=False
)
def test_arm_moved_by_hand(trial: Trial) -> None:
    cell = trial.cell
    cell.proxy.set("joint_states", drop)
    cell.monitor.publish("joint_trajectory", turned(cell.monitor.states()[-1].q, 1.0))
    time.sleep(1.5)
    cell.monitor.withdraw()
    time.sleep(1.0)  # until the executor has seen that nobody else commands the arm
    since = time.monotonic()
    cell.proxy.clear()
    time.sleep(0.2)
    trial.expect_code(cell.push(), PushCode.NONE)
    trial.expect_speed(since)


@fault(17, "a second executor starts during a push", "the second ends with one line; the push goes on")
def test_two_executors(trial: Trial) -> None:
    cell = trial.cell
    # The second one loads for a second or two, which takes a processor from this machine.
    with cell.with_parameter(EXECUTOR, "arm_timeout", 1.0, usual=0.5):
        sent = cell.begin()
        command = NodeCommand("second_executor", (*cell.processes[EXECUTOR].command.argv, "-r", "__node:=second_executor"), is_node=True)
        with cell.with_process(command) as second:
            assert second.wait(20.0) == 1
            assert "executor" in second.output and "stop it first" in second.output
        trial.expect_code(cell.end(sent), PushCode.NONE)


@fault(20, "500 N on pusher/wrench during a push", "FORCE; held at once")
def test_force(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    since = cell.proxy.change("pusher/wrench", lambda msg: setattr(msg.wrench.force, "x", 500.0))
    result = cell.end(sent)
    trial.expect_hold(since)
    trial.expect_code(result, PushCode.FORCE)


@fault(24, "Ctrl-C to the executor during a push", "held; exit 0 within 2 s, no traceback")
def test_interrupt(trial: Trial) -> None:
    cell = trial.cell
    cell.begin()
    process = cell.processes[EXECUTOR]
    since = process.signal(signal.SIGINT)
    assert process.wait(2.0 + cell.monitor.stalls.worst) == 0, "no exit code 0 within 2 s"
    trial.expect_hold(since)
    cell.recover()


@fault(26, f"SIGKILL to the executor at a random moment of a push ({KILLS} times)", "the arm stands within 100 ms and braking")
def test_executor_killed(trial: Trial) -> None:
    cell = trial.cell
    for moment in np.random.default_rng(0).uniform(0.0, LASTS, KILLS):
        cell.begin(after=moment)
        trial.expect_hold(cell.processes[EXECUTOR].kill())
        cell.recover()
    summarise(trial)


@fault(
    36,
    f"SIGSTOP to the executor at a random moment of a push, SIGCONT seconds later ({KILLS} times)",
    "the arm stands within 100 ms and braking, and does not go on",
)
def test_executor_frozen(trial: Trial) -> None:
    cell = trial.cell
    for moment in np.random.default_rng(1).uniform(0.0, LASTS, KILLS):
        sent = cell.begin(after=moment)
        process = cell.processes[EXECUTOR]
        trial.expect_hold(process.signal(signal.SIGSTOP))
        woken = process.signal(signal.SIGCONT)
        assert cell.end(sent).error_code != 0, "the push was reported as made"
        time.sleep(0.5)
        states = cell.monitor.states(woken)
        moved = max(float(abs(state.q - states[0].q).max()) for state in states)
        assert moved < 0.02, f"the arm moved by {moved:.3f} rad when the executor went on"
        cell.recover()
    summarise(trial)


def summarise(trial: Trial) -> None:
    latest, furthest = (max(getattr(hold, name) for hold in trial.holds) for name in ("seconds", "tool_moved"))
    trial.note = f"{len(trial.holds)} of {KILLS}: at most {1e3 * latest:.0f} ms and {1e3 * furthest:.0f} mm of the tool"


@fault(28, "another robot_description during a push, then a cancel", "held at once, in the arm's own joint names")
def test_description_changed(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin(after=0.05)
    cell.monitor.publish("robot_description", String(data=robot_description().replace(JOINT_NAMES[0], "another_joint")))
    since = time.monotonic()
    sent.handle.cancel_goal_async()
    trial.expect_hold(since)
    cell.end(sent)
    cell.monitor.publish("robot_description", String(data=robot_description()))
    cell.whole_push()


@fault(35, "the client cancels during a push", "CANCELED; held at once")
def test_cancel(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    since = time.monotonic()
    sent.handle.cancel_goal_async()
    trial.expect_hold(since)
    trial.expect_code(cell.end(sent), PushCode.CANCELED)


@fault(
    37,
    "another node commands the arm during a push",
    "back on the path within the tolerance, or aborted and held",
    within=0.3,
    only_executor=False,
)
def test_other_commander(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin(after=0.05)
    since = cell.monitor.publish("joint_trajectory", turned(cell.monitor.states()[-1].q, 0.5))
    result = cell.end(sent)
    if result.error_code == PushCode.NONE:
        trial.note = "the next piece took the arm back before the tool left its tolerance; the push was made"
        return
    trial.expect_hold(since)
    trial.expect_code(result, PushCode.TRACKING, PushCode.BUSY)
