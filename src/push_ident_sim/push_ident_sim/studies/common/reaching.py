"""What experiments that push to goals report alike: shares with their intervals, causes of failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.special import betaincinv

from push_ident_sim.studies.common.base import Json

__all__ = ["causes_in_words", "failures", "mean_of", "share", "share_in_words"]

_OUTSIDE = 0.05
"""Chance that the true share lies outside its interval."""


def share(successes: Iterable[bool]) -> Json:
    """`n`, how many succeeded, and the interval of Clopper and Pearson in which the true share lies at 95 %."""
    found = [bool(success) for success in successes]
    n, k = len(found), sum(found)
    low = float(betaincinv(k, n - k + 1, _OUTSIDE / 2)) if k else 0.0
    high = float(betaincinv(k + 1, n - k, 1 - _OUTSIDE / 2)) if k < n else 1.0
    return {"n": n, "successes": k, "share": round(k / n, 4) if n else None, "low": round(low, 4), "high": round(high, 4)}


def share_in_words(row: Json) -> str:
    """Such as `39 of 40 (87-100 %)`."""
    return f"{row['successes']} of {row['n']} ({100 * row['low']:.0f}-{100 * row['high']:.0f} %)"


def failures(ends: Iterable[str], good: str) -> dict[str, int]:
    """How often each other end was found, the most frequent first."""
    return dict(Counter(end for end in ends if end != good).most_common())


def causes_in_words(row: dict[str, int]) -> str:
    """Such as `2 UNHELD, 1 FELL`."""
    return ", ".join(f"{n} {end}" for end, n in row.items()) or "none"


def mean_of(values: Sequence[float | None], digits: int = 3) -> float | None:
    """Of those that were measured; None where none was."""
    known = [value for value in values if value is not None and np.isfinite(value)]
    return round(float(np.mean(known)), digits) if known else None
