"""Identifiability: which quantities and which combinations of cells the pushes determine.

The motion of an object depends on its centre of friction, its pressure distribution as a whole, its centre of mass and its inertia;
no single cell decides it. So the posterior is compared with the prior in two ways: by named quantities, each with its standard deviation
before and after the pushes; and by independent combinations of all cells, sorted by the ratio of these standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from push_ident.identification.results.posterior import ModelPosterior, lower_root
from push_ident.identification.unknowns.mechanics import feet_at, log_derivatives_at
from push_ident.physics.simulation import GRAVITY
from push_ident.physics.tape import Param
from push_ident.types import Float64Array


class Knowledge(Enum):
    """How far the data reduce the prior standard deviation; the value explains it."""

    PINNED = "pinned down: the pushes leave less than a third of the prior standard deviation"
    NARROWED = "narrowed: more pushes, at other places or in other directions, would narrow it further"
    OPEN = "open: these pushes hardly constrain it; the value is that of the prior"
    GIVEN = "given: assumed, not fitted"

    @classmethod
    def of(cls, std_ratio: float) -> Knowledge:
        """The knowledge at a ratio of posterior to prior standard deviation."""
        return cls.PINNED if std_ratio < 1 / 3 else cls.NARROWED if std_ratio < 0.8 else cls.OPEN


@dataclass(frozen=True, slots=True)
class Quantity:
    """A named property of the object."""

    name: str
    unit: str
    value: float
    std: float
    """Posterior standard deviation."""
    prior_std: float
    """Prior standard deviation."""
    knowledge: Knowledge


@dataclass(frozen=True, slots=True)
class Combination:
    """A direction in the space of the maps: cells that change together."""

    std_ratio: float
    """Posterior over prior standard deviation, 0..1."""
    log_mass: Float64Array
    """Change of the logarithm of the cells' masses along it, for one prior standard deviation, shape (n_cells,)."""
    log_friction: Float64Array
    """The same for support friction, shape (n_cells,)."""
    knowledge: Knowledge


@dataclass(frozen=True, slots=True)
class Identifiability:
    """What the pushes determine."""

    quantities: tuple[Quantity, ...]
    combinations: tuple[Combination, ...]
    """The best determined first; together they span the maps."""

    @property
    def n_pinned(self) -> int:
        """Number of combinations that the pushes determine."""
        return sum(c.knowledge is Knowledge.PINNED for c in self.combinations)

    @property
    def n_open(self) -> int:
        """Number of combinations that the pushes hardly constrain."""
        return sum(c.knowledge is Knowledge.OPEN for c in self.combinations)


def identifiability(posterior: ModelPosterior) -> Identifiability:
    """Compare a posterior with its prior, both linearised at the mean of each part of the mixture; the combinations of cells are those of
    the likeliest part."""
    unknowns, covariance = posterior.unknowns, posterior.covariance
    parts = [(weight, _quantities(part)) for weight, part in posterior.parts]
    quantities = []
    for k, (name, unit, _, _, before) in enumerate(parts[0][1]):
        mean = float(sum(weight * rows[k][2] for weight, rows in parts))
        after = float(np.sqrt(sum(weight * (rows[k][3] ** 2 + (rows[k][2] - mean) ** 2) for weight, rows in parts)))
        quantities.append(Quantity(name, unit, mean, after, before, Knowledge.of(after / before) if before > 0 else Knowledge.GIVEN))
    mass, prior_std = posterior.total_mass, posterior.prior.total_mass * posterior.prior.total_mass_std
    # The standard deviation of the logarithm counts: a heavy object is not less known because it is heavy.
    ratio = (mass.std / mass.value) / posterior.prior.total_mass_std if prior_std > 0 else 0.0
    quantities.append(
        Quantity("total mass", "kg", mass.value, mass.std, prior_std, Knowledge.of(ratio) if prior_std > 0 else Knowledge.GIVEN)
    )
    maps = unknowns.maps
    value, vector = np.linalg.eigh(covariance[maps, maps])
    d_log_mass, d_log_friction = log_derivatives_at(unknowns, posterior.z)
    combinations = [
        Combination(
            std_ratio=float(np.sqrt(np.clip(variance, 0.0, None))),
            log_mass=d_log_mass[:, maps] @ direction,
            log_friction=d_log_friction[:, maps] @ direction,
            knowledge=Knowledge.of(float(np.sqrt(max(variance, 0.0)))),
        )
        for variance, direction in zip(value, vector.T, strict=True)
    ]
    return Identifiability(tuple(quantities), tuple(combinations))


