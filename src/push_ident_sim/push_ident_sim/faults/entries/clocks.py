"""Faults of time."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from push_ident.cli.supervisor import node_commands
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import stamp_from_msg, stamp_to_msg
from push_ident.pushing.push import PushCode
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.cell import ARM_CELL
from push_ident_sim.faults.harness.monitor import Monitor, until
from push_ident_sim.faults.harness.process import Process
from push_ident_sim.faults.harness.proxy import PASS, Rule, changed

__all__ = ["FAULTS"]

_STAMPED: Final = ("joint_states", "pusher/wrench", "objects/truth/pose")
_BACK: Final = 3.0
"""How far time goes back [s]."""


def _shifted(change: Callable[[float], float]) -> Callable[[str], Rule]:
    """A rule for every topic that has a time: stamps go through `change` [s]."""

    def stamped(msg: Any) -> Any:
        msg.header.stamp = stamp_to_msg(max(0.0, change(stamp_from_msg(msg.header.stamp))))
        return msg

    def clock(msg: Any) -> Any:
        msg.clock = stamp_to_msg(max(0.0, change(stamp_from_msg(msg.clock))))
        return msg

    def rule(topic: str) -> Rule:
        if topic in _STAMPED:
            return changed(topic, stamped)
        return changed(topic, clock) if topic == "/clock" else PASS

    return rule


def _back(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    since = cell.proxy.set_all(_shifted(lambda stamp: stamp - _BACK))
    result = cell.end(sent)
    trial.expect_hold(since)
    trial.expect(result.error_code == PushCode.TRACKING, f"the push ended with {result.error_code} {result.error_text}")

    def new_run() -> bool:
        report = cell.monitor.report_of("identification_node")
        return report is not None and int(report.values.get("time jumps", "0")) > 0

    trial.expect_soon(new_run, 4.0, "identification reports no new run")
    trial.note, trial.lost = result.error_text, "the push under way; models are kept"


def _clock_only(trial: Trial, change: Callable[[float], float]) -> None:
    """`/clock` alone is wrong; the stamps of the sensors are right."""
    cell = trial.cell
    sent = cell.begin()
    since = cell.proxy.set("/clock", _shifted(change)("/clock"))
    result = cell.end(sent)
    if result.error_code:
        trial.expect_hold(since, detect=1.0)
        trial.lost = "the push under way"
    trial.expect(result.error_code in (PushCode.NONE, PushCode.TRACKING), f"the push ended with {result.error_code} {result.error_text}")
    trial.note = result.error_text or "the push was made: stamps of the arm time it"


def _slow(trial: Trial) -> None:
    started = stamp_from_msg(trial.cell.proxy.latest("/clock").clock)
    _clock_only(trial, lambda stamp: started + 0.5 * (stamp - started))


def _no_clock(trial: Trial) -> None:
    """Nodes that wait for simulated time, with nobody to give it."""
    domain = own_domain()
    monitor = Monitor(domain)
    names = ("perception_node", "push_executor_node", "identification_node")
    chosen = [c for c in node_commands("sim", log_level="info") if c.name in names]
    processes = [Process(c, trial.folder / f"{c.name}.log", {"ROS_DOMAIN_ID": str(domain)}) for c in chosen]
    try:
        for name in names:
            until(partial(monitor.report_of, name), 20.0, f"nothing came from {name}")
            first = time.monotonic()
            trial.expect_soon(partial(_says, monitor, name, "/clock"), 5.0, f"{name} does not name /clock")
            trial.note = f"the last one after {time.monotonic() - first:.1f} s"
    finally:
        for process in processes:
            process.interrupt()
        monitor.close()


def _says(monitor: Monitor, node: str, word: str) -> bool:
    report = monitor.report_of(node)
    return report is not None and word in f"{report.message} {report.values}"


FAULTS: Final = (
    Fault(
        number=8,
        name="time-goes-back",
        what=f"all stamps and /clock go back by {_BACK:.0f} s in the middle of a push, as a bag in a loop",
        holds="the watch over the arm; the cutter of identification",
        expected="held; buffers cleared, a new run, models kept",
        run=_back,
        cell=ARM_CELL,
        within=0.0,
    ),
    Fault(
        number=9,
        name="no-clock",
        what="use_sim_time is set and nobody publishes /clock",
        holds="timers on the wall clock",
        expected="every node names /clock within 5 s",
        run=_no_clock,
    ),
    Fault(
        number=39,
        name="clock-slow",
        what="/clock runs at half speed during a push",
        holds="motions are timed by the arm's own stamps",
        expected="the push is made, or aborted and held",
        run=_slow,
        cell=ARM_CELL,
    ),
    Fault(
        number=40,
        name="clock-jumps",
        what="/clock jumps by 1000 s during a push",
        holds="motions are timed by the arm's own stamps",
        expected="the push is made, or aborted and held",
        run=lambda trial: _clock_only(trial, lambda stamp: stamp + 1000.0),
        cell=ARM_CELL,
    ),
)
