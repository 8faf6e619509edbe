"""What the sensors of the arm say is not true."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from typing import Any, Final

from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.pushing.push import PushCode
from push_ident_msgs.action import ExecutePush
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.cell import ARM_CELL, OBJECT_POSE
from push_ident_sim.faults.harness.monitor import until
from push_ident_sim.faults.harness.oracles import learned_pushes
from push_ident_sim.faults.harness.proxy import changed

__all__ = ["FAULTS"]

_FASTEST: Final = 1.3
"""Default of the executor's `max_joint_velocity` [rad/s]."""
_IDENTIFICATION: Final = "identification_node"
_RECORDER: Final = "bag_recorder_node"


def _expect_code(trial: Trial, result: ExecutePush.Result, code: PushCode, *words: str) -> None:
    trial.expect(result.error_code == code, f"the push ended with {result.error_code} ({result.error_text}), expected {code.name}")
    trial.expect(all(word in result.error_text for word in words), f"{result.error_text!r} does not say {', '.join(words)}")
    trial.note = trial.note or result.error_text[:120]


def _lying(topic: str, lie: Callable[[Any], Any]) -> Callable[[Trial], None]:
    """A push during which the messages of a topic are changed by `lie`; joint states that are not true end it, and no joint is too fast."""

    def run(trial: Trial) -> None:
        cell = trial.cell
        sent = cell.begin()
        since = cell.proxy.set(topic, changed(topic, lie))
        result = cell.end(sent)
        trial.expect_hold(since)
        cell.proxy.clear()
        speeds = [float(abs(state.velocity).max()) for state in cell.monitor.states(since)]
        trial.expect(max(speeds) < 1.02 * _FASTEST, f"a joint turned at {max(speeds):.2f} rad/s, limit {_FASTEST} rad/s")
        _expect_code(trial, result, PushCode.TRACKING)
        trial.lost = "the push under way"

    return run


def _offset_for_40_ms() -> Callable[[Any], Any]:
    left = [4]

    def lie(msg: Any) -> Any:
        left[0] -= 1
        if left[0] >= 0:
            msg.position[0] += 0.3
        return msg

    return lie


def _swapped(msg: Any) -> Any:
    names = list(msg.name)
    names[1], names[3] = names[3], names[1]
    msg.name = names
    return msg


def _frozen() -> Callable[[Any], Any]:
    kept: list[Any] = []

    def lie(msg: Any) -> Any:
        kept.append(msg)
        msg.position = kept[0].position
        return msg

    return lie


def _force_saturated(trial: Trial) -> None:
    cell = trial.cell

    def saturated(msg: Any) -> Any:
        msg.wrench.force.x = 1e6
        return msg

    sent = cell.begin()
    since = cell.proxy.set("pusher/wrench", changed("pusher/wrench", saturated))
    result = cell.end(sent)
    trial.expect_hold(since)
    _expect_code(trial, result, PushCode.FORCE, "cannot be trusted")
    refused = cell.push()
    trial.expect(refused.error_code == PushCode.FORCE and refused.push_id == 0, f"the next push gave {refused.error_code}, expected FORCE")
    trial.lost = "the push under way"


def _wrench_repeated(trial: Trial) -> None:
    cell = trial.cell
    kept: list[Any] = []

    def repeated(msg: Any) -> Any:
        kept.append(msg)
        return kept[0]

    sent = cell.begin()
    since = cell.proxy.set("pusher/wrench", changed("pusher/wrench", repeated))
    result = cell.end(sent)
    trial.expect_hold(since)
    _expect_code(trial, result, PushCode.FORCE)
    trial.lost = "the push under way"


def _recorder_stopped(trial: Trial) -> None:
    cell = trial.cell
    command = next(c for c in node_commands("sim", record=trial.folder / "bag") if c.name == _RECORDER)
    recorder = cell.add(NodeCommand(_RECORDER, command.argv))
    try:
        until(lambda: cell.monitor.report_of(_RECORDER), 20.0, "the recorder reports nothing")
        trial.wait(1.5)
        recorder.signal(signal.SIGSTOP)
        ended = [cell.push() for _ in range(2)]
        recorder.signal(signal.SIGCONT)
        for result in ended:
            _expect_code(trial, result, PushCode.RECORDING)
        trial.wait(1.5)
        trial.expect(cell.push().error_code == PushCode.NONE, "no push was made after the recorder went on")
    finally:
        cell.remove(_RECORDER)
    trial.lost = "the push under way"


def _pose_uncertain(trial: Trial) -> None:
    cell = trial.cell

    def uncertain(msg: Any) -> Any:
        msg.pose.covariance[0] = msg.pose.covariance[7] = 1.0
        return msg

    cell.proxy.set(OBJECT_POSE, changed(OBJECT_POSE, uncertain))
    trial.wait(0.5)
    refused = cell.push()
    cell.proxy.clear()
    _expect_code(trial, refused, PushCode.UNKNOWN_OBJECT, "too uncertain")
    trial.expect(refused.push_id == 0, "the arm moved")
    trial.wait(0.5)
    cell.whole_push()


def _wrong_since_the_last_push(trial: Trial) -> None:
    cell = trial.cell
    cell.whole_push()

    def lie(msg: Any) -> Any:
        msg.position[0] += 0.3
        return msg

    since = cell.proxy.set("joint_states", changed("joint_states", lie))
    time.sleep(1.5)  # a jump is believed after a second: the arm may have been moved
    result = cell.push()
    speeds = [float(abs(state.velocity).max()) for state in cell.monitor.states(since)]
    trial.expect(max(speeds) < 1.02 * _FASTEST, f"a joint turned at {max(speeds):.2f} rad/s, limit {_FASTEST} rad/s")
    _expect_code(trial, result, PushCode.TRACKING, "not believed")
    cell.proxy.clear()
    trial.wait(1.5)
    trial.expect(cell.push().error_code == PushCode.NONE, "no push was made once the states were right again")


