"""Families of patterns: hypotheses that share their columns, those of each push and those that all pushes share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from push_ident.physics.effect import Mechanism
from push_ident.types import Float64Array

Rows = tuple[Float64Array, Float64Array]
"""Rows of the poses and of the measured forces of one push, weighted as in the cost, shapes (3 n_frames, n) and (2 n_windows, n)."""


class Acts(Enum):
    """Quantity that a pattern acts on; values as in JSON."""

    FRICTION = "friction"
    FORCE = "force"
    """With a torque, along the axes of the table."""
    FORCE_ON_MOTION = "force along the motion"
    """Along and across the motion, with a torque."""
    PUSHER = "pusher"


class VariesWith(Enum):
    """The coordinate that a pattern depends on; values as in JSON."""

    POINT = "spot"
    """One position."""
    POSITION = "place"
    FROM_PUSH = "from push"
    """The same from one push on."""
    SINCE_CONTACT = "time since contact"
    TRAVEL = "way slid"
    SPEED = "speed"
    HEADING = "heading in the table"
    HEADING_IN_OBJECT = "heading in the object"
    SIDE = "side of the object"
    TIME = "time"
    """Within each push on its own."""
    FREQUENCY = "frequency"
    """An oscillation of one frequency, in each push with a phase and a size of its own."""


_MECHANISMS: Final = {
    (Acts.FORCE, VariesWith.POINT): Mechanism.FORCE_ON_OBJECT,
    (Acts.FORCE, VariesWith.POSITION): Mechanism.FORCE_ON_OBJECT,
    (Acts.FORCE, VariesWith.FROM_PUSH): Mechanism.FORCE_ON_OBJECT,
    (Acts.PUSHER, VariesWith.FROM_PUSH): Mechanism.TOOL_MOVED,
    (Acts.PUSHER, VariesWith.SIDE): Mechanism.OUTLINE,
    (Acts.PUSHER, VariesWith.FREQUENCY): Mechanism.TOOL_WOBBLES,
}
"""Of which families are free laws, by what acts and what it follows."""
_MECHANISMS_OF_FRICTION: Final = {
    VariesWith.POINT: Mechanism.FRICTION_BY_PLACE,
    VariesWith.POSITION: Mechanism.FRICTION_BY_PLACE,
    VariesWith.FROM_PUSH: Mechanism.FRICTION_BY_ORDER,
    VariesWith.SINCE_CONTACT: Mechanism.FRICTION_SINCE_CONTACT,
    VariesWith.TRAVEL: Mechanism.FRICTION_SINCE_CONTACT,
    VariesWith.SPEED: Mechanism.FRICTION_BY_SPEED,
    VariesWith.HEADING: Mechanism.FRICTION_BY_HEADING,
    VariesWith.HEADING_IN_OBJECT: Mechanism.FRICTION_BY_HEADING_IN_OBJECT,
}
"""The same of friction and of forces along and across the motion."""


@dataclass(frozen=True, slots=True)
class Member:
    """One hypothesis of a family."""

    key: float | tuple[float, float] | None
    """What distinguishes it: number of the push, decay time [s] or length [m], position [m]; None where the family has only one."""
    weights: Float64Array | None
    """Its patterns as combinations of the columns of the family, shape (n_columns, n); None where each column is one of them."""

    def gathered(self, by_column: Float64Array) -> Float64Array:
        """Derivatives by its amplitudes, shape (n, ...), from those by the columns of the family, shape (n_columns, ...)."""
        return by_column if self.weights is None else np.asarray(self.weights.T @ by_column)

    def spread(self, amplitudes: Float64Array) -> Float64Array:
        """Amplitudes of the columns of the family, shape (n_columns,), from its own, shape (n,)."""
        return amplitudes if self.weights is None else np.asarray(self.weights @ amplitudes)


@dataclass(frozen=True, slots=True)
class Family:
    """Patterns that act on one thing and follow one coordinate."""

    acts_on: Acts
    varies_with: VariesWith
    columns: Float64Array
    """Change of the whitened residuals of all frames, then of all measured forces, by a unit amplitude of each column, shape (3 n_frames +
    2 n_windows of all pushes, n_columns)."""
    members: tuple[Member, ...]
    scales: tuple[float, ...]
    """Prior standard deviations of the amplitudes; which of them holds is not known."""
    at: Float64Array | None = None
    """What each column stands for, where that is a position [m], a speed [m/s], an angle [rad] or a number of a push and a time [s], shape
    (n_columns, n); columns of several components of a force repeat it."""
    columns_of_push: tuple[slice, ...] = ()
    """Columns of each push, zero in the rows of all others; none where the pushes share their columns."""

    @property
    def mechanism(self) -> Mechanism | None:
        """Of which it is a free law; None where what it does is no mechanism of the catalogue."""
        if self.acts_on in (Acts.FRICTION, Acts.FORCE_ON_MOTION):
            return _MECHANISMS_OF_FRICTION.get(self.varies_with)
        return _MECHANISMS.get((self.acts_on, self.varies_with))


def shared(responses: Sequence[dict[str, Rows]], name: str) -> Float64Array:
    """Columns that all pushes share: rows of the poses of all pushes, then those of their forces."""
    return np.concatenate([np.concatenate([response[name][kind] for response in responses]) for kind in (0, 1)])


def separate(responses: Sequence[dict[str, Rows]], name: str) -> tuple[Float64Array, tuple[slice, ...]]:
    """The same with columns of each push for itself, and which those are."""
    ends = np.cumsum([0, *(response[name][0].shape[1] for response in responses)]).tolist()
    columns = tuple(slice(first, last) for first, last in pairwise(ends))
    return np.concatenate([block_diag(*(response[name][kind] for response in responses)) for kind in (0, 1)]), columns


def all_of() -> tuple[Member, ...]:
    """One hypothesis with all columns."""
    return (Member(None, None),)


def singles(positions: Float64Array) -> tuple[Member, ...]:
    """One position each, of shape (n, 2)."""
    identity = np.eye(len(positions))
    return tuple(Member((float(x), float(y)), identity[:, [k]]) for k, (x, y) in enumerate(positions))


def parts(keys: Sequence[float], n_each: int) -> tuple[Member, ...]:
    """A part of the columns for each key."""
    identity = np.eye(len(keys) * n_each)
    return tuple(Member(key, identity[:, k * n_each : (k + 1) * n_each]) for k, key in enumerate(keys))


def parts_of_pushes(keys: Sequence[float], n_each: int, n_pushes: int) -> tuple[Member, ...]:
    """The same part of the columns of every push for each key."""
    of_push = np.eye(len(keys) * n_each)
    weights = [np.kron(np.eye(n_pushes), of_push[:, k * n_each : (k + 1) * n_each]) for k in range(len(keys))]
    return tuple(Member(key, each.astype(np.float64)) for key, each in zip(keys, weights, strict=True))


def from_push(n_pushes: int, n_each: int) -> tuple[Member, ...]:
    """The same in all pushes from one of them on, whatever the first one is."""
    return tuple(Member(k, np.kron((np.arange(n_pushes) >= k)[:, None], np.eye(n_each)).astype(np.float64)) for k in range(1, n_pushes))
