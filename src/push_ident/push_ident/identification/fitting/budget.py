"""Budget of a solve and the work done so far: one meter for all solvers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import Float64Array

Progress = Callable[["Sample"], None]


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of one solve; a solver stops at the first that is reached."""

    max_simulations: int | None = None
    """Number of simulated pushes, with or without derivative."""
    max_seconds: float | None = 30.0
    """Of the solve [s]."""
    processor_time: bool = False
    """Count processor time of this process instead of wall time: then a busy machine does not change the results of a study."""

    def __post_init__(self) -> None:
        for name in ("max_simulations", "max_seconds"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"Budget.{name} is {value}, expected a positive number, or None for no limit.")


@dataclass(frozen=True, slots=True)
class Sample:
    """The best point so far, with the work done until then."""

    n_simulations: int
    time_s: float
    cost: float
    x: Float64Array
    """Unknowns of the problem, shape (problem.size,)."""
    unknowns: UnknownsSpec | None = None
    """What those of the object mean, where it is not the problem that the solve ends with."""


class Meter:
    """Counts simulations and seconds, and keeps the best point of each moment; `on_progress` is called with every better point."""

    def __init__(self, budget: Budget | None = None, on_progress: Progress | None = None) -> None:
        self.budget = budget or Budget()
        self.n_simulations = 0
        self.history: list[Sample] = []
        self._on_progress = on_progress
        self._clock = time.process_time if self.budget.processor_time else time.perf_counter
        self._started = self._clock()
        self._stopped: float | None = None

    def branch(self) -> Meter:
        """A meter for work beside other work: same budget and clock, nothing counted, and no progress reported until `join`."""
        other = Meter(self.budget)
        other._started, other._stopped = self._started, self._stopped
        return other

    def join(self, branch: Meter) -> None:
        """Add what a branch has counted, as if its work had been done now."""
        for sample in branch.history:
            if sample.cost < (self.history[-1].cost if self.history else np.inf):
                self.history.append(replace(sample, n_simulations=self.n_simulations + sample.n_simulations))
                if self._on_progress:
                    self._on_progress(self.history[-1])
        self.count(branch.n_simulations)

    def restart(self) -> None:
        """Set the clock to zero."""
        self._started = self._clock()

    def stop(self) -> None:
        """Stop the clock."""
        self._stopped = self.seconds

    @property
    def seconds(self) -> float:
        """Time since the start [s]."""
        return self._clock() - self._started if self._stopped is None else self._stopped

    @property
    def spent(self) -> bool:
        """Whether a limit of the budget is reached."""
        limit = self.budget
        return (limit.max_simulations is not None and self.n_simulations >= limit.max_simulations) or (
            limit.max_seconds is not None and self.seconds >= limit.max_seconds
        )

    @property
    def best(self) -> Sample | None:
        """The best point so far."""
        return self.history[-1] if self.history else None

    def count(self, n: int) -> None:
        """Add `n` simulated pushes."""
        self.n_simulations += n

    def rebase(self, x: Float64Array, cost: float) -> None:
        """Express all costs so far as finer numerics give them, with `cost` at `x`; only where `x` is the best point."""
        if self.history and np.array_equal(self.history[-1].x, x):
            change = float(cost) - self.history[-1].cost
            last = replace(self.history[-1], n_simulations=self.n_simulations, time_s=self.seconds, cost=float(cost))
            self.history = [*(replace(sample, cost=sample.cost + change) for sample in self.history[:-1]), last]

    def offer(self, x: Float64Array, cost: float, unknowns: UnknownsSpec | None = None) -> bool:
        """Keep `x` if its cost is below the best so far; returns whether it is. `unknowns`: see `Sample`."""
        if not cost < (self.history[-1].cost if self.history else np.inf):
            return False
        self.history.append(Sample(self.n_simulations, self.seconds, float(cost), np.array(x), unknowns))
        if self._on_progress:
            self._on_progress(self.history[-1])
        return True
