"""A row of the fault suite: what it says in the table, and the trial in which it is injected."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from system.faults import oracles
from system.faults.cell import ARM_CELL, EXECUTOR, IDENTIFICATION, Cell, CellPlan, live_cell
from system.faults.hold import Hold, measure_hold
from system.faults.monitor import until

from push_ident.pushing.push import PushCode
from push_ident_msgs.action import ExecutePush

LEARNED = 60.0
"""For identification to learn a push, or to answer with a model [s]; it gives way to all other work of the machine."""
SETTLES = 15.0
"""For identification to learn or refuse what came before: a push without a record is refused after 10 s [s]."""


@dataclass(frozen=True)
class Fault:
    """One row of the table."""

    number: int
    name: str
    what: str
    """The fault, as it is injected."""
    expected: str
    """What must be true afterwards."""
    cell: CellPlan | None
    within: float
    """Time to notice the fault [s], beside 100 ms and braking."""
    only_executor: bool
    """Whether nobody else commands the arm."""


def fault(
    number: int,
    what: str,
    expected: str,
    *,
    cell: CellPlan | None = ARM_CELL,
    within: float = 0.0,
    only_executor: bool = True,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Mark a test as a row of the suite."""

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        name = test.__name__.removeprefix("test_").replace("_", "-")
        return pytest.mark.faults(Fault(number, name, what, expected, cell, within, only_executor))(test)

    return decorate


@dataclass
class Trial:
    """One fault under test."""

    fault: Fault
    folder: Path
    """For its files."""
    live: Cell | None
    holds: list[Hold] = field(default_factory=list)
    note: str = ""
    """What was found, for the JSON."""
    learned: int = 0
    """Pushes in the model before the fault."""

    @property
    def cell(self) -> Cell:
        assert self.live is not None
        return self.live

    def expect_hold(self, since: float, within: float | None = None) -> Hold:
        """The arm stands within the time to notice the fault, 100 ms and its braking; nothing moves it again.

        Args:
            since: when the fault began [s].
            within: time to notice it [s]; by default that of the row.
        """
        hold = measure_hold(self.cell.monitor, since, self.fault.within if within is None else within)
        self.holds.append(hold)
        assert hold.seconds <= hold.allowed, f"the arm stood {hold.seconds:.3f} s after the fault, allowed are {hold.allowed:.3f} s"
        assert not hold.commands_after, f"{hold.commands_after} motions were commanded after the hold"
        return hold

    def expect_code(self, result: ExecutePush.Result, *codes: PushCode, says: str = "") -> None:
        """A push ended with one of these codes, and its text has the words `says`."""
        names = " or ".join(code.name for code in codes)
        assert result.error_code in codes, f"the push ended with code {result.error_code} ({result.error_text}), expected {names}"
        assert says in result.error_text, f"{result.error_text!r} does not say {says!r}"
        self.note = self.note or result.error_text

    def expect_report(self, node: str, *words: str, since: float, patience: float = 10.0) -> None:
        """`/diagnostics` of `node` says all `words` after `since` [s], anywhere."""
        reports = self.cell.monitor.reports_of
        missing = f"/diagnostics of {node} does not say {', '.join(words)}"
        until(lambda: any(report.says(*words) for report in reports(node, since)), patience, missing)

    def expect_learned(self, more: int = 1) -> None:
        """The model has so many pushes more than before the fault."""
        # Not more often: identification writes its model to answer.
        until(lambda: (oracles.learned_pushes(self.cell) or 0) >= self.learned + more, LEARNED, "a whole push was not learned", every=0.5)

    def expect_speed(self, since: float) -> None:
        """No joint turned faster than it may."""
        fastest = max(abs(state.velocity / oracles.LIMITS.velocity).max() for state in self.cell.monitor.states(since))
        assert fastest < 1.02, f"a joint turned at {100 * fastest:.0f} % of its limit"


class Cells:
    """The cell of the row before is the cell of the next one, unless that needs another or something failed in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._plan: CellPlan | None = None
        self._cell: Cell | None = None
        self._stack = ExitStack()
        self._n = 0

    def of(self, plan: CellPlan) -> Cell:
        if self._cell is None or self._plan is not plan:
            self.close()
            self._n += 1
            self._plan, self._cell = plan, self._stack.enter_context(live_cell(plan, self.folder / f"cell-{self._n}"))
        return self._cell

    def close(self) -> None:
        """Stop it: after a failure nothing is known of its nodes, logs and model."""
        self._cell = None
        self._stack.close()


@contextmanager
def trial_of(row: Fault, cells: Cells) -> Iterator[Trial]:
    """A trial in a cell that can push; afterwards the oracles are asked."""
    folder = cells.folder / row.name
    folder.mkdir(parents=True)
    trial = Trial(row, folder, None if row.cell is None else cells.of(row.cell))
    if trial.live is None:
        yield trial
        return
    cell = trial.live
    try:
        cell.recover()
        _settle(cell)
        state = cell.monitor.latest_state()
        assert state is not None
        cell.monitor.forget()
        if IDENTIFICATION in cell.plan.nodes:  # one that was just started again first has to see the object
            until(lambda: oracles.learned_pushes(cell) is not None, LEARNED, "identification did not come back before the fault", every=0.5)
            trial.learned = oracles.learned_pushes(cell) or 0
        yield trial
        cell.proxy.clear()
        found = oracles.violations(cell, trial.learned, state.q if row.only_executor else None)
        assert not found, "; ".join(found)
    except BaseException:
        cells.close()
        raise


def _settle(cell: Cell) -> None:
    """Wait until each node has reported anew, and identification has learned or refused the pushes of the fault before.

    What comes late would count for the next fault; counts of a node that was started again begin at zero.
    """
    since = time.monotonic()

    def settled() -> bool:
        reports = [cell.monitor.reports_of(name, since) for name in (IDENTIFICATION, EXECUTOR) if name in cell.plan.nodes]
        kinds = ("pushes waiting", "outlines waiting")
        return all(own and all(own[-1].values.get(kind, "0") == "0" for kind in kinds) for own in reports)

    with suppress(AssertionError):  # the fault shows what is wrong with a node that does not speak
        until(settled, SETTLES, "the nodes did not settle")
