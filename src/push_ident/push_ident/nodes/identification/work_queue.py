"""What the worker of identification does, in the order in which it came."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from enum import Enum

__all__ = ["Kind", "WorkQueue"]


class Kind(Enum):
    """What some work is for."""

    PUSH = "push"
    """A push that has ended, or was left out."""
    OUTLINE = "outline"
    """A better outline, with which the pushes so far are fitted again."""


class WorkQueue:
    """Work of both kinds; what is being done counts as waiting until it is done. Its user has a lock for all but `n_waiting`."""

    def __init__(self) -> None:
        self._work: deque[tuple[Kind, Callable[[], None]]] = deque()
        self._n_waiting: Counter[Kind] = Counter()

    def put(self, kind: Kind, work: Callable[[], None]) -> None:
        """Add work at the end."""
        self._work.append((kind, work))
        self._n_waiting[kind] += 1

    def first(self) -> Callable[[], None] | None:
        """What to do next; None where nothing waits."""
        return self._work[0][1] if self._work else None

    def first_is_done(self) -> None:
        """Go on to the one after it."""
        kind, _ = self._work.popleft()
        self._n_waiting[kind] -= 1

    def n_waiting(self, kind: Kind) -> int:
        """How much of one kind is not done yet."""
        return self._n_waiting[kind]
