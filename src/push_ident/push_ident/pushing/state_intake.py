"""The states of an arm as they come in: the latest, those that nobody has taken yet, and what cannot be true of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final

from push_ident.errors import InputError
from push_ident.pushing.ports import ArmState
from push_ident.pushing.state_check import StateCheck
from push_ident.types import Float64Array

__all__ = ["StateIntake"]

_KEPT: Final = 1000
"""Largest number of states that wait to be taken: a second at 1 kHz."""


class StateIntake:
    """Takes the states of one arm. May be filled in one thread and asked in another.

    Args:
        check: whether the arm can be there.
        forward: pose of the tip, shape (4, 4), for joint positions [rad].
    """

    def __init__(self, check: StateCheck, forward: Callable[[Float64Array], Float64Array]) -> None:
        self._check, self._forward = check, forward
        self._waiting: deque[ArmState] = deque(maxlen=_KEPT)
        self._impossible = (-float("inf"), "")
        self.latest: ArmState | None = None
        """None before the first."""

    def take(self, received: float, stamp: float, q: Float64Array) -> ArmState | None:
        """A state as it comes in: time of receipt [s], `Clock.monotonic`, stamp [s], 0 for none, and joint positions [rad].

        None for a stamp that was there before: a driver that repeats itself has lost its arm, and counts as silent.

        Raises:
            InputError: it cannot be true.
        """
        if self.latest is not None and stamp == self.latest.stamp != 0.0:
            return None
        try:
            self._check.check(received, stamp, q)
        except InputError as error:
            self._impossible = (received, str(error))
            raise
        state = ArmState(stamp, q, self._forward(q), received)
        self.latest = state
        self._waiting.append(state)
        return state

    def take_waiting(self) -> list[ArmState]:
        """As `Arm.take_states`."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    def impossible(self, since: float) -> str:
        """As `Arm.impossible_state`."""
        received, why = self._impossible
        return why if received > since else ""
