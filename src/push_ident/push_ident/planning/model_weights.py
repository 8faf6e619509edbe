"""Which of the models that may be true explain a push while it is made.

A push of a few centimetres shows little of the maps, but where the object turns to. Each stretch of it is simulated with every model from
the pose at its beginning; how far a model ends from the pose that was seen there lowers its weight:

    log w_m <- log w_m - 1/2 min(sum ((x_m - x) / sigma)^2, c)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from push_ident.geometry.se2 import wrap_angle
from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.planning.curved import Face
from push_ident.types import Float64Array, ObjectShape, PusherPath

__all__ = ["ModelWeights", "touching"]

_STRETCH: Final = 0.025
"""Travel of the tool in a stretch [m]: long enough that models differ by more than the poses are wrong."""
_STEP: Final = 1.0 / 80.0
"""Of the simulation [s]."""
_STD: Final = np.array([1e-3, 1e-3, 8e-3])
"""Of the difference of two filtered poses from that of the right model [m, m, rad]."""
_MOST: Final = 12.0
"""Largest squared distance of a model in one stretch [1]: a wrong pose must not decide for good."""


def touching(models: Sequence[BatchModel], face: Face) -> list[BatchModel]:
    """Models whose surface lies elsewhere, each displaced so that the tool touches it as it touches that of the first one."""
    own = models[0].surface
    return [model._replace(displacement=np.append(-(model.surface - own) * face.normal, 0.0)) for model in models]


class ModelWeights:
    """Weighs models by one push.

    Args:
        shape: of the object.
        models: the most probable one, then others; equally likely at first.
        radius: of the tool [m].
    """

    def __init__(self, shape: ObjectShape, models: Sequence[BatchModel], radius: float) -> None:
        self._shape, self._models, self._radius = shape, list(models), radius
        self.log_weight: Float64Array = np.zeros(len(self._models))
        """Up to a constant, shape (n_models,)."""
        self._time: list[float] = []
        self._tool: list[Float64Array] = []
        self._begun: tuple[Float64Array, Float64Array, Face] | None = None
        """Pose, velocity and face at the beginning of the stretch."""

    def restart(self) -> None:
        """A stretch ended for another reason: the contact was lost, or the object displaced."""
        self._begun = None

    def best(self, n: int) -> list[BatchModel]:
        """The `n` that explain the push best, in that order."""
        order = np.argsort(-self.log_weight, kind="stable")[:n]
        return [self._models[k] for k in order]

    def see(self, time: Float64Array, tool: Float64Array, pose: Float64Array, velocity: Float64Array, face: Face) -> None:
        """A frame of an object in contact.

        Args:
            time: since the frame before [s], shape (n,), ascending, the frame's last.
            tool: axis of the tool then [m], shape (n, 2).
            pose: of the object at the frame, shape (3,).
            velocity: of its frame then [m/s, m/s, rad/s], shape (3,).
            face: that the tool touches.
        """
        if self._begun is not None:
            self._time.extend(time[1:].tolist())
            self._tool.extend(tool[1:])
            travel = float(np.sum(np.linalg.norm(np.diff(self._tool, axis=0), axis=1)))
            if travel < _STRETCH:
                return
            path = PusherPath(np.array(self._time), np.array(self._tool), self._radius)
            first, first_velocity, first_face = self._begun
            push = BatchPush(path, first, path.time[-1:], first_velocity)
            ends = rollouts(self._shape, touching(self._models, first_face), [push], step=_STEP)[:, 0, 0]
            away = np.column_stack([ends[:, :2] - pose[:2], wrap_angle(ends[:, 2] - pose[2])]) / _STD
            square = np.where(np.isfinite(away).all(axis=1), np.sum(np.nan_to_num(away) ** 2, axis=1), _MOST)
            self.log_weight = self.log_weight - 0.5 * np.minimum(square, _MOST)
        self._time, self._tool = [float(time[-1])], [np.array(tool[-1])]
        self._begun = pose, velocity, face
