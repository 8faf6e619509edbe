"""What a solve may cost and what it has cost: one meter for all solvers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.types import Float64Array

__all__ = ["Budget", "Meter", "Progress", "Sample"]

Progress = Callable[["Sample"], None]


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of one solve; a solver stops at the first that is reached."""

    max_simulations: int | None = None
    """Pushes simulated, with or without derivative."""
    max_seconds: float | None = 30.0
    """Of the solve alone [s]."""
    processor_time: bool = False
    """Count the seconds that the processor worked for this process instead of those of the clock on the wall: then a busy machine
    does not change what a study of solvers reports."""

    def __post_init__(self) -> None:
        for name in ("max_simulations", "max_seconds"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"Budget.{name} is {value}, expected a positive number, or None for no limit.")


@dataclass(frozen=True, slots=True)
class Sample:
    """The best point so far, and what it had cost to get there."""

    n_simulations: int
    time_s: float
    cost: float
    x: Float64Array
    """Unknowns of the problem, shape (problem.size,)."""


class Meter:
    """Counts simulations and seconds, and keeps the best point of each moment.

    Args:
        budget: when to stop.
        on_progress: told of every better point.
    """

    def __init__(self, budget: Budget | None = None, on_progress: Progress | None = None) -> None:
        self.budget = budget or Budget()
        self.n_simulations = 0
        self.history: list[Sample] = []
        self._on_progress = on_progress
        self._clock = time.process_time if self.budget.processor_time else time.perf_counter
        self._started = self._clock()
        self._stopped: float | None = None

    def restart(self) -> None:
        """Set the clock to zero."""
        self._started = self._clock()

    def stop(self) -> None:
        """Stop the clock."""
        self._stopped = self.seconds

    @property
    def seconds(self) -> float:
        """Time since the start, or between start and stop [s]."""
        return self._clock() - self._started if self._stopped is None else self._stopped

    @property
    def spent(self) -> bool:
        """Whether a limit of the budget is reached."""
        limit = self.budget
        return (limit.max_simulations is not None and self.n_simulations >= limit.max_simulations) or (
            limit.max_seconds is not None and self.seconds >= limit.max_seconds
        )

    @property
    def seconds_left(self) -> float:
        """Until the budget is spent [s]; infinite without a limit."""
        return np.inf if self.budget.max_seconds is None else self.budget.max_seconds - self.seconds

    @property
    def best(self) -> Sample | None:
        """The best point so far; None before the first."""
        return self.history[-1] if self.history else None

    def count(self, n: int) -> None:
        """`n` more pushes were simulated."""
        self.n_simulations += n

    def offer(self, x: Float64Array, cost: float) -> bool:
        """Keep `x` if it costs less than the best so far; whether it does."""
        if not cost < (self.history[-1].cost if self.history else np.inf):
            return False
        self.history.append(Sample(self.n_simulations, self.seconds, float(cost), np.array(x)))
        if self._on_progress:
            self._on_progress(self.history[-1])
        return True
