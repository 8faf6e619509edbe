"""States of an arm as they arrive: impossible ones are refused, the others wait to be taken."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.limits import plain_text
from push_ident.pushing.ports import ArmState
from push_ident.types import Float64Array


def no_positions(names: Sequence[str]) -> str:
    """What is wrong with joint states whose positions of these joints are no numbers, and what to do; `names` not empty."""
    return (
        "positions are not numbers (NaN): the driver has no data of the arm yet; expected radians of "
        f"{plain_text(', '.join(names))}; connect the driver to the arm, and see its log"
    )


@dataclass(frozen=True, slots=True)
class StateLimits:
    """Which states of an arm are possible after others."""

    position_margin: float = 0.1
    """Largest reported excess beyond the limits of a joint [rad]: a description may have tighter limits than the arm."""
    step: float = 0.05
    """Change of a joint between two states that is always possible [rad]: messages are late, and clocks jitter."""
    receipt_jitter: float = 0.02
    """Jitter of the times of receipt [s]."""
    burst: float = 0.5
    """Longest difference of the stamps of two states that were received together [s]: the node was busy."""
    confirmation: float = 1.0
    """States that agree with each other for so long show that the arm is there [s]: its driver was restarted, or its simulation reset."""


_LIMITS: Final = StateLimits()


class StateCheck:
    """Refuses states that the arm cannot have reached, so that it is never held at a posture that it does not have.

    Args:
        lower: lowest position of each joint [rad], shape (n_joints,).
        upper: highest.
        speed: largest speed of each joint [rad/s].
    """

    def __init__(self, lower: ArrayLike, upper: ArrayLike, speed: ArrayLike) -> None:
        self._lower, self._upper = np.asarray(lower) - _LIMITS.position_margin, np.asarray(upper) + _LIMITS.position_margin
        self._speed = np.asarray(speed)
        self._known: tuple[float, float, Float64Array] | None = None
        self._suspects: tuple[float, tuple[float, float, Float64Array]] | None = None
        """When the first of those that agree with each other was received [s], and the latest of them."""

    def check(self, received: float, stamp: float, q: Float64Array) -> None:
        """Take a state: time of receipt [s], stamp [s], joint positions [rad], shape (n_joints,).

        Raises InputError: a joint beyond its limits, or further from the last state than the arm can move; the text names the joint's
        number.
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
            if received - first < _LIMITS.confirmation and (agrees or np.any(excess > 0.0)):
                self._suspects = (first, state)
                i = int(np.argmax(excess))
                raise InputError(
                    f"joint {i + 1} is {abs(q[i] - self._known[2][i]):.3g} rad from where it was, further than the arm can move; "
                    f"states that agree for {_LIMITS.confirmation:.0f} s are believed."
                )
        self._known, self._suspects = state, None

    def _excess(self, before: tuple[float, float, Float64Array], state: tuple[float, float, Float64Array]) -> Float64Array:
        passed = max(state[0] - before[0], min(state[1] - before[1], _LIMITS.burst)) + _LIMITS.receipt_jitter
        return np.asarray(np.abs(state[2] - before[2]) - _LIMITS.step - self._speed * passed)


class StateIntake:
    """Takes the states of one arm. May be filled in one thread and asked in another.

    Args:
        forward: pose of the tip, shape (4, 4), for joint positions [rad].
        capacity: number of states that may wait to be taken: a second at 1 kHz.
    """

    def __init__(self, check: StateCheck, forward: Callable[[Float64Array], Float64Array], capacity: int = 1000) -> None:
        self._check, self._forward = check, forward
        self._waiting: deque[ArmState] = deque(maxlen=capacity)
        self._impossible = (-float("inf"), "")
        self.latest: ArmState | None = None
        """None before the first."""

    def take(self, received: float, stamp: float, q: Float64Array) -> ArmState | None:
        """A state as it comes in: time of receipt [s], `Clock.monotonic`, stamp [s], 0 for none, and joint positions [rad].

        None for a stamp that was there before: a driver that repeats itself has lost its arm, and counts as silent.

        Raises InputError: it cannot be true.
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
