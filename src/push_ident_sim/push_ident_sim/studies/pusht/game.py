"""The game Push-T of gym-pusht, unchanged, in metres: 1 mm for a pixel of the game.

Chi et al., Diffusion Policy, RSS 2023; `gym-pusht` has its engine (pymunk), block, starts and gate: a start is won when 95 % of the goal is
covered within 300 actions. An action is the place that a disc is led to by a spring and a damper for 0.1 s. The engine forgets the velocity
of the block in each of its steps, and knows no friction: neither of the table nor of the disc.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.outline import outline_of_cells, polygon_centroid
from push_ident.geometry.se2 import compose, wrap_angle
from push_ident.types import CellGrid, Float64Array, ObjectShape

__all__ = ["BLOCK", "GOAL", "RADIUS", "TICK", "TICKS", "WORKSPACE", "Game"]

_PIXEL: Final = 1e-3
"""[m]"""
_CELL: Final = 0.015
"""Edge of a cell of the block [m]."""
RADIUS: Final = 0.015
"""Of the disc [m]."""
TICK: Final = 0.1
"""Duration of an action [s]."""
TICKS: Final = 300
"""Actions of a start at most."""
_WALLS: Final = (0.007, 0.504)
"""Faces of the walls along both axes [m]."""
WORKSPACE: Final = (_WALLS[0] + RADIUS, _WALLS[1] - RADIUS) * 2
"""Of the middle of the disc (x_min, x_max, y_min, y_max) [m]."""


def _block() -> tuple[ObjectShape, Float64Array]:
    """The block, and the pose of its frame, which is at the centroid of the outline, in that of the game, which is at the top of the T."""
    bar = [(x, y) for x in np.arange(-3.5, 4.0) for y in (0.5, 1.5)]
    stem = [(x, y) for x in (-0.5, 0.5) for y in np.arange(2.5, 8.0)]
    centres = _CELL * np.array([*bar, *stem])
    middle = np.array(polygon_centroid(outline_of_cells(centres, _CELL)))
    shape = ObjectShape(CellGrid(centres - middle, _CELL), outline_of_cells(centres - middle, _CELL))
    return shape, np.append(middle, 0.0)


BLOCK, _FRAME = _block()
"""The T: a bar of 120 x 30 mm and a stem of 30 x 90 mm."""
GOAL: Float64Array = compose(np.array([0.256, 0.256, np.pi / 4]), _FRAME)
"""Pose of the block at the goal, shape (3,)."""


@dataclass(slots=True)
class Game:
    """One start after another, with poses of the block's frame and places of the disc in metres."""

    disc: Float64Array
    """Place of the disc [m], shape (2,)."""
    pose: Float64Array
    """Of the block, shape (3,)."""
    ticks: int
    """Actions since the start."""
    coverage: float
    """Share of the goal that is covered, at best since the start [1]."""
    is_won: bool
    _environment: Any

    @classmethod
    def new(cls) -> Game:
        """A game before its first start. Raises InputError where gym-pusht is not installed."""
        try:
            import gym_pusht  # noqa: F401 (registers the game)
            import gymnasium
        except ModuleNotFoundError as error:
            raise InputError(
                f"This needs the game, but {error.name} is not installed; run `pip install 'push_ident_sim[pusht]'`."
            ) from None
        environment = gymnasium.make("gym_pusht/PushT-v0", obs_type="state", max_episode_steps=TICKS)
        return cls(np.zeros(2), np.zeros(3), 0, 0.0, False, environment)

    def start(self, seed: int) -> None:
        """Begin a start of the game."""
        observation, _ = self._environment.reset(seed=seed)
        self.ticks, self.coverage, self.is_won = 0, 0.0, False
        self._read(observation)

    @property
    def is_over(self) -> bool:
        """Whether no action is left, or the start is won."""
        return self.is_won or self.ticks >= TICKS

    def act(self, target: Float64Array) -> None:
        """Lead the disc towards a place [m], shape (2,), for one tick; nothing where the start is over."""
        if self.is_over:
            return
        observation, _, _, _, info = self._environment.step((target / _PIXEL).astype(np.float32))
        self.ticks += 1
        self.coverage, self.is_won = max(self.coverage, float(info["coverage"])), bool(info["is_success"])
        self._read(observation)

    def _read(self, observation: Float64Array) -> None:
        self.disc = _PIXEL * np.array(observation[:2])
        pose = compose(np.append(_PIXEL * np.array(observation[2:4]), observation[4]), _FRAME)
        # The game gives the angle within one turn; poses of a push go on beyond it.
        self.pose = np.append(pose[:2], self.pose[2] + wrap_angle(pose[2] - self.pose[2]))

    def close(self) -> None:
        """Free the engine."""
        self._environment.close()
