"""Independent fits in parallel threads: compiled kernels release the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

__all__ = ["map_in_threads"]

_MAX_THREADS: Final = 4
"""Between kernels, threads wait for each other, so that more bring nothing."""

A = TypeVar("A")
B = TypeVar("B")


def map_in_threads(work: Callable[[A], B], items: Iterable[A]) -> list[B]:
    """`work` of each item, in their order."""
    with ThreadPoolExecutor(min(_MAX_THREADS, os.cpu_count() or 1)) as pool:
        return list(pool.map(work, items))
