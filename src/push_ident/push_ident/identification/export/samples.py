"""Objects drawn from a posterior, and the ranges of their quantities: for domain randomisation and Monte Carlo in a simulator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.results.posterior import Estimate, ModelPosterior
from push_ident.physics.effects import EFFECTS
from push_ident.physics.simulation import GRAVITY
from push_ident.types import Float64Array

_OF_RANGES: Final = 2000
"""Objects of which the ranges are those of 90 %: their ends are then known to 5 % of a standard deviation."""
_OUTSIDE: Final = 0.05
"""Share of the objects on either side of a range."""


_NAMES: Final = (
    ("total mass", "kg"),
    ("centre of mass x", "m"),
    ("centre of mass y", "m"),
    ("yaw inertia about the centre of mass", "kg m^2"),
    ("centre of friction x", "m"),
    ("centre of friction y", "m"),
    ("mean support friction", ""),
    ("pusher friction", ""),
)
"""Quantities beside effects, with their units."""


@dataclass(frozen=True, slots=True)
class Ranges:
    """What is known of the quantities of an object that a simulator takes, with what the posterior says about them together."""

    names: tuple[str, ...]
    """Of quantities, effects included."""
    units: tuple[str, ...]
    mean: Float64Array
    """Shape (n_quantities,)."""
    std: Float64Array
    """Shape (n_quantities,)."""
    low: Float64Array
    """Below it are 5 % of the objects, shape (n_quantities,)."""
    high: Float64Array
    """Above it are 5 % of the objects, shape (n_quantities,)."""
    correlation: Float64Array
    """Shape (n_quantities, n_quantities); 0 with a quantity that is known exactly."""

    def as_json(self) -> dict[str, object]:
        """Plain numbers, in SI units."""
        rows = zip(self.names, self.units, self.mean, self.std, self.low, self.high, strict=True)
        keys = ("name", "unit", "mean", "std", "low_5_percent", "high_95_percent")
        quantities = [dict(zip(keys, (name, unit, *map(float, values)), strict=True)) for name, unit, *values in rows]
        return {"quantities": quantities, "correlation": self.correlation.tolist()}


def drawn_objects(posterior: ModelPosterior, n: int, seed: int = 0) -> list[ModelPosterior]:
    """Objects that the pushes allow: `posterior` with drawn unknowns as its mean, all with the same outline and cells.

    The total mass is drawn as well, to its standard deviation, where it is no unknown beside the others; and so are effects. `n` of a seed
    are the first `n` of any larger number. Modes that the maps leave out are not drawn, as in predictions.

    Raises:
        InputError: fewer than one.
    """
    if n < 1:
        raise InputError(f"The number of samples is {n}, expected at least 1.")
    size = posterior.most_unknowns
    normal = np.random.default_rng(seed).standard_normal((n, size + 1))
    return [_object(part, z, row[size]) for (part, z), row in zip(posterior.drawn(normal), normal, strict=True)]


def _object(part: ModelPosterior, z: Float64Array, normal: float) -> ModelPosterior:
    """With unknowns `z`, and a total mass at `normal` standard deviations where it is none of them."""
    total, of_mass = part.total_mass, part.unknowns.slices["total_mass"]
    is_unknown = part.unknowns.blocks["total_mass"].size > 0
    change = float((part.unknowns.blocks["total_mass"].std * (z - part.z)[of_mass])[0]) if is_unknown else total.std / total.value * normal
    return replace(part, z=z, total_mass=Estimate(float(total.value * np.exp(change)), 0.0))


def ranges(posterior: ModelPosterior, seed: int = 0) -> Ranges:
    """Mean, spread, 90 % range and correlation of the quantities of an object, from drawn ones."""
    rows = np.array([_quantities(one) for one in drawn_objects(posterior, _OF_RANGES, seed)])
    std = rows.std(axis=0, ddof=1)
    unit = (rows - rows.mean(axis=0)) / np.where(std > 0.0, std, 1.0)
    low, high = np.quantile(rows, (_OUTSIDE, 1.0 - _OUTSIDE), axis=0)
    of_effects = [parameter.unit for name in posterior.effects.names for parameter in EFFECTS[name].parameters]
    names, units = zip(*_NAMES, *zip(posterior.effects.labels, of_effects, strict=True), strict=True)
    return Ranges(names, units, rows.mean(axis=0), std, low, high, unit.T @ unit / (len(rows) - 1))


def sample_json(one: ModelPosterior) -> dict[str, object]:
    """Numbers of a drawn object: of each cell, in the order of the model file, and of the whole."""
    model = one.model
    return {
        "mass_kg": model.mass.tolist(),
        "friction": model.friction.tolist(),
        "pusher_friction": model.pusher_friction,
        "effects": {label: float(value) for label, value in zip(one.effects.labels, one.effects.values, strict=True)},
        "total_mass_kg": model.total_mass,
    }


def _quantities(one: ModelPosterior) -> list[float]:
    """Those of `_NAMES`, then the values of the effects."""
    model, body = one.model, one.mechanics.body
    # Inertia and limits are those of the nominal mass until a force or a weight is given.
    inertia = body.inertia * model.total_mass / body.mass
    friction = float(body.limit.sum()) / (body.mass * GRAVITY)
    return [model.total_mass, *body.centre, inertia, *model.centre_of_friction, friction, model.pusher_friction, *one.effects.values]