def _quantities(part: ModelPosterior) -> list[tuple[str, str, float, float, float]]:
    """Name, unit, value, and standard deviation after the pushes and before them, of each named property in one part of a mixture."""
    mechanics, model, covariance = part.mechanics, part.model, part.covariance
    body, d_body = mechanics.body, mechanics.derivative
    d_limit, total = mechanics.limit_derivative, float(body.limit.sum())
    friction_rows = (part.unknowns.shape.cells.centres - model.centre_of_friction).T @ d_limit / total
    gyration = float(np.sqrt(body.inertia / body.mass))
    rows: list[tuple[str, str, float, Float64Array]] = [
        ("centre of friction x", "m", model.centre_of_friction[0], friction_rows[0]),
        ("centre of friction y", "m", model.centre_of_friction[1], friction_rows[1]),
        ("centre of mass x", "m", body.centre[0], d_body[Param.CENTRE]),
        ("centre of mass y", "m", body.centre[1], d_body[Param.CENTRE + 1]),
        ("radius of gyration", "m", gyration, d_body[Param.INERTIA] / (2 * gyration * body.mass)),
        ("mean support friction", "", total / (body.mass * GRAVITY), d_limit.sum(axis=0) / (body.mass * GRAVITY)),
        ("pusher friction", "", part.pusher_friction.value, d_body[Param.MU]),
    ]
    return [
        (name, unit, float(value), float(np.sqrt(max(float(row @ covariance @ row), 0.0))), float(np.linalg.norm(row)))
        for name, unit, value, row in rows
    ]


def value_text(quantity: Quantity) -> str:
    """Value and standard deviation after the pushes, with the unit: `27.6 ± 1.8 mm`."""
    scale, digits, unit = _scale(quantity)
    return f"{scale * quantity.value:z.{digits}f} ± {scale * quantity.std:.{digits}f}{unit}"


def before_text(quantity: Quantity) -> str:
    """Standard deviation before the pushes, with the unit: `± 25.4 mm`."""
    scale, digits, unit = _scale(quantity)
    return f"± {scale * quantity.prior_std:.{digits}f}{unit}"


def _scale(quantity: Quantity) -> tuple[float, int, str]:
    if quantity.unit == "m":
        return 1e3, 1, " mm"
    return 1.0, 3, f" {quantity.unit}" if quantity.unit else ""


@dataclass(frozen=True, slots=True)
class Support:
    """One foot."""

    position: Float64Array
    """Object frame [m], shape (2,)."""
    position_std: Float64Array
    """[m], shape (2,)."""
    share: float
    """Of the weight [-]."""
    share_std: float


def supports(posterior: ModelPosterior, n_draws: int = 200) -> tuple[Support, ...]:
    """The feet of an object, the one with the largest share first; none where it stands on its whole base.

    The standard deviations are those about this arrangement; another one may explain the same pushes as well. They are known to 5 % with
    200 drawn models.
    """
    unknowns = posterior.unknowns
    if not unknowns.prior.feet:
        return ()
    mean = feet_at(unknowns, posterior.z)
    root = lower_root(posterior.covariance)
    draws = np.random.default_rng(0).normal(size=(n_draws, unknowns.size)) @ root.T
    drawn = [feet_at(unknowns, posterior.z + step) for step in draws]
    position_std = np.std([feet.position for feet in drawn], axis=0)
    share_std = np.std([feet.share for feet in drawn], axis=0)
    order = np.argsort(-mean.share)
    return tuple(Support(mean.position[k], position_std[k], float(mean.share[k]), float(share_std[k])) for k in order)
