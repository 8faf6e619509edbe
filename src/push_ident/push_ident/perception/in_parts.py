"""Work that is done in parts, so that a frame need not wait for all of it.

A function that yields between its parts is such work. Nothing depends on the clock: the same parts give the same result, on a fast machine
and on a slow one, live and in a replay.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

__all__ = ["InParts", "all_at_once"]

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
