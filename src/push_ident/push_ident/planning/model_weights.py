"""Which of the models that may be true explain a push while it is made.

A push of a few centimetres shows little of the maps, but where the object turns to. Each stretch of it is simulated with every model from
the pose at its beginning; how far a model ends from the pose that was seen there lowers its weight:

    log w_m <- log w_m - 1/2 min(sum ((x_m - x) / sigma)^2, c)

A stretch is simulated bit by bit in the frames of the one after it: a frame has no time for all models.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from push_ident.geometry.se2 import wrap_angle
from push_ident.physics.batch import BatchClock, BatchModel, ModelBatch
from push_ident.planning.curved import Face
from push_ident.types import Float64Array, ObjectShape

__all__ = ["ModelWeights", "touching"]

_STRETCH: Final = 0.025
"""Travel of the tool in a stretch [m]: long enough that models differ by more than the poses are wrong."""
_STEP: Final = 1.0 / 80.0
"""Of the simulation [s]."""
_STD: Final = np.array([1e-3, 1e-3, 8e-3])
"""Of the difference of two filtered poses from that of the right model [m, m, rad]."""
_MOST: Final = 12.0
"""Largest squared distance of a model in one stretch [1]: a wrong pose must not decide for good."""


def touching(models: ModelBatch, face: Face) -> ModelBatch:
    """Models whose surface lies elsewhere, each displaced so that the tool touches it as it touches that of the first one."""
    surface = np.array([model.surface for model in models.models])
    return models.displaced(np.column_stack([-(surface - surface[0])[:, None] * face.normal, np.zeros(len(models))]))


class _Stretch(NamedTuple):
    """A stretch that is over, and is being simulated."""

    models: ModelBatch
    """As they touch its face."""
    clock: BatchClock
    tool: Float64Array
    """Shape (1, n, 2)."""
    first: Float64Array
    """Pose at its beginning, shape (1, 3), and velocity."""
    velocity: Float64Array
    end: Float64Array
    """Pose at its end, shape (3,)."""
    n_frames: int
    """That it lasted."""


class ModelWeights:
    """Weighs models by one push.

    Args:
        shape: of the object.
        models: the most probable one, then others; equally likely at first.
        radius: of the tool [m].
    """

    def __init__(self, shape: ObjectShape, models: Sequence[BatchModel], radius: float) -> None:
        self._models = ModelBatch(shape, models, radius)
        self.log_weight: Float64Array = np.zeros(len(models))
        """Up to a constant, shape (n_models,)."""
        self._time: list[float] = []
        self._tool: list[Float64Array] = []
        self._n_frames = 0
        self._begun: tuple[Float64Array, Float64Array, Face] | None = None
        """Pose, velocity and face at the beginning of the stretch."""
        self._waiting: _Stretch | None = None
        self._squares: list[Float64Array] = []
        """Of the models of the stretch that waits, as far as they were simulated."""

    def restart(self) -> None:
        """A stretch ended for another reason: the contact was lost, or the object displaced."""
        self._begun = None

    def best(self, n: int) -> ModelBatch:
        """The `n` that explain the push best, in that order."""
        return self._models.picked([int(k) for k in np.argsort(-self.log_weight, kind="stable")[:n]])

    def see(self, time: Float64Array, tool: Float64Array, pose: Float64Array, velocity: Float64Array, face: Face) -> None:
        """A frame of an object in contact.

        Args:
            time: since the frame before [s], shape (n,), ascending, the frame's last.
            tool: axis of the tool then [m], shape (n, 2).
            pose: of the object at the frame, shape (3,).
            velocity: of its frame then [m/s, m/s, rad/s], shape (3,).
            face: that the tool touches.
        """
        self.work()
        if self._begun is not None:
            self._time.extend(time[1:].tolist())
            self._tool.extend(tool[1:])
            self._n_frames += 1
            travel = float(np.sum(np.linalg.norm(np.diff(self._tool, axis=0), axis=1)))
            if travel < _STRETCH:
                return
            self.work(all_of_it=True)
            first, first_velocity, first_face = self._begun
            knots, own = np.array(self._time), touching(self._models, first_face)
            clock = BatchClock.of(knots, knots[-1:], _STEP)
            self._waiting = _Stretch(own, clock, np.array(self._tool)[None], first[None], first_velocity[None], pose, self._n_frames)
        self._time, self._tool, self._n_frames = [float(time[-1])], [np.array(tool[-1])], 0
        self._begun = pose, velocity, face

    def work(self, *, all_of_it: bool = False) -> None:
        """Simulate some models in the stretch that is over, or all that are left; with the last one, all are weighed."""
        stretch = self._waiting
        if stretch is None:
            return
        done, n = sum(len(part) for part in self._squares), len(self._models)
        # As many a frame as are done before the next stretch is over, where that lasts as long.
        last = n if all_of_it else min(n, done + -(-n // max(stretch.n_frames - 1, 1)))
        ends = stretch.models.picked(range(done, last)).roll(stretch.clock, stretch.tool, stretch.first, stretch.velocity)[:, 0, 0]
        away = np.column_stack([ends[:, :2] - stretch.end[:2], wrap_angle(ends[:, 2] - stretch.end[2])]) / _STD
        self._squares.append(np.where(np.isfinite(away).all(axis=1), np.sum(np.nan_to_num(away) ** 2, axis=1), _MOST))
        if last == n:
            self.log_weight = self.log_weight - 0.5 * np.minimum(np.concatenate(self._squares), _MOST)
            self._waiting, self._squares = None, []
