"""What sensors say is not true."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from system.faults.suite import Trial, fault

from push_ident.pushing.push import PushCode


def push_under_false_states(trial: Trial, lie: Callable[[Any], None]) -> None:
    """A push during which joint states are changed by `lie`: that ends it, and no joint is too fast."""
    cell = trial.cell
    sent = cell.begin()
    since = cell.proxy.change("joint_states", lie)
    result = cell.end(sent)
    trial.expect_hold(since)
    trial.expect_speed(since)
    trial.expect_code(result, PushCode.TRACKING)


def turn(msg: Any) -> None:
    msg.position[0] += 0.3


def repeating(*fields: str) -> Callable[[Any], None]:
    """These fields stay as in the first message."""
    kept: list[Any] = []

    def repeat(msg: Any) -> None:
        kept.append(msg)
        for name in fields:
            setattr(msg, name, getattr(kept[0], name))

    return repeat


def first(n: int, change: Callable[[Any], None]) -> Callable[[Any], None]:
    left = iter(range(n))
    return lambda msg: None if next(left, None) is None else change(msg)


@fault(
    62,
    "joint 1 is reported 0.3 rad off in four joint states during a push",
    "TRACKING; held, no joint beyond its limit",
    within=0.05,
)
def test_states_offset(trial: Trial) -> None:
    push_under_false_states(trial, first(4, turn))


@fault(63, "the names of two joints are swapped during a push", "TRACKING; held, no joint beyond its limit", within=0.05)
def test_states_swapped(trial: Trial) -> None:
    def swap(msg: Any) -> None:
        names = list(msg.name)
        names[1], names[3] = names[3], names[1]
        msg.name = names

    push_under_false_states(trial, swap)


@fault(
    64,
    "joint states repeat one posture with new stamps during a push",
    "TRACKING; it stands on its path soon, and is not pulled back",
    within=0.3,
)
def test_states_frozen(trial: Trial) -> None:
    push_under_false_states(trial, repeating("position"))


@fault(65, "pusher/wrench saturates at 1e6 N during a push, and stays so", "FORCE; held at once; the next push is refused")
def test_force_saturated(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    since = cell.proxy.change("pusher/wrench", lambda msg: setattr(msg.wrench.force, "x", 1e6))
    result = cell.end(sent)
    trial.expect_hold(since)
    trial.expect_code(result, PushCode.FORCE, says="cannot be trusted")
    refused = cell.push()
    assert refused.error_code == PushCode.FORCE and refused.push_id == 0, f"the next push gave {refused.error_code}"


@fault(66, "the last wrench is repeated with its stamp", "FORCE within the time-out of the wrench", within=1.1)
def test_wrench_repeated(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    since = cell.proxy.change("pusher/wrench", repeating("header", "wrench"))
    result = cell.end(sent)
    trial.expect_hold(since)
    trial.expect_code(result, PushCode.FORCE)


@fault(
    69,
    "joint 1 is reported 0.3 rad off from after one push until after the next was requested",
    "TRACKING; no joint beyond its limit; the next push is made once they are right",
)
def test_states_wrong_before(trial: Trial) -> None:
    cell = trial.cell
    cell.whole_push()
    since = cell.proxy.change("joint_states", turn)
    time.sleep(1.5)  # a jump is believed after a second: the arm may have been moved
    result = cell.push()
    trial.expect_speed(since)
    trial.expect_code(result, PushCode.TRACKING, says="not believed")
    cell.proxy.clear()
    time.sleep(1.5)
    assert cell.push().error_code == PushCode.NONE, "no push was made once the states were right again"
