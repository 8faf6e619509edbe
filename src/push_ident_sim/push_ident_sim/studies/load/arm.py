"""The arm while everything around it is overloaded: how often its commands come, and how fast it holds."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.nodes.base.settings import NODE
from push_ident_sim.faults.harness.cell import ARM_CELL, Cell, live_cell
from push_ident_sim.faults.harness.hold import measure_hold
from push_ident_sim.faults.harness.priority import set_priority, urgent
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.load.bench import delays, source_of

__all__ = ["CASES", "measure_arm"]

CASES: Final = {"quiet": "quiet", "loaded": "overloaded", "equal": "overloaded, all of one priority"}
"""Of `measure_arm`, with their names in tables."""
_N_PUSHES: Final = 4
_LOAD: Final = (("camera", 60.0, 10), ("streams", 1000.0, 3))
_SPINNERS: Final = 2
"""Processes that only compute, at the priority of the nodes that give way."""
_SETTLE: Final = 4.0
"""After the load has started [s]."""
_PAUSE: Final = 0.25
"""Commands further apart than this belong to two motions [s]."""
_SPIN: Final = "while True: pass"


def measure_arm(folder: Path, domain: int, case: str) -> Json:
    """Pushes that are cancelled in the middle, in a quiet or in an overloaded cell."""
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    with urgent(), live_cell(ARM_CELL, folder / f"arm-{case}") as cell:
        if case != "quiet":
            _overload(cell, equal=case == "equal")
        pushes = [_cancelled_push(cell, 1 if i % 2 else -1) for i in range(_N_PUSHES)]
        gaps = [gap for push in pushes for gap in push["gaps_s"]]
        holds = [push["hold_s"] for push in pushes if push["hold_s"] is not None]
        return {
            "case": case,
            "period": delays(gaps),
            "gaps_s": gaps,
            "hold": delays(holds),
            "holds_s": holds,
            "not_held": len(pushes) - len(holds),
            "stall_s": max(push["stall_s"] for push in pushes),
            "load": os.getloadavg()[0],
        }


def _overload(cell: Cell, *, equal: bool) -> None:
    # All of it in a namespace of its own: it takes processors, and stands in the way of no push.
    commands = [source_of(kind, [rate], n) for kind, rate, n in _LOAD]
    commands = [replace(command, argv=(*command.argv, "--ros-args")) for command in commands]
    commands += [c for c in node_commands("arm", log_level="warn") if c.name in ("perception_node", "identification_node")]
    commands = [replace(c, name=f"load_{c.name}", argv=(*c.argv, "-r", "__ns:=/load")) for c in commands]
    commands += [NodeCommand(f"spinner{i}", (sys.executable, "-c", _SPIN)) for i in range(_SPINNERS)]
    for command in commands:
        cell.add(command)
    time.sleep(_SETTLE)
    if equal:
        for process in cell.processes.values():
            set_priority(process.pid, os.getpriority(os.PRIO_PROCESS, 0))
    else:
        # A driver that takes the processor from everything is no matter of the nodes of the suite.
        for command in commands:
            set_priority(cell.processes[command.name].pid, NODE.niceness)


def _cancelled_push(cell: Cell, side: int) -> Json:
    monitor = cell.monitor
    cell.recover()
    monitor.forget()
    sent = cell.begin(cell.goal(side), after=0.15)
    stall = monitor.stall
    asked = time.monotonic()
    sent.handle.cancel_goal_async()
    hold = measure_hold(monitor, asked, 0.0)
    came = np.array([received for received, _ in list(monitor.commands) if received <= asked])
    gaps = np.diff(came)
    cell.end(sent)
    return {"gaps_s": gaps[gaps < _PAUSE].tolist(), "hold_s": hold.seconds, "stall_s": max(stall, monitor.stall)}