def _pose_aside(trial: Trial) -> None:
    cell = trial.cell

    def aside(msg: Any) -> Any:
        msg.pose.pose.position.x += 0.25
        return msg

    sent = cell.begin()
    since = cell.proxy.set(OBJECT_POSE, changed(OBJECT_POSE, aside))
    result = cell.end(sent)
    _expect_code(trial, result, PushCode.OBJECT_LOST)
    cell.proxy.clear()
    trial.expect((learned_pushes(cell) or 0) == trial.learned, "the push was learned")
    trial.wait(0.5)
    cell.whole_push(cell.goal(-1))
    trial.expect_soon(lambda: (learned_pushes(cell) or 0) > trial.learned, 15.0, "the push after it was not learned")
    reports = cell.monitor.reports_of(_IDENTIFICATION, since)
    worse = [r.message for r in reports if "far worse" in r.message]
    trial.expect(not worse, f"identification says {worse[:1]}")
    trial.lost = "the push under way"


def _pose_excursion(trial: Trial) -> None:
    cell = trial.cell
    left = [12]

    def aside(msg: Any) -> Any:
        left[0] -= 1
        if left[0] >= 0:
            msg.pose.pose.position.x += 0.08
        return msg

    sent = cell.begin(cell.goal(distance=0.08, speed=0.1))
    since = cell.proxy.set(OBJECT_POSE, changed(OBJECT_POSE, aside))
    result = cell.end(sent)
    cell.proxy.clear()
    _expect_code(trial, result, PushCode.NONE)
    trial.expect_soon(lambda: (learned_pushes(cell) or 0) > trial.learned, 15.0, "the push was not learned")
    trial.expect_report(_IDENTIFICATION, "impossible poses, left out", since=since)
    trial.note = "12 poses left out, the push learned"


FAULTS: Final = (
    Fault(
        number=62,
        name="states-offset",
        what="joint 1 is reported 0.3 rad off in four joint states in the middle of a push",
        holds="each state is compared with what the arm was told; a hold ends that",
        expected="TRACKING; held, no joint beyond its limit",
        run=lambda trial: _lying("joint_states", _offset_for_40_ms())(trial),
        cell=ARM_CELL,
        within=0.05,
        fast=True,
    ),
    Fault(
        number=63,
        name="states-swapped",
        what="the names of two joints are swapped in the middle of a push",
        holds="each state is compared with what the arm was told; a hold ends that",
        expected="TRACKING; held, no joint beyond its limit",
        run=_lying("joint_states", _swapped),
        cell=ARM_CELL,
        within=0.05,
    ),
    Fault(
        number=64,
        name="states-frozen",
        what="joint states repeat one posture with new stamps in the middle of a push",
        holds="an arm that stands although it was told to go on gets nothing more until it has come to where its commands end",
        expected="TRACKING; it stands on its path soon, and is not pulled back",
        run=lambda trial: _lying("joint_states", _frozen())(trial),
        cell=ARM_CELL,
        within=0.3,
    ),
    Fault(
        number=65,
        name="force-saturated",
        what="pusher/wrench saturates at 1e6 N in the middle of a push, and stays so",
        holds="a force that cannot be trusted is a fault",
        expected="FORCE; held at once; the next push is refused",
        run=_force_saturated,
        cell=ARM_CELL,
        within=0.0,
    ),
    Fault(
        number=66,
        name="wrench-repeated",
        what="the last wrench is repeated with its stamp",
        holds="a stamp that was there before counts as silence",
        expected="FORCE within the time-out of the wrench",
        run=_wrench_repeated,
        cell=ARM_CELL,
        within=1.1,
    ),
    Fault(
        number=67,
        name="recorder-stopped",
        what="SIGSTOP to the recorder for two pushes",
        holds="the recorder says twice a second that it writes",
        expected="RECORDING for both; pushes again when it goes on",
        run=_recorder_stopped,
        cell=ARM_CELL,
    ),
    Fault(
        number=68,
        name="pose-uncertain",
        what="the covariance of the object's pose is 1 m²",
        holds="the place of an object must be known to a third of the clearance",
        expected="refused, saying so; nothing moves",
        run=_pose_uncertain,
        cell=ARM_CELL,
    ),
    Fault(
        number=72,
        name="pose-aside",
        what="the object's pose is 25 cm aside from the middle of a push to its end",
        holds="what a push can have made, by its pusher",
        expected="OBJECT_LOST; not learned; the next push is",
        run=_pose_aside,
        cell=ARM_CELL,
    ),
    Fault(
        number=73,
        name="pose-excursion",
        what="the object's pose is 8 cm aside for 0.4 s in the middle of a push",
        holds="poses that no object can follow are left out, and counted",
        expected="the push is made and learned without them",
        run=_pose_excursion,
        cell=ARM_CELL,
    ),
    Fault(
        number=69,
        name="states-wrong-before",
        what="joint 1 is reported 0.3 rad off from after one push until after the next was requested",
        holds="the arm is told slowly to stand where its states say that it stands; they move, so they are not true",
        expected="TRACKING; no joint beyond its limit; the next push is made once they are right",
        run=_wrong_since_the_last_push,
        cell=ARM_CELL,
    ),
)
