"""What no effect of the catalogue explains: a smooth wrench, what it acts on, and what it varies with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from push_ident.diagnosis.fits import EffectFit, fit_effects_but, polished
from push_ident.diagnosis.scores import Information, information_beside
from push_ident.diagnosis.selection import Selection
from push_ident.physics.effects.unknown_wrench import COMPONENTS, EFFECT, FEATURES

__all__ = ["SmoothWrench", "find_unknown"]

_PROMISING = 3.0
"""Expected gain of log evidence beside all that was named below which a refit is not worth its time [nat]."""
_IMITATED = 2
"""Effects that together may imitate a wrench so well that no trace of it is left beside them."""
_MAX_START = 2.0
"""A guess is not taken further than so many prior deviations."""
_CHOICE = 2.0
"""What a part costs for having been chosen among all [nat]."""
_MOST_PARTS = 8
"""Of which a wrench is made at most."""
_STANDS_OUT = 0.2
"""Share of all that the wrench says from which a part of it is named."""


Part: TypeAlias = tuple[str, str]
"""Of the wrench: a component and a feature."""


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
    if told is None or (len(selection.found) < _IMITATED and _best_parts(told)[1] < _PROMISING):
        return None
    base = selection.base
    beside = information_beside(base, (EFFECT.name,)) if selection.found else told
    if beside is None:
        return None
    # The first proposal is that of the linear guess, which reaches far; what it missed is added part by part, from one fit to the next.
    promises = _promises(beside, [])
    parts = _best_parts(beside)[0] or [max(promises, key=lambda part: promises[part])]
    fit = _fit_parts(base, parts, beside)
    while len(parts) < _MOST_PARTS:
        held = _information_of_held(fit, parts)
        promises = _promises(held, parts)
        part = max(promises, key=lambda part: promises[part])
        if promises[part] <= 0.0:
            break
        larger = _with_part(fit, parts, part, held)
        if larger.log_evidence - _CHOICE <= fit.log_evidence:
            break
        parts, fit = [*parts, part], larger
    fit = polished(fit)
    says = _says(fit, parts)
    acts_on, varies_with = dict.fromkeys(COMPONENTS, 0.0), dict.fromkeys(FEATURES, 0.0)
    for (component, feature), share in says.items():
        acts_on[component] += share
        varies_with[feature] += share
    return SmoothWrench(fit, fit.log_evidence - base.log_evidence - _CHOICE * len(parts), acts_on, varies_with)


def _blocks() -> dict[Part, list[int]]:
    """Numbers of the weights of each part."""
    blocks: dict[Part, list[int]] = {}
    number = 0
    for component in COMPONENTS:
        for feature, functions in FEATURES.items():
            blocks[component, feature] = list(range(number, number + len(functions)))
            number += len(functions)
    return blocks


_BLOCKS: Final = _blocks()


def _numbers(parts: Iterable[Part]) -> list[int]:
    return [number for part in parts for number in _BLOCKS[part]]


def _best_parts(told: Information) -> tuple[list[Part], float]:
    """The parts of the wrench that the pushes speak for by the linear guess, and the gain of log evidence that they promise [nat].

    With the weights r of some parts left out the log evidence of a normal posterior (w, S) changes by
    -1/2 w_r' S_rr^-1 w_r - 1/2 log det S_rr, without another fit. Parts are taken away while that grows, or there are too many; each
    that stays costs as much as there was to choose from.
    """
    covariance = np.asarray(np.linalg.inv(told.precision), dtype=np.float64)
    weight = -covariance @ told.slope
    value = -0.5 * float(told.slope @ weight) - 0.5 * float(np.linalg.slogdet(told.precision)[1])

    def change(without: list[int]) -> float:
        among = covariance[np.ix_(without, without)]
        w = weight[without]
        return float(-0.5 * w @ np.linalg.solve(among, w) - 0.5 * np.linalg.slogdet(among)[1])

    kept, best = list(_BLOCKS), -_CHOICE * len(_BLOCKS)
    while kept:
        trials = {part: change(_numbers(p for p in _BLOCKS if p == part or p not in kept)) for part in kept}
        part = max(trials, key=lambda p: trials[p])
        if trials[part] - _CHOICE * (len(kept) - 1) <= best and len(kept) <= _MOST_PARTS:
            break
        best = trials[part] - _CHOICE * (len(kept) - 1)
        kept.remove(part)
    return kept, value + best


def _promises(told: Information, parts: Sequence[Part]) -> dict[Part, float]:
    """Expected gain of log evidence of each part beside those that are fitted, less what it costs to choose it [nat]."""
    promises = {}
    for part in _BLOCKS:
        if part not in parts:
            own = _BLOCKS[part]
            slope, precision = told.slope[own], told.precision[np.ix_(own, own)]
            gain = 0.5 * slope @ np.linalg.solve(precision, slope) - 0.5 * np.linalg.slogdet(precision)[1]
            promises[part] = float(gain) - _CHOICE
    return promises


def _fit_parts(base: EffectFit, parts: Sequence[Part], told: Information) -> EffectFit:
    """Fit some parts of the wrench, from where the linear guess puts them; all others stay at zero."""
    own = _numbers(parts)
    start = np.zeros(len(told.slope))
    start[own] = -np.linalg.solve(told.precision[np.ix_(own, own)], told.slope[own])
    start *= min(1.0, _MAX_START / max(float(np.linalg.norm(start)), 1e-9))
    first = base.z[base.parameters.effect_slice]
    held = [number for number in range(len(start)) if number not in own]
    return fit_effects_but(base, (*base.names, EFFECT.name), np.concatenate([first, start]), [len(first) + number for number in held])


def _with_part(fit: EffectFit, parts: Sequence[Part], part: Part, held: Information) -> EffectFit:
    """Fit one part more, from where the others stand and where the linear guess puts it."""
    own = _BLOCKS[part]
    guess = -np.linalg.solve(held.precision[np.ix_(own, own)], held.slope[own])
    start = np.array(fit.z[fit.parameters.effect_slice])
    first = fit.effects.slice_of(EFFECT.name).start
    start[[first + number for number in own]] = guess * min(1.0, _MAX_START / max(float(np.linalg.norm(guess)), 1e-9))
    free = _numbers([*parts, part])
    return fit_effects_but(fit, fit.names, start, [first + n for n in range(len(EFFECT.parameters)) if n not in free])


def _place(fit: EffectFit) -> slice:
    """Where the weights stand among the unknowns."""
    own, first = fit.parameters.effects.slice_of(EFFECT.name), fit.parameters.effect_slice.start
    return slice(first + own.start, first + own.stop)


def _information_of_held(fit: EffectFit, parts: Sequence[Part]) -> Information:
    """What the pushes tell of the weights that are held at zero beside all that is fitted; those that are not count as known."""
    first, n = _place(fit).start, len(EFFECT.parameters)
    fitted = np.array([i for i in range(fit.problem.size) if not first <= i < first + n or i - first in _numbers(parts)])
    held = np.array([first + number for number in range(n) if number not in _numbers(parts)])
    # Without what holds them.
    n_poses = fit.problem.size - fit.parameters.size
    hessian, gradient = fit.end.hessian, fit.end.gradient
    if (frozen := fit.unknowns.frozen_cost) is not None:
        hessian = hessian - np.pad(frozen.hessian, (0, n_poses))
        gradient = gradient - np.pad(frozen.slope(fit.z), (0, n_poses))
    onto = np.linalg.solve(hessian[np.ix_(fitted, fitted)], hessian[np.ix_(fitted, held)]).T
    precision, slope = np.eye(n), np.zeros(n)
    own = held - first
    precision[np.ix_(own, own)] = hessian[np.ix_(held, held)] - onto @ hessian[np.ix_(fitted, held)]
    slope[own] = gradient[held] - onto @ gradient[fitted]
    return Information({EFFECT.name: np.arange(n)}, precision, slope)


def _says(fit: EffectFit, parts: Sequence[Part]) -> dict[Part, float]:
    """Share of each part in what the wrench says: the evidence that would go with it."""
    first = _place(fit).start
    weight, covariance = fit.z[first:], fit.covariance[first:, first:]
    says = {}
    for part in parts:
        own = _BLOCKS[part]
        among = covariance[np.ix_(own, own)]
        says[part] = max(float(0.5 * weight[own] @ np.linalg.solve(among, weight[own]) + 0.5 * np.linalg.slogdet(among)[1]), 1e-3)
    total = sum(says.values())
    return {part: share / total for part, share in says.items()}
