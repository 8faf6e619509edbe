"""Times of calls that are compared: measured in turn, as medians with their spread."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["growth_exponent", "interleaved", "late_quantiles", "milliseconds", "statistics"]

Name = TypeVar("Name", bound=Hashable)
Result = TypeVar("Result")


def interleaved(calls: Mapping[Name, Callable[[], Result]], rounds: int) -> tuple[dict[Name, dict[str, Any]], dict[Name, Result]]:
    """Time calls in turn, so that a slow period of the machine affects all of them.

    The clock is the processor time of this process, on which other processes weigh less than on the wall clock.

    Args:
        calls: each is run once before the clock starts.
        rounds: how often each has its turn.

    Returns:
        `statistics` of each call [s], and what it gave.
    """
    results = {name: call() for name, call in calls.items()}
    seconds: dict[Name, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            started = time.process_time()
            call()
            seconds[name].append(time.process_time() - started)
    return {name: statistics(values) for name, values in seconds.items()}, results


def statistics(seconds: ArrayLike) -> dict[str, Any]:
    """`median_s`, the quartiles `q25_s` and `q75_s`, and how many there are (`n`)."""
    values = np.asarray(seconds, dtype=np.float64)
    low, middle, high = (float(f"{v:.4g}") for v in np.quantile(values, [0.25, 0.5, 0.75]))
    return {"median_s": middle, "q25_s": low, "q75_s": high, "n": len(values)}


def late_quantiles(seconds: Sequence[float]) -> dict[str, float]:
    """Median, 99 % quantile and maximum: `median_s`, `p99_s`, `worst_s`."""
    median, late, worst = (float(v) for v in np.quantile(seconds, [0.5, 0.99, 1.0])) if seconds else (0.0, 0.0, 0.0)
    return {"median_s": median, "p99_s": late, "worst_s": worst}


def growth_exponent(sizes: ArrayLike, seconds: ArrayLike) -> float:
    """Slope of the straight line through the logarithms of both: 1 where the time grows with the size."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def milliseconds(timing: Mapping[str, Any]) -> str:
    """Median and quartiles for a table."""
    return f"{1e3 * timing['median_s']:.3g} ({1e3 * timing['q25_s']:.3g}–{1e3 * timing['q75_s']:.3g})"
