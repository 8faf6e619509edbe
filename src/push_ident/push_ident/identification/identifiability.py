"""What the pushes could tell of an object, and what they left open.

A push moves with the object's centre of friction, its pressure distribution as a whole, its centre of mass and inertia; single
cells move nothing by themselves. So the posterior is read in two ways: quantities that have a name, each with the deviation before
and after the pushes; and the combinations of all cells, sorted by how much of the prior's deviation is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from push_ident.identification.result import ModelPosterior
from push_ident.physics.rollout import PARAM_CENTRE, PARAM_INERTIA, PARAM_MU
from push_ident.physics.simulation import GRAVITY
from push_ident.types import Float64Array

__all__ = ["Combination", "Identifiability", "Knowledge", "Quantity", "identifiability"]

_PINNED = 1 / 3
_OPEN = 0.8


class Knowledge(Enum):
    """How much of the prior's deviation the data leave; the value says what that means."""

    PINNED = "pinned down: the pushes leave less than a third of what was unknown"
    NARROWED = "narrowed: more pushes, elsewhere or in other directions, would tell more"
    OPEN = "open: these pushes tell next to nothing of it; the value is the prior's"
    GIVEN = "given: taken as known, not learned"

    @classmethod
    def of(cls, share_left: float) -> Knowledge:
        """`share_left`: deviation after over deviation before the pushes."""
        return cls.PINNED if share_left < _PINNED else cls.NARROWED if share_left < _OPEN else cls.OPEN


@dataclass(frozen=True, slots=True)
class Quantity:
    """A number about the object that has a name."""

    name: str
    unit: str
    value: float
    std: float
    """After the pushes."""
    prior_std: float
    """Before."""
    knowledge: Knowledge


@dataclass(frozen=True, slots=True)
class Combination:
    """A direction in the space of the maps: what changes together."""

    share_left: float
    """Deviation after over deviation before the pushes, 0..1."""
    log_mass: Float64Array
    """Change of the logarithm of the cells' masses along it, for one prior deviation, shape (n_cells,)."""
    log_friction: Float64Array
    """The same for support friction, shape (n_cells,)."""
    knowledge: Knowledge


@dataclass(frozen=True, slots=True)
class Identifiability:
    """What is known after the pushes."""

    quantities: tuple[Quantity, ...]
    combinations: tuple[Combination, ...]
    """Best known first; all together they span the maps."""

    @property
    def n_pinned(self) -> int:
        """Number of combinations that are pinned down."""
        return sum(c.knowledge is Knowledge.PINNED for c in self.combinations)

    @property
    def n_open(self) -> int:
        """Combinations of the cells that the pushes leave open."""
        return sum(c.knowledge is Knowledge.OPEN for c in self.combinations)


def identifiability(posterior: ModelPosterior) -> Identifiability:
    """Compare a posterior with its prior, both linearised at the posterior's mean."""
    parameters, z, covariance = posterior.unknowns, posterior.z, posterior.covariance
    mechanics = parameters.mechanics(z)
    body, d_body = mechanics.body, mechanics.derivative
    n = parameters.n_modes
    d_limit, total = mechanics.limit_derivative, float(body.limit.sum())
    arms = parameters.shape.cells.centres - posterior.model.centre_of_friction
    friction_rows = arms.T @ d_limit / total
    gyration = float(np.sqrt(body.inertia / body.mass))
    rows = [
        ("centre of friction x", "m", posterior.model.centre_of_friction[0], friction_rows[0]),
        ("centre of friction y", "m", posterior.model.centre_of_friction[1], friction_rows[1]),
        ("centre of mass x", "m", body.centre[0], d_body[PARAM_CENTRE]),
        ("centre of mass y", "m", body.centre[1], d_body[PARAM_CENTRE + 1]),
        ("radius of gyration", "m", gyration, d_body[PARAM_INERTIA] / (2 * gyration * body.mass)),
        ("mean support friction", "", total / (body.mass * GRAVITY), d_limit.sum(axis=0) / (body.mass * GRAVITY)),
        ("pusher friction", "", posterior.pusher_friction.value, d_body[PARAM_MU]),
    ]
    quantities = []
    for name, unit, value, row in rows:
        before, after = float(np.linalg.norm(row)), float(np.sqrt(max(row @ covariance @ row, 0.0)))
        knowledge = Knowledge.of(after / before) if before > 0 else Knowledge.GIVEN
        quantities.append(Quantity(name, unit, float(value), after, before, knowledge))
    mass, prior_std = posterior.total_mass, posterior.prior.total_mass * posterior.prior.total_mass_std
    # The deviation of the logarithm counts: a heavy object is not less known for being heavy.
    left = (mass.std / mass.value) / posterior.prior.total_mass_std if prior_std > 0 else 0.0
    quantities.append(
        Quantity("total mass", "kg", mass.value, mass.std, prior_std, Knowledge.of(left) if prior_std > 0 else Knowledge.GIVEN)
    )
    value, vector = np.linalg.eigh(covariance[: 2 * n, : 2 * n])
    prior = parameters.prior
    combinations = [
        Combination(
            share_left=float(np.sqrt(np.clip(variance, 0.0, None))),
            log_mass=prior.mass_map_std * (parameters.modes @ direction[:n]),
            log_friction=prior.friction_map_std * (parameters.modes @ direction[n:]),
            knowledge=Knowledge.of(float(np.sqrt(max(variance, 0.0)))),
        )
        for variance, direction in zip(value, vector.T, strict=True)
    ]
    return Identifiability(tuple(quantities), tuple(combinations))
