"""Independent work in parallel threads: compiled kernels and linear algebra release the interpreter's lock.

Work may contain parallel work: fits of several models, each of which simulates several pushes. A thread that has nothing left to do then
helps wherever another one still has something, so that no processor waits for the longest fit.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import Final, TypeVar

_MAX_THREADS: Final = 4
"""Between kernels, threads wait for each other, so that more bring nothing."""

A = TypeVar("A")
B = TypeVar("B")


class _Helpers:
    """Threads beside the calling one, as many as the process has processors for them."""

    def __init__(self) -> None:
        self.begin()
        # A forked process has none of the threads of its parent.
        os.register_at_fork(after_in_child=self.begin)

    def begin(self) -> None:
        """All helpers are idle, and none has a thread yet."""
        self._lock = Lock()
        self._idle = min(_MAX_THREADS, len(os.sched_getaffinity(0))) - 1
        self._pool: ThreadPoolExecutor | None = None

    def join(self, work: Callable[[], None], n: int) -> list[Future[None]]:
        """Let idle helpers do `work` as well, `n` at most; each is idle again at its end."""
        with self._lock:
            n = max(0, min(n, self._idle))
            self._idle -= n
            # Threads that wait for their own helpers need a place, too: the pool has no limit that counts.
            self._pool = self._pool or ThreadPoolExecutor(_MAX_THREADS**2, thread_name_prefix="diagnosis")

        def helping() -> None:
            try:
                work()
            finally:
                self.idle(1)

        return [self._pool.submit(helping) for _ in range(n)]

    def idle(self, n: int) -> None:
        """Count `n` processors more, or less, that have nothing to do."""
        with self._lock:
            self._idle += n


_HELPERS: Final = _Helpers()


def map_in_threads(work: Callable[[A], B], items: Iterable[A]) -> list[B]:
    """`work` of each item, in their order. The calling thread works as well; may be called within `work`."""
    todo = list(items)
    results: dict[int, B] = {}
    numbers: Iterator[int] = iter(range(len(todo)))

    def take_turns() -> None:
        # The next number goes to one thread only: the interpreter's lock is held meanwhile.
        try:
            for number in numbers:
                results[number] = work(todo[number])
        finally:
            # Where work failed, nobody begins with what is left.
            deque(numbers, maxlen=0)

    others = _HELPERS.join(take_turns, len(todo) - 1)
    try:
        take_turns()
    finally:
        _HELPERS.idle(1)
        failed = [error for other in others if (error := other.exception()) is not None]
        _HELPERS.idle(-1)
    if failed:
        raise failed[0]
    return [results[number] for number in range(len(todo))]
