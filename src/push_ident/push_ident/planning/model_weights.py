"""Weights of the models of a posterior by a push under way.

A push of a few centimetres determines little of the maps, but the turn of the object. Each stretch of it is simulated with every model from
the pose at its beginning; the distance of its end from the observed pose lowers the weight of a model:

    log w_m <- log w_m - 1/2 min(sum ((x_m - x) / sigma)^2, c)

A stretch is simulated model by model during the frames of the next one: a frame has no time for all models.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Final, NamedTuple

import numpy as np

from push_ident.geometry.se2 import wrap_angle
from push_ident.physics.batch import BatchClock, BatchModel, ModelBatch
from push_ident.planning.curved import Face
from push_ident.types import Float64Array, ObjectShape

_STD: Final = np.array([1e-3, 1e-3, 8e-3])
"""Of the difference of two filtered poses from that of the right model [m, m, rad]."""


def touching(models: ModelBatch, face: Face) -> ModelBatch:
    """Models with different surfaces, each displaced so that the tool touches it as it touches the first one."""
    surface = np.array([model.surface for model in models.models])
    return models.displaced(np.column_stack([-(surface - surface[0])[:, None] * face.normal, np.zeros(len(models))]))


class _Stretch(NamedTuple):
    """A completed stretch that is being simulated."""

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

    stretch: ClassVar[float] = 0.025
    """Travel of the tool in a stretch [m]: long enough that models differ by more than the errors of the poses."""
    step: ClassVar[float] = 1.0 / 80.0
    """Time step of the simulation [s]."""
    max_distance2: ClassVar[float] = 12.0
    """Largest squared distance of a model in one stretch [1]: a wrong pose must not decide for good."""

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

    def observe(self, time: Float64Array, tool: Float64Array, pose: Float64Array, velocity: Float64Array, face: Face) -> None:
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
            if travel < self.stretch:
                return
            self.work(all_of_it=True)
            first, first_velocity, first_face = self._begun
            knots, models = np.array(self._time), touching(self._models, first_face)
            clock = BatchClock.of(knots, knots[-1:], self.step)
            self._waiting = _Stretch(models, clock, np.array(self._tool)[None], first[None], first_velocity[None], pose, self._n_frames)
        self._time, self._tool, self._n_frames = [float(time[-1])], [np.array(tool[-1])], 0
        self._begun = pose, velocity, face

    def work(self, *, all_of_it: bool = False) -> None:
        """Simulate some models in the stretch that is over, or all that are left; with the last one, all are weighed."""
        stretch = self._waiting
        if stretch is None:
            return
        done, n = sum(len(part) for part in self._squares), len(self._models)
        # Models per frame: all are done before the next stretch ends, if that lasts as long.
        last = n if all_of_it else min(n, done + -(-n // max(stretch.n_frames - 1, 1)))
        ends = stretch.models.picked(range(done, last)).roll(stretch.clock, stretch.tool, stretch.first, stretch.velocity)[:, 0, 0]
        errors = np.column_stack([ends[:, :2] - stretch.end[:2], wrap_angle(ends[:, 2] - stretch.end[2])]) / _STD
        self._squares.append(np.where(np.isfinite(errors).all(axis=1), np.sum(np.nan_to_num(errors) ** 2, axis=1), self.max_distance2))
        if last == n:
            self.log_weight = self.log_weight - 0.5 * np.minimum(np.concatenate(self._squares), self.max_distance2)
            self._waiting, self._squares = None, []
