"""Effects on the path of the tool: where it is, while the arm reports another place."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from push_ident.physics.effect import OnPusherPath
from push_ident.types import Float64Array
from push_ident_sim.injected.effects import InjectedEffects
from push_ident_sim.injected.equations import acts_by_equation, driven_position

_ACTING = ("pusher_lag", "pusher_speed_scale", "tool_offset", "pusher_wobble")


class ToolErrors:
    """The true place of the tool, step by step; positions (x, y) in `table` [m]."""

    def __init__(self, effects: InjectedEffects, time_step: float) -> None:
        """`time_step` [s] between two calls of `true_position`."""
        (lag,), (self._scale,) = effects["pusher_lag"], effects["pusher_speed_scale"]
        self._offset = np.array(effects["tool_offset"])
        self._radius, frequency = effects["pusher_wobble"]
        self._turn = 2.0 * np.pi * frequency * time_step
        self._lag_share = 1.0 - np.exp(-time_step / lag) if lag > 0 else 1.0
        self._n_steps = 0
        self._effects, self._time_step = effects, time_step
        self._by_equation = acts_by_equation(effects, OnPusherPath)
        self.start(np.zeros(2))

    @staticmethod
    def needed(effects: InjectedEffects) -> bool:
        """Whether any effect acts on the tool's place."""
        return any(name in effects for name in _ACTING) or acts_by_equation(effects, OnPusherPath)

    def start(self, reported: ArrayLike) -> None:
        """A motion begins where the arm reports `reported`."""
        self._start = np.array(reported, dtype=np.float64)
        self._lagged = self._start.copy()
        self._reported_path = [self._start.copy()]

    def true_position(self, reported: Float64Array) -> Float64Array:
        """Where the tool is at the end of a time step at whose end the arm reports `reported`."""
        self._n_steps += 1
        if self._by_equation:
            self._reported_path.append(np.array(reported))
            reported = driven_position(self._effects, self._time_step, np.array(self._reported_path))
        ahead = reported + self._scale * (reported - self._start)
        self._lagged = self._lagged + self._lag_share * (ahead - self._lagged)
        angle = self._turn * self._n_steps
        return np.asarray(self._lagged + self._offset + self._radius * np.array([np.cos(angle), np.sin(angle)]))
