"""Plans in separate threads: callbacks, and above all a cancellation, must not wait for one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

from push_ident.identification.results.posterior import ModelPosterior
from push_ident.planning.belief import Belief
from push_ident.types import ObjectShape

__all__ = ["Planners", "WorkUnderWay"]

K = TypeVar("K")
P = TypeVar("P")
T = TypeVar("T")


class WorkUnderWay(Generic[T]):
    """`planning.goal_ports.UnderWay` in a thread. A result that is not awaited any more is dropped."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work = work
        self._done = threading.Event()
        self._result: T | None = None
        self._error: Exception | None = None
        threading.Thread(target=self._run, name="plan", daemon=True).start()

    def result(self) -> T | None:
        """As `UnderWay`."""
        if not self._done.is_set():
            return None
        if self._error is not None:
            raise self._error
        return self._result

    def _run(self) -> None:
        try:
            self._result = self._work()
        except Exception as error:
            self._error = error
        finally:
            self._done.set()


class Planners(Generic[K, P]):
    """Belief and planner of each object, which keeps what it has simulated; another planner for another outline or another key.

    One plan at a time.
    """

    def __init__(self, n_kept: int, make: Callable[[ObjectShape, K], P]) -> None:
        self._n_kept, self._make = n_kept, make
        self._known: dict[str, tuple[Belief, K, P]] = {}
        self._one_at_a_time = threading.Lock()

    def prepare(self, work: Callable[[], object]) -> None:
        """Begin with something that plans wait for."""

        def prepared() -> None:
            with self._one_at_a_time:
                work()

        threading.Thread(target=prepared, name="compile", daemon=True).start()

    def begin(self, object_id: str, posterior: ModelPosterior, key: K, plan: Callable[[Belief, P], T]) -> WorkUnderWay[T]:
        """Begin to `plan` for an object."""

        def work() -> T:
            with self._one_at_a_time:
                return plan(*self._get(object_id, posterior, key))

        return WorkUnderWay(work)

    def _get(self, object_id: str, posterior: ModelPosterior, key: K) -> tuple[Belief, P]:
        known, shape = self._known.pop(object_id, None), posterior.unknowns.shape
        if known is None or known[1] != key or not np.array_equal(known[0].shape.outline, shape.outline):
            known = (Belief.of(posterior), key, self._make(shape, key))
        elif known[0].posterior is not posterior:
            known = (Belief.of(posterior), key, known[2])
        self._known[object_id] = known
        while len(self._known) > self._n_kept:
            del self._known[next(iter(self._known))]
        return known[0], known[2]
