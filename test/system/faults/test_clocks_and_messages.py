"""Faults of time, and of how messages arrive."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from system.faults.cell import EXECUTOR, IDENTIFICATION
from system.faults.monitor import until
from system.faults.proxy import OBJECT_POSE, Rule, duplicated, lossy, reordered
from system.faults.suite import Trial, fault

from helpers.wrong_poses import wrong_poses
from push_ident.nodes.convert.messages import stamp_from_msg, stamp_to_msg
from push_ident.pushing.push import PushCode

BACK = 3.0
"""How far time goes back [s]."""
SENSORS = ("joint_states", "pusher/wrench", OBJECT_POSE)


def shifted(change: Callable[[float], float]) -> Callable[[Any], None]:
    def shift(msg: Any) -> None:
        owner, name = (msg, "clock") if hasattr(msg, "clock") else (msg.header, "stamp")
        setattr(owner, name, stamp_to_msg(max(0.0, change(stamp_from_msg(getattr(owner, name))))))

    return shift


# its commands are stamped by the wrong clock
@fault(
    8,
    f"all stamps and /clock go back by {BACK:.0f} s during a push, as a bag in a loop",
    "held; buffers cleared, a new run, models kept",
    only_executor=False,
)
def test_time_goes_back(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    since = [cell.proxy.change(topic, shifted(lambda stamp: stamp - BACK)) for topic in ("/clock", *SENSORS)][-1]
    result = cell.end(sent)
    trial.expect_hold(since)
    trial.expect_code(result, PushCode.TRACKING)
    trial.expect_report(IDENTIFICATION, "time jumps", since=since)
    assert int(cell.monitor.reports_of(IDENTIFICATION)[-1].values["time jumps"]) > 0, "identification reports no new run"


@fault(40, "/clock runs at half speed during a push; it jumps by 1000 s during the next", "made, or aborted and held", within=1.0)
def test_clock_wrong(trial: Trial) -> None:
    cell = trial.cell
    for number in range(2):
        sent = cell.begin()
        began = stamp_from_msg(cell.proxy.latest("/clock").clock)
        since = cell.proxy.change("/clock", shifted((lambda stamp: began + 0.5 * (stamp - began), lambda stamp: stamp + 1000.0)[number]))  # noqa: B023
        result = cell.end(sent)
        if result.error_code != PushCode.NONE:
            trial.expect_hold(since)
        trial.expect_code(result, PushCode.NONE, PushCode.TRACKING)
        cell.recover()


@fault(
    44,
    "every message of the sensors comes twice; up to 50 ms late and out of order; 30 % are lost: a push under each",
    "made, or aborted and held",
)
def test_messages_in_disorder(trial: Trial) -> None:
    cell = trial.cell
    rules: tuple[Callable[[], Rule], ...] = (lambda: duplicated, lambda: reordered(0.05), lambda: lossy(0.3))
    for rule in rules:
        for topic in (*SENSORS, "pusher/pose"):
            cell.proxy.set(topic, rule())
        result = cell.push()
        time.sleep(0.5)
        assert not cell.is_moving(), "the arm still moves"
        # A push with poses that lag may graze the object only.
        ended = (PushCode.ARM_SILENT, PushCode.TRACKING, PushCode.FORCE, PushCode.OBJECT_LOST, PushCode.NO_CONTACT)
        trial.expect_code(result, PushCode.NONE, *ended)
        cell.recover()


@fault(
    27,
    "poses with NaN, zero, negative or infinite values, wrong frames and markup, during a push",
    "refused, counted and named; the push goes on",
)
def test_impossible_poses(trial: Trial) -> None:
    cell = trial.cell
    before = {node: cell.monitor.reports_of(node)[-1].refused for node in (EXECUTOR, IDENTIFICATION)}
    sent = cell.begin()
    since, poses = time.monotonic(), wrong_poses()
    for msg in poses.values():
        assert isinstance(msg, PoseWithCovarianceStamped)
        cell.monitor.publish(OBJECT_POSE, msg)
        time.sleep(0.1)  # the executor keeps the latest few only
    trial.expect_code(cell.end(sent), PushCode.NONE)
    for node, refused in before.items():

        def counted(node: str = node, refused: int = refused) -> bool:
            reports = cell.monitor.reports_of(node, since)
            return bool(reports) and reports[-1].refused - refused >= len(poses)

        until(counted, 4.0, f"{node} has not counted {len(poses)} refusals")
    trial.expect_report(IDENTIFICATION, OBJECT_POSE, since=since)
