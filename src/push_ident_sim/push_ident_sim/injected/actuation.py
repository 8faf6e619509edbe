"""Effects between the place where the arm says that its tool is and the place where the tool is."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident_sim.injected.catalogue import Effects

__all__ = ["ToolErrors", "bearing_torque"]

FloatArray = NDArray[np.float64]

_ACTING = ("pusher_lag", "pusher_speed_scale", "tool_offset", "pusher_wobble")


def bearing_torque(effects: Effects) -> float:
    """Friction torque of the finger about its own axis [N m], if it turns at all."""
    (ease,) = effects["rolling_finger"]
    return 0.02 * (1.0 - ease)


class ToolErrors:
    """Where the tool really is, step by step; positions (x, y) in `table` [m]."""

    def __init__(self, effects: Effects, time_step: float) -> None:
        """`time_step` [s] between two calls of `true_position`."""
        (lag,), (self._scale,) = effects["pusher_lag"], effects["pusher_speed_scale"]
        self._offset = np.array(effects["tool_offset"])
        self._radius, frequency = effects["pusher_wobble"]
        self._turn = 2.0 * np.pi * frequency * time_step
        self._follow = 1.0 - np.exp(-time_step / lag) if lag > 0 else 1.0
        self._n_steps = 0
        self.start(np.zeros(2))

    @staticmethod
    def needed(effects: Effects) -> bool:
        """Whether any effect acts on the tool's place."""
        return any(name in effects for name in _ACTING)

    def start(self, reported: ArrayLike) -> None:
        """A motion begins where the arm reports `reported`."""
        self._anchor = np.array(reported, dtype=np.float64)
        self._followed = self._anchor.copy()

    def true_position(self, reported: FloatArray) -> FloatArray:
        """Where the tool is at the end of a time step at whose end the arm reports `reported`."""
        self._n_steps += 1
        ahead = reported + self._scale * (reported - self._anchor)
        self._followed = self._followed + self._follow * (ahead - self._followed)
        angle = self._turn * self._n_steps
        return np.asarray(self._followed + self._offset + self._radius * np.array([np.cos(angle), np.sin(angle)]))
