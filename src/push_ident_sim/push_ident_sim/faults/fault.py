"""What a fault of the suite is, and one trial of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from push_ident.errors import PushIdentError
from push_ident_sim.faults.harness.cell import Cell, CellPlan
from push_ident_sim.faults.harness.hold import Hold, measure_hold
from push_ident_sim.faults.harness.monitor import until

__all__ = ["Fault", "Impossible", "Trial"]


class Impossible(PushIdentError):
    """This machine cannot inject the fault; the text says what is missing."""


@dataclass(slots=True)
class Trial:
    """One fault under test: how it is injected, and what was found."""

    folder: Path
    """For files of the trial."""
    live: Cell | None
    """None: a fault of files, without a cell."""
    within: float | None
    """`Fault.within`"""
    failures: list[str] = field(default_factory=list)
    """What was expected and not found."""
    held: Hold | None = None
    lost: str = "nothing"
    note: str = ""
    """What was found, for the table."""
    alive: bool = True
    """Whether every process of the cell has to run at the end."""
    learned: int = 0
    """Pushes in the model before the fault; kept by `run`."""

    @property
    def cell(self) -> Cell:
        """The live cell."""
        assert self.live is not None
        return self.live

    def expect(self, true: object, otherwise: str) -> None:
        """Note a failure, in words, unless `true`."""
        if not true:
            self.failures.append(otherwise)

    def expect_soon(self, condition: Callable[[], object], patience: float, missing: str) -> None:
        """Note a failure unless `condition` comes true within `patience` [s]."""
        try:
            until(condition, patience, missing)
        except PushIdentError as error:
            self.failures.append(str(error))

    def expect_hold(self, since: float, *, detect: float | None = None) -> None:
        """The arm stands within the time to notice (`detect`, by default `Fault.within`), 100 ms and its braking; nothing moves it again.

        Args:
            since: when the fault began [s].
            detect: what the suite is allowed to notice it [s].
        """
        self.held = measure_hold(self.cell.monitor, since, (self.within or 0.0) if detect is None else detect)
        self.failures += self.held.faults

    def expect_refusal(self, node: str, *words: str, since: float, patience: float = 3.0) -> None:
        """`/diagnostics` of `node` counts one more refusal after `since` [s], and its reason has all `words`."""

        def refused() -> bool:
            reports = self.cell.monitor.reports_of(node, since)
            text = [report.values.get("last refusal", "") + " " + report.message for report in reports]
            counted = bool(reports) and reports[-1].refused > 0
            return counted and any(all(word.lower() in line.lower() for word in words) for line in text)

        try:
            until(refused, patience, "")
        except PushIdentError:
            latest = self.cell.monitor.report_of(node)
            last = "" if latest is None else latest.values.get("last refusal", "")
            got = "it does not speak" if latest is None else f"it refused {latest.refused}, the last: {last!r}"
            self.failures.append(f"/diagnostics of {node} does not name a refusal with {', '.join(words) or 'a count'}: {got}")

    def expect_report(self, node: str, *words: str, since: float, patience: float = 5.0) -> None:
        """`/diagnostics` of `node` says all `words` after `since` [s], anywhere."""

        def says() -> bool:
            texts = [f"{r.message} {r.values}".lower() for r in self.cell.monitor.reports_of(node, since)]
            return any(all(word.lower() in text for word in words) for text in texts)

        self.expect_soon(says, patience, f"/diagnostics of {node} does not say {', '.join(words)}")

    def wait(self, seconds: float) -> None:
        """Let wall time pass."""
        time.sleep(seconds)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One row of the table."""

    number: int
    name: str
    """For `--only` and the log: words joined by hyphens."""
    what: str
    """The fault, as it is injected."""
    holds: str
    """What holds it."""
    expected: str
    """What must be true afterwards."""
    run: Callable[[Trial], Any]
    """Injects and checks."""
    cell: CellPlan | None = None
    """The cell it needs; None: none."""
    within: float | None = None
    """Time that the suite is given to notice the fault [s], beside 100 ms and braking; None: no motion to hold."""
    fast: bool = False
    """Whether it is part of the tests."""
