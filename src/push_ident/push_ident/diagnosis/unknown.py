"""What no effect of the catalogue explains: a smooth wrench, what it acts on, and what it varies with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.diagnosis.fits import EffectFit, fit_effects, held_at_zero
from push_ident.diagnosis.parallel import side_by_side
from push_ident.diagnosis.scores import information_beside
from push_ident.diagnosis.selection import Selection
from push_ident.physics.effects.unknown_wrench import COMPONENTS, EFFECT, FEATURES
from push_ident.types import Float64Array

__all__ = ["SmoothWrench", "find_unknown"]

_PROMISING = 3.0
"""Expected gain of log evidence beside all that was named below which a refit is not worth its time [nat]."""
_IMITATED = 2
"""Effects that together may imitate a wrench so well that no trace of it is left beside them."""
_MAX_START = 2.0
"""A guess is not taken further than so many prior deviations."""
_CHOICE = 2.0
"""What a part costs for having been chosen among all [nat]."""
_STANDS_OUT = 0.2
"""Share of all that the wrench says from which a part of it is named."""


@dataclass(frozen=True, slots=True)
class SmoothWrench:
    """Maps and a smooth wrench that together fit the pushes."""

    fit: EffectFit
    """With those parts of the wrench that the pushes need."""
    gain: float
    """Of log evidence over the base model, less what its parts cost for having been chosen [nat]."""
    acts_on: dict[str, float]
    """Share of each component of the wrench, see `COMPONENTS`; they sum to 1."""
    varies_with: dict[str, float]
    """The same of each feature, see `FEATURES`."""

    @property
    def description(self) -> str:
        """In words: what it acts on, what it varies with."""
        on, by = (
            [name for name, share in sorted(shares.items(), key=lambda item: -item[1]) if share >= _STANDS_OUT]
            or [max(shares, key=lambda n: shares[n])]
            for shares in (self.acts_on, self.varies_with)
        )
        varying = [name for name in by if name != "even"]
        return f"acts as a {' and a '.join(COMPONENTS[name] for name in on)}" + (
            f", and varies with the {' and the '.join(varying)}" if varying else ""
        )


def find_unknown(selection: Selection) -> SmoothWrench | None:
    """Fit a smooth wrench in place of all effects that were added to the base model.

    Returns:
        None where there is no trace of one beside them.
    """
    told = information_beside(selection.fit, (EFFECT.name,))
    if told is None:
        return None
    covariance = np.asarray(np.linalg.inv(told.precision), dtype=np.float64)
    weight = -covariance @ told.slope
    expected = -0.5 * float(told.slope @ weight) - 0.5 * float(np.linalg.slogdet(told.precision)[1])
    if len(selection.found) < _IMITATED and expected + _needed_parts(weight, covariance)[1] < _PROMISING:
        return None
    base = selection.base
    known, names = base.z[base.parameters.effect_slice], (*base.names, EFFECT.name)
    if selection.found and (beside := information_beside(base, (EFFECT.name,))) is not None:
        weight = np.asarray(-np.linalg.solve(beside.precision, beside.slope), dtype=np.float64)
    # The linear guess reaches far and may end in another valley than the way from zero.
    near = weight * min(1.0, _MAX_START / float(np.linalg.norm(weight)))
    starts = [np.concatenate([known, start]) for start in (near, np.zeros_like(near))]
    fits = side_by_side(lambda start: fit_effects(base, names, start), starts)
    fit = max(fits, key=lambda fit: fit.log_evidence + _needed_parts_of(fit)[1])
    parts, _ = _needed_parts_of(fit)
    first = _place(fit).start
    needless = [first + number for part, numbers in _blocks().items() if part not in parts for number in numbers]
    fit = held_at_zero(fit, needless)
    acts_on, varies_with = dict.fromkeys(COMPONENTS, 0.0), dict.fromkeys(FEATURES, 0.0)
    for (component, feature), share in parts.items():
        acts_on[component] += share
        varies_with[feature] += share
    return SmoothWrench(fit, fit.log_evidence - base.log_evidence - _CHOICE * len(parts), acts_on, varies_with)


def _place(fit: EffectFit) -> slice:
    """Where the weights stand among the unknowns."""
    own, first = fit.parameters.effects.slice_of(EFFECT.name), fit.parameters.effect_slice.start
    return slice(first + own.start, first + own.stop)


def _needed_parts_of(fit: EffectFit) -> tuple[dict[tuple[str, str], float], float]:
    place = _place(fit)
    return _needed_parts(fit.z[place], fit.covariance[place, place])


def _needed_parts(weight: Float64Array, covariance: Float64Array) -> tuple[dict[tuple[str, str], float], float]:
    """The parts of the wrench that the pushes need, with the share of what each says, and the evidence that goes with the others.

    With the weights r of some parts held at zero the log evidence of a normal posterior changes by
    -1/2 w_r' S_rr^-1 w_r - 1/2 log det S_rr, without another fit. Parts are taken away while that grows; each that stays costs as
    much as there was to choose from.

    Args:
        weight: posterior mean w, shape (n_weights,).
        covariance: S, shape (n_weights, n_weights).
    """
    blocks = _blocks()

    def change(without: list[int]) -> float:
        if not without:
            return 0.0
        among = covariance[np.ix_(without, without)]
        w = weight[without]
        return float(-0.5 * w @ np.linalg.solve(among, w) - 0.5 * np.linalg.slogdet(among)[1])

    kept, best = dict(blocks), -_CHOICE * len(blocks)
    gone: list[int] = []
    while kept:
        value, part = max((change([*gone, *numbers]) - _CHOICE * (len(kept) - 1), part) for part, numbers in kept.items())
        if value <= best:
            break
        best = value
        gone += kept.pop(part)
    says = {part: max(change(gone) - change([*gone, *numbers]), 0.0) for part, numbers in kept.items()}
    total = max(sum(says.values()), 1e-9)
    return {part: share / total for part, share in says.items()}, best


def _blocks() -> dict[tuple[str, str], list[int]]:
    """Numbers of the weights of each part: a component and a feature."""
    blocks: dict[tuple[str, str], list[int]] = {}
    number = 0
    for component in COMPONENTS:
        for feature, functions in FEATURES.items():
            blocks[component, feature] = list(range(number, number + len(functions)))
            number += len(functions)
    return blocks
