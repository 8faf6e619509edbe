"""Effects that are known from elsewhere, such as from a diagnosis, in the model of an object.

They are unknowns beside the maps. What is known of them counts as information of the pushes that showed it: with the prior N(0, 1) of an
unknown in its units and the known N(z, v), that information has the precision 1 / v - 1 and the vector z / v. Pushes must not count twice.
Of the n pushes behind it, k may be in the model as well; each is taken to have shown as much, and 1 - k / n of the information counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from push_ident.errors import InputError
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.quadratic import Quadratic
from push_ident.identification.unknowns.spec import UnknownsSpec, nuisance_effects
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class KnownEffect:
    """One effect with the values of its parameters.

    Raises:
        InputError: no such effect, other numbers of values than it has parameters, values that are not finite or not admissible, or
            standard deviations that are not positive.
    """

    name: str
    value: Float64Array
    """SI units, axes of the table, shape (n_parameters,)."""
    std: Float64Array
    """Standard deviations, shape (n_parameters,)."""
    share: float = 1.0
    """Of the pushes that showed it, those that are not in the model [1]."""

    def __post_init__(self) -> None:
        if self.name not in EFFECTS:
            raise InputError(f"There is no effect `{self.name}`; known are {', '.join(EFFECTS)}.")
        parameters = EFFECTS[self.name].parameters
        value, std = (np.array(numbers, dtype=np.float64) for numbers in (self.value, self.std))
        if value.shape != (len(parameters),) or std.shape != value.shape:
            raise InputError(f"{self.name} has {value.size} values and {std.size} standard deviations, expected {len(parameters)} of each.")
        for parameter, size, deviation in zip(parameters, value, std, strict=True):
            if not (np.isfinite(size) and parameter.low <= size <= parameter.high):
                raise InputError(f"{self.name} has {parameter.name} = {size}, expected a number from {parameter.low} to {parameter.high}.")
            if not (np.isfinite(deviation) and deviation > 0):
                raise InputError(f"{self.name} has the standard deviation {deviation} of {parameter.name}, expected a positive number.")
        if not 0 <= self.share <= 1:
            raise InputError(f"The share of the pushes that showed {self.name} is {self.share}, expected 0 to 1.")
        for name, numbers in (("value", value), ("std", std)):
            numbers.setflags(write=False)
            object.__setattr__(self, name, numbers)


def effects_cost(unknowns: UnknownsSpec, effects: Sequence[KnownEffect]) -> Quadratic | None:
    """What is known of effects beyond the prior of the unknowns, as a cost of them; None where nothing is."""
    informative = [effect for effect in effects if effect.share > 0]
    if not informative:
        return None
    slope, precision = np.zeros(unknowns.size), np.zeros(unknowns.size)
    for effect in informative:
        at, z, variance = _in_units(unknowns, effect)
        # Less than the prior says is no information.
        known = variance < 1.0
        slope[at] = np.where(known, -effect.share * z / variance, 0.0)
        precision[at] = np.where(known, effect.share * (1.0 / variance - 1.0), 0.0)
    return Quadratic(np.zeros(unknowns.size), slope, np.diag(precision))


def _in_units(unknowns: UnknownsSpec, effect: KnownEffect) -> tuple[slice, Float64Array, Float64Array]:
    """Place of an effect in `z`, its values and variances in units of the prior."""
    at = unknowns.slice_of_effect(effect.name)
    std = unknowns.effect_std[unknowns.effects.slice_of(effect.name)]
    return at, (effect.value - EFFECTS[effect.name].nominal) / std, (effect.std / std) ** 2


def with_known_effects(posterior: ModelPosterior, effects: Sequence[KnownEffect]) -> tuple[ModelPosterior, Float64Array]:
    """The same posterior of the rest with these effects beside it, and with no others but errors of sensors.

    Returns:
        The posterior, and the matrix from its unknowns to those before, shape (size before, size).
    """
    before = posterior.unknowns
    measured = nuisance_effects(before.shape, before.prior)
    names = dict.fromkeys((*(effect.name for effect in effects), *(n for n in before.effects.names if n in measured)))
    unknowns = before.with_effects(tuple(names))
    onto = np.zeros((before.size, unknowns.size))
    for name, block in before.blocks.items():
        if name != "effects":
            onto[before.slices[name], unknowns.slices[name]] = np.eye(block.size)
    for name in names:
        if name in before.effects.names:
            at_before = before.slice_of_effect(name)
            onto[at_before, unknowns.slice_of_effect(name)] = np.eye(at_before.stop - at_before.start)
    z, covariance = onto.T @ posterior.z, onto.T @ posterior.covariance @ onto
    for effect in effects:
        at, value, variance = _in_units(unknowns, effect)
        covariance[at, :], covariance[:, at] = 0.0, 0.0
        z[at] = np.where(variance < 1.0, value, 0.0)
        covariance[at, at] = np.diag(np.minimum(variance, 1.0))
    # Other kinds of support were fitted with the effects before.
    return replace(posterior, unknowns=unknowns, z=z, covariance=covariance, alternatives=()), onto


def effects_in_use(posterior: ModelPosterior) -> tuple[KnownEffect, ...]:
    """The effects of a posterior but for errors of sensors, with their values."""
    effects, measured = posterior.effects, nuisance_effects(posterior.unknowns.shape, posterior.prior)
    low, high = (np.array([getattr(parameter, bound) for parameter in effects.parameters]) for bound in ("low", "high"))
    # A file or a fit may lie beside a bound by rounding.
    value, std = np.clip(effects.values, low, high), np.maximum(posterior.effects_std, 1e-15)
    position = {name: effects.slice_of(name) for name in effects.names if name not in measured}
    return tuple(KnownEffect(name, value[at], std[at]) for name, at in position.items())


def effects_text(posterior: ModelPosterior) -> str:
    """These effects in words; empty where there is none."""
    return "; ".join(f"{effect.name} {_sizes(effect.name, effect.value, effect.std)}" for effect in effects_in_use(posterior))


def _sizes(name: str, value: Float64Array, std: Float64Array) -> str:
    rows = zip(EFFECTS[name].parameters, value, std, strict=True)
    return ", ".join(f"{p.name} {number:.4g} ± {deviation:.2g}{f' {p.unit}' if p.unit else ''}" for p, number, deviation in rows)


def check_agreement(posterior: ModelPosterior, effects: Sequence[KnownEffect], by_chance: float = 1e-3) -> None:
    """Raise InputError where the pushes of a posterior, which has these effects, contradict their values.

    The squared Mahalanobis distance between both is compared with its distribution for independent estimates; those of the same pushes are
    nearer. `by_chance` is the probability that they contradict a right value: one right diagnosis in a thousand is refused.
    """
    in_use = {effect.name: effect for effect in effects_in_use(posterior)}
    for effect in effects:
        fitted = in_use.get(effect.name)
        if fitted is None:
            continue
        distance2 = float(np.sum((fitted.value - effect.value) ** 2 / (fitted.std**2 + effect.std**2)))
        if distance2 > chdtri(len(effect.value), by_chance):
            raise InputError(
                f"The pushes of this model show {effect.name} {_sizes(effect.name, fitted.value, fitted.std)}, expected "
                f"{_sizes(effect.name, effect.value, effect.std)}: it is not of this object and table as they are now; diagnose its latest "
                "pushes."
            )
