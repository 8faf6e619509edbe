"""When a process that died is started again: after a pause that doubles from one early death to the next, and not for ever."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Backoff", "RestartPolicy"]


@dataclass(frozen=True, slots=True)
class RestartPolicy:
    """How often and how soon a process is started again."""

    first: float = 1.0
    """Pause before the first restart [s]: long enough for the other nodes to see it gone."""
    longest: float = 30.0
    """The pause doubles with each early death up to this [s]."""
    settled: float = 60.0
    """A death after so long a life is no early one: the count begins anew [s]."""
    attempts: int = 8
    """Early deaths in a row after which it is not started again: two minutes of trying."""


class Backoff:
    """Counts the deaths of one process."""

    def __init__(self, policy: RestartPolicy) -> None:
        self._policy = policy
        self.early = 0
        """Early deaths in a row."""

    def pause(self, lived: float) -> float | None:
        """Pause before the restart after a death [s], None where there is none any more.

        Args:
            lived: From the start of the process to its death [s].
        """
        self.early = 1 if lived >= self._policy.settled else self.early + 1
        if self.early > self._policy.attempts:
            return None
        return min(self._policy.first * 2.0 ** (self.early - 1), self._policy.longest)
