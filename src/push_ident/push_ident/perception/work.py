"""Work that poses do not wait for: when it is due, and how it is done in parts.

A function that yields between its parts is such work. Nothing depends on the clock: the same parts give the same result, on a fast machine
and on a slow one, live and in a replay.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Final, TypeVar

__all__ = ["InParts", "all_at_once", "is_due"]

_ROUNDING: Final = 1e-3
"""Tolerance of periods [s], so that a camera at exactly that rate does not miss every other turn by rounding."""

Result = TypeVar("Result")

InParts = Generator[None, None, Result]
"""Yields after each part but the last one, and returns the result."""


def all_at_once(work: InParts[Result]) -> Result:
    """Do all parts of some work."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: Result = end.value
            return result


def is_due(stamp: float, last: float, period: float) -> bool:
    """Whether something that was last done at `last` [s] is to be done in the frame at `stamp` [s]: not twice in one."""
    return last < stamp and stamp - last >= period - _ROUNDING
