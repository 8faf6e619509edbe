"""Whether an arm can be where a message says that it is."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.types import Float64Array

__all__ = ["StateCheck"]

_BEYOND: Final = 0.1
"""An arm may report joints so far beyond their limits [rad]: limits of a description may be tighter than those of the arm."""
_STEP: Final = 0.05
"""Change of a joint between two states that is always possible [rad]: messages are late, and clocks jitter."""
_LATE: Final = 0.02
"""Jitter of the times of receipt [s]."""
_LONGEST: Final = 0.5
"""A state may be so much later than the one before by its stamp although both were received together [s]: a node that was busy."""
_CONFIRMING: Final = 1.0
"""States that agree with each other for so long show that the arm is there [s]: its driver was restarted, or its simulation reset."""


class StateCheck:
    """Refuses states that the arm cannot have reached, so that it is never held at a place where it is not.

    Args:
        lower: lowest position of each joint [rad], shape (n_joints,).
        upper: highest.
        speed: largest speed of each joint [rad/s].
    """

    def __init__(self, lower: ArrayLike, upper: ArrayLike, speed: ArrayLike) -> None:
        self._lower, self._upper = np.asarray(lower) - _BEYOND, np.asarray(upper) + _BEYOND
        self._speed = np.asarray(speed)
        self._known: tuple[float, float, Float64Array] | None = None
        self._suspects: tuple[float, tuple[float, float, Float64Array]] | None = None
        """When the first of those that agree with each other was received [s], and the latest of them."""

    def check(self, received: float, stamp: float, q: Float64Array) -> None:
        """Take a state: time of receipt [s], stamp [s], joint positions [rad], shape (n_joints,).

        Raises:
            InputError: a joint beyond its limits, or further from the last state than the arm can move; the text names the joint's number.
        """
        beyond = np.maximum(self._lower - q, q - self._upper)
        if np.any(beyond > 0.0):
            i = int(np.argmax(beyond))
            raise InputError(f"joint {i + 1} is at {q[i]:.3g} rad, expected {self._lower[i]:.3f} to {self._upper[i]:.3f}.")
        state = (received, stamp, q)
        if self._known is not None:
            excess = self._excess(self._known, state)
            # Those that go on where a wrong one began are not right because the arm could have come there meanwhile.
            agrees = self._suspects is not None and not np.any(self._excess(self._suspects[1], state) > 0.0)
            first = self._suspects[0] if self._suspects is not None and agrees else received
            if received - first < _CONFIRMING and (agrees or np.any(excess > 0.0)):
                self._suspects = (first, state)
                i = int(np.argmax(excess))
                raise InputError(
                    f"joint {i + 1} is {abs(q[i] - self._known[2][i]):.3g} rad from where it was, further than the arm can move; "
                    f"states that agree for {_CONFIRMING:.0f} s are believed."
                )
        self._known, self._suspects = state, None

    def _excess(self, before: tuple[float, float, Float64Array], state: tuple[float, float, Float64Array]) -> Float64Array:
        passed = max(state[0] - before[0], min(state[1] - before[1], _LONGEST)) + _LATE
        return np.asarray(np.abs(state[2] - before[2]) - _STEP - self._speed * passed)
