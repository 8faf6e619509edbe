"""A smooth wrench for what no effect of the catalogue explains: its parts are what it acts on and what it varies with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from push_ident.diagnosis.fits import fit_some_values, polished
from push_ident.diagnosis.policy import UnknownPolicy
from push_ident.diagnosis.scores import EffectInformation, clipped_start, effect_information
from push_ident.diagnosis.selection import Selection
from push_ident.identification.fit import Fit
from push_ident.physics.effects.unknown_wrench import COMPONENTS, EFFECT, FEATURES

__all__ = ["SmoothWrench", "best_parts", "fit_wrench"]

Part: TypeAlias = tuple[str, str]
"""Of the wrench: a component and a feature."""


@dataclass(frozen=True, slots=True)
class SmoothWrench:
    """Maps and a smooth wrench that together fit the pushes."""

    fit: Fit
    """With those parts of the wrench that the pushes need."""
    log_bayes_factor: float
    """Over the base model, less what its parts cost for having been chosen [nat]."""
    acts_on: dict[str, float]
    """Share of each component of the wrench, see `COMPONENTS`; they sum to 1."""
    varies_with: dict[str, float]
    """The same of each feature, see `FEATURES`."""


def fit_wrench(selection: Selection, policy: UnknownPolicy) -> SmoothWrench | None:
    """Fit a smooth wrench in place of all effects that were added to the base model.

    Returns:
        None where there is no trace of one beside them.
    """
    beside_found = effect_information(selection.fit, (EFFECT.name,))
    if beside_found is None:
        return None
    if len(selection.found) < policy.imitating_effects and best_parts(beside_found, policy)[1] < policy.min_promise:
        return None
    base = selection.base
    information = effect_information(base, (EFFECT.name,)) if selection.found else beside_found
    if information is None:
        return None
    # The one-step estimate proposes the first parts, since it reaches far; what it missed is added part by part, from one fit to the next.
    expected = _expected_log_bayes_factors(information, [], policy)
    parts = best_parts(information, policy)[0] or [max(expected, key=lambda part: expected[part])]
    parts, fit = _grown(_fit_parts(base, parts, information, policy), parts, policy)
    fit = polished(fit)
    acts_on, varies_with = dict.fromkeys(COMPONENTS, 0.0), dict.fromkeys(FEATURES, 0.0)
    for (component, feature), share in _shares(fit, parts).items():
        acts_on[component] += share
        varies_with[feature] += share
    return SmoothWrench(fit, fit.log_evidence - base.log_evidence - policy.part_cost * len(parts), acts_on, varies_with)


def _grown(fit: Fit, parts: list[Part], policy: UnknownPolicy) -> tuple[list[Part], Fit]:
    """Add parts while one raises the log evidence by more than it costs."""
    while len(parts) < policy.max_parts:
        held = _information_of_held(fit, parts)
        expected = _expected_log_bayes_factors(held, parts, policy)
        part = max(expected, key=lambda part: expected[part])
        if expected[part] <= 0.0:
            break
        larger = _with_part(fit, parts, part, held, policy)
        if larger.log_evidence - policy.part_cost <= fit.log_evidence:
            break
        parts, fit = [*parts, part], larger
    return parts, fit


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


def best_parts(information: EffectInformation, policy: UnknownPolicy) -> tuple[list[Part], float]:
    """The parts of the wrench that the one-step estimate supports, and the log Bayes factor that they promise [nat].

    With the weights r of some parts left out, the log evidence of a normal posterior (w, S) changes by
    -1/2 w_r' S_rr^-1 w_r - 1/2 log det S_rr, without another fit. Parts are taken away while that grows, or there are too many; each
    that stays costs `policy.part_cost`.
    """
    covariance = np.asarray(np.linalg.inv(information.precision), dtype=np.float64)
    weight = -covariance @ information.slope
    value = -0.5 * float(information.slope @ weight) - 0.5 * float(np.linalg.slogdet(information.precision)[1])

    def change(without: list[int]) -> float:
        block = covariance[np.ix_(without, without)]
        w = weight[without]
        return float(-0.5 * w @ np.linalg.solve(block, w) - 0.5 * np.linalg.slogdet(block)[1])

    kept, best = list(_BLOCKS), -policy.part_cost * len(_BLOCKS)
    while kept:
        trials = {part: change(_numbers(p for p in _BLOCKS if p == part or p not in kept)) for part in kept}
        part = max(trials, key=lambda p: trials[p])
        if trials[part] - policy.part_cost * (len(kept) - 1) <= best and len(kept) <= policy.max_parts:
            break
        best = trials[part] - policy.part_cost * (len(kept) - 1)
        kept.remove(part)
    return kept, value + best


def _expected_log_bayes_factors(information: EffectInformation, parts: Sequence[Part], policy: UnknownPolicy) -> dict[Part, float]:
    """Of each part beside those that are fitted, less what it costs [nat]."""
    expected = {}
    for part in _BLOCKS:
        if part not in parts:
            own = _BLOCKS[part]
            slope, precision = information.slope[own], information.precision[np.ix_(own, own)]
            gain = 0.5 * slope @ np.linalg.solve(precision, slope) - 0.5 * np.linalg.slogdet(precision)[1]
            expected[part] = float(gain) - policy.part_cost
    return expected


def _fit_parts(base: Fit, parts: Sequence[Part], information: EffectInformation, policy: UnknownPolicy) -> Fit:
    """Fit some parts of the wrench from their one-step estimate; all others stay at zero."""
    own = _numbers(parts)
    start = np.zeros(len(information.slope))
    start[own] = -np.linalg.solve(information.precision[np.ix_(own, own)], information.slope[own])
    start = clipped_start(start, policy.max_start)
    first = base.effect_unknowns
    held = [number for number in range(len(start)) if number not in own]
    return fit_some_values(base, (*base.names, EFFECT.name), np.concatenate([first, start]), [len(first) + number for number in held])


def _with_part(fit: Fit, parts: Sequence[Part], part: Part, held: EffectInformation, policy: UnknownPolicy) -> Fit:
    """Fit one more part from its one-step estimate, the others from where they are."""
    own = _BLOCKS[part]
    estimate = np.asarray(-np.linalg.solve(held.precision[np.ix_(own, own)], held.slope[own]))
    start = np.array(fit.effect_unknowns)
    first = fit.effects.slice_of(EFFECT.name).start
    start[[first + number for number in own]] = clipped_start(estimate, policy.max_start)
    free = _numbers([*parts, part])
    return fit_some_values(fit, fit.names, start, [first + n for n in range(len(EFFECT.parameters)) if n not in free])


def _information_of_held(fit: Fit, parts: Sequence[Part]) -> EffectInformation:
    """Information about the weights that are held at zero, beside all that is fitted; fitted weights count as known."""
    first, n = fit.unknowns.slice_of_effect(EFFECT.name).start, len(EFFECT.parameters)
    fitted = np.array([i for i in range(fit.problem.size) if not first <= i < first + n or i - first in _numbers(parts)])
    held = np.array([first + number for number in range(n) if number not in _numbers(parts)])
    # Without the precision that holds them.
    n_poses = fit.problem.size - fit.unknowns.size
    hessian, gradient = fit.end.hessian, fit.end.gradient
    if (frozen := fit.unknowns.frozen_cost) is not None:
        hessian = hessian - np.pad(frozen.hessian, (0, n_poses))
        gradient = gradient - np.pad(frozen.slope(fit.z), (0, n_poses))
    onto = np.linalg.solve(hessian[np.ix_(fitted, fitted)], hessian[np.ix_(fitted, held)]).T
    precision, slope = np.eye(n), np.zeros(n)
    own = held - first
    precision[np.ix_(own, own)] = hessian[np.ix_(held, held)] - onto @ hessian[np.ix_(fitted, held)]
    slope[own] = gradient[held] - onto @ gradient[fitted]
    return EffectInformation({EFFECT.name: np.arange(n)}, precision, slope)


def _shares(fit: Fit, parts: Sequence[Part]) -> dict[Part, float]:
    """Share of each part in the evidence of the wrench: the log evidence that is lost without it."""
    first = fit.unknowns.slice_of_effect(EFFECT.name).start
    weight, covariance = fit.z[first:], fit.covariance[first:, first:]
    evidence = {}
    for part in parts:
        own = _BLOCKS[part]
        block = covariance[np.ix_(own, own)]
        evidence[part] = max(float(0.5 * weight[own] @ np.linalg.solve(block, weight[own]) + 0.5 * np.linalg.slogdet(block)[1]), 1e-3)
    total = sum(evidence.values())
    return {part: value / total for part, value in evidence.items()}
