"""What identification computes in the background: its worker's queue, and what only the latest of each name is done of."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable
from enum import Enum

from push_ident.nodes.base.guard import Guard


class Kind(Enum):
    """What some work is for."""

    PUSH = "push"
    """A push that has ended, or was left out."""
    OUTLINE = "outline"
    """A better outline, with which the pushes so far are fitted again."""
    EFFECTS = "effects"
    """Effects of a diagnosis, with which they are fitted again."""


class WorkQueue:
    """Work of all kinds; what is being done counts as waiting until it is done. Its user has a lock for all but `n_waiting`."""

    def __init__(self) -> None:
        self._work: deque[tuple[Kind, str, Callable[[], None]]] = deque()
        self._n_waiting: Counter[Kind] = Counter()

    def put(self, kind: Kind, work: Callable[[], None], *, instead_of: str = "") -> None:
        """Add work at the end.

        `instead_of`: work of the same kind with the same name at the end, which may not have begun, is replaced. Three messages make one
        better outline: one fit with it is enough.
        """
        if instead_of and len(self._work) > 1 and self._work[-1][:2] == (kind, instead_of):
            self._work.pop()
            self._n_waiting[kind] -= 1
        self._work.append((kind, instead_of, work))
        self._n_waiting[kind] += 1

    def first(self) -> Callable[[], None] | None:
        """What to do next; None where nothing waits."""
        return self._work[0][2] if self._work else None

    def first_is_done(self) -> None:
        """Go on to the one after it."""
        kind, *_ = self._work.popleft()
        self._n_waiting[kind] -= 1

    def n_waiting(self, kind: Kind) -> int:
        """How much of one kind is not done yet."""
        return self._n_waiting[kind]


class LatestJobs:
    """A thread that does one job after another; a newer job replaces a waiting one of the same name."""

    def __init__(self, name: str, guard: Guard) -> None:
        self._name, self._guard = name, guard
        self._wake = threading.Condition()
        self._jobs: dict[str, Callable[[], None]] = {}
        self._closing = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def put(self, name: str, job: Callable[[], None]) -> None:
        """Do `job` after the waiting ones."""
        with self._wake:
            self._jobs[name] = job
            self._wake.notify()

    def close(self, timeout: float = 1.0) -> None:
        """Start no more jobs; wait for the running one, at most `timeout` [s]."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join(timeout)

    def _work(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closing or self._jobs)
                if self._closing:
                    return
                job = self._jobs.pop(next(iter(self._jobs)))
            with self._guard.watch(self._name):
                job()
