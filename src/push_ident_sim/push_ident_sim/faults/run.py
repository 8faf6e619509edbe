"""Runs faults one by one, those of one cell in the same cell, and checks the oracles after each."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from push_ident.errors import PushIdentError
from push_ident_sim.faults.fault import Fault, Impossible, Trial
from push_ident_sim.faults.harness import oracles
from push_ident_sim.faults.harness.cell import Cell, CellPlan, live_cell
from push_ident_sim.faults.harness.hold import Hold
from push_ident_sim.faults.harness.monitor import until
from push_ident_sim.faults.harness.priority import urgent

__all__ = ["FaultResult", "run_faults", "try_fault"]

_LEARNED: Final = 30.0
"""For identification to answer with a model [s]."""
_IDLE: Final = 15.0
"""For identification to learn or refuse what came before: a push without a record is refused after 10 s [s]."""
_IDENTIFICATION: Final = "identification_node"
_COUNTING: Final = (_IDENTIFICATION, "push_executor_node")
"""Nodes whose counts the faults read."""


@dataclass(frozen=True, slots=True)
class FaultResult:
    """What one trial gave."""

    fault: Fault
    failures: tuple[str, ...]
    """Empty: it held."""
    impossible: str
    """Why it could not be injected here; empty where it was."""
    hold: Hold | None
    lost: str
    note: str
    seconds: float
    """Of the trial."""

    @property
    def passed(self) -> bool:
        """Whether it was injected and held."""
        return not self.failures and not self.impossible


def run_faults(faults: Sequence[Fault], folder: Path, on_result: Callable[[FaultResult], None]) -> list[FaultResult]:
    """Run faults; cells are started as they are needed, and a cell that cannot push any more is replaced.

    Args:
        faults: in any order.
        folder: of logs and files.
        on_result: called after each.
    """
    results: list[FaultResult] = []

    def done(result: FaultResult) -> None:
        results.append(result)
        on_result(result)

    with urgent():
        _run_all(faults, folder, done)
    return sorted(results, key=lambda result: result.fault.number)


def _run_all(faults: Sequence[Fault], folder: Path, done: Callable[[FaultResult], None]) -> None:
    plans = list(dict.fromkeys(fault.cell for fault in faults))
    for plan in sorted(plans, key=lambda plan: "" if plan is None else plan.name):
        chosen = [fault for fault in faults if fault.cell == plan]
        if plan is None:
            for fault in chosen:
                done(try_fault(fault, None, folder))
        else:
            _run_in_cells(plan, chosen, folder, done)


def _run_in_cells(plan: CellPlan, faults: Sequence[Fault], folder: Path, done: Callable[[FaultResult], None]) -> None:
    left, number = list(faults), 0
    while left:
        number += 1
        with ExitStack() as stack:
            try:
                cell = stack.enter_context(live_cell(plan, folder / f"{plan.name}-{number}"))
            except PushIdentError as error:
                fault = left.pop(0)
                done(FaultResult(fault, (f"the cell did not start: {error}",), "", None, "", "", 0.0))
                continue
            while left:
                result = try_fault(left.pop(0), cell, folder)
                done(result)
                # After a failure nothing is known of the cell: its nodes, logs and model are left behind.
                if result.failures:
                    break


def try_fault(fault: Fault, cell: Cell | None, folder: Path) -> FaultResult:
    """One fault in a cell that can push, or without a cell."""
    trial = Trial(folder / fault.name, cell, fault.within)
    shutil.rmtree(trial.folder, ignore_errors=True)
    trial.folder.mkdir(parents=True)
    began, impossible = time.monotonic(), ""
    try:
        if cell is None:
            fault.run(trial)
        else:
            _in_cell(fault, trial, cell)
    except Impossible as error:
        impossible = str(error)
    except PushIdentError as error:
        trial.failures.append(str(error))
    except Exception as error:  # a fault of the suite itself must not hide the results of the others
        trial.failures.append(f"the check itself failed: {type(error).__name__}: {error}")
    took = time.monotonic() - began
    return FaultResult(fault, tuple(trial.failures), impossible, trial.held, trial.lost, trial.note, took)


def _learned(cell: Cell) -> int:
    """Pushes in the model; an identification that was just started again first has to see the object."""
    if _IDENTIFICATION not in cell.plan.nodes:
        return 0
    until(lambda: oracles.learned_pushes(cell) is not None, _LEARNED, "identification did not come back before the fault")
    return oracles.learned_pushes(cell) or 0


def _settle(cell: Cell) -> None:
    """Wait until each node has reported anew, and identification has learned or refused the pushes of the fault before.

    What comes late would count for the next fault; counts of a node that was started again begin at zero.
    """
    since, nodes = time.monotonic(), [name for name in _COUNTING if name in cell.plan.nodes]

    def settled() -> bool:
        reports = {name: cell.monitor.reports_of(name, since) for name in nodes}
        kinds = ("pushes waiting", "outlines waiting")
        waiting = [own[-1].values.get(kind, "0") for own in reports.values() if own for kind in kinds]
        return all(reports.values()) and all(count == "0" for count in waiting)

    with suppress(PushIdentError):  # the fault shows what is wrong with a node that does not speak
        until(settled, _IDLE, "the nodes did not settle")


def _in_cell(fault: Fault, trial: Trial, cell: Cell) -> None:
    cell.recover()
    _settle(cell)
    cell.monitor.forget()
    trial.learned = _learned(cell)
    try:
        fault.run(trial)
    finally:
        cell.proxy.clear()
        trial.failures += oracles.check(cell, alive=trial.alive, learned_before=trial.learned, whole_before=0)
