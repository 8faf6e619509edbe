"""Background jobs of which only the latest of each name is done."""

from __future__ import annotations

import threading
from collections.abc import Callable

from push_ident.nodes.base.guard import Guard

__all__ = ["LatestJobs"]


class LatestJobs:
    """A thread that does one job after another; a newer job replaces a waiting one of the same name.

    Args:
        name: name of the thread.
        guard: refuses jobs that fail.
    """

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
