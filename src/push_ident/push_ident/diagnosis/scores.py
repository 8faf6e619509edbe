"""Tests of every absent effect from one fit, without refitting.

The motion is differentiable by the parameters of an effect at their null, so how much an effect would gain is known at once to second order
(Rao's score test with the maps, the scales and the first poses as nuisances):

    S = H_ee - H_eb H_bb^-1 H_be,   g = g_e - H_eb H_bb^-1 g_b         e: parameters of the effect, b: everything that was fitted
    estimate -(S + 1)^-1 g,   gain of log evidence 1/2 g' (S + 1)^-1 g - 1/2 log det(S + 1)      (parameters in units of their prior)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from push_ident.diagnosis.fits import EffectFit
from push_ident.physics.effects import CAUSES, EFFECTS
from push_ident.types import Float64Array

__all__ = ["EffectScore", "Information", "information_beside", "score_effects"]

_MAX_START = 2.0
"""A guess is not taken further than so many prior deviations."""


@dataclass(frozen=True, slots=True)
class EffectScore:
    """What one absent effect promises."""

    name: str
    gain: float
    """Expected of log evidence [nat]; below 0 where the effect explains less than its freedom costs."""
    start: Float64Array
    """Guess of its unknowns, in units of their prior, shape (n_parameters,)."""
    information: Float64Array
    """S, what these data would tell of the unknowns beside everything else, shape (n_parameters, n_parameters)."""
    smallest: float
    """Size of its first parameter that would just have been seen, in its unit; infinite where none that makes sense would."""


@dataclass(frozen=True, slots=True)
class Information:
    """What pushes tell of absent effects beside everything that was fitted."""

    places: dict[str, NDArray[np.int64]]
    """Where the unknowns of each effect stand."""
    precision: Float64Array
    """S + 1 of all of them, their prior being the 1, shape (n, n)."""
    slope: Float64Array
    """g, shape (n,)."""


def information_beside(fit: EffectFit, names: Sequence[str] = ()) -> Information | None:
    """What the pushes of a fit tell of effects that it does not have.

    Args:
        fit: converged.
        names: of the effects; by default all that name a cause.

    Returns:
        None where the pushes cannot be simulated.
    """
    absent = [name for name in names or CAUSES if name not in fit.names]
    before = fit.unknowns
    unknowns = before.with_effects((*fit.names, *absent))
    problem = fit.problem.of(unknowns)
    n_new, start = unknowns.size - before.size, before.slice_of("effects").stop
    new = np.arange(start, start + n_new)
    end = problem.evaluate(np.insert(fit.x, start, np.zeros(n_new)))
    if not np.isfinite(end.cost):
        return None
    fitted = np.setdiff1d(np.arange(problem.size), new)
    onto = np.linalg.solve(end.hessian[np.ix_(fitted, fitted)], end.hessian[np.ix_(fitted, new)]).T
    own = [unknowns.effects.slice_of(name) for name in absent]
    places = {name: np.arange(o.start, o.stop) - len(before.effects) for name, o in zip(absent, own, strict=True)}
    between = end.hessian[np.ix_(fitted, new)]
    return Information(places, end.hessian[np.ix_(new, new)] - onto @ between, end.gradient[new] - onto @ end.gradient[fitted])


def score_effects(told: Information | None, seen: float) -> list[EffectScore]:
    """Score absent effects, the most promising first; none where nothing is told.

    Args:
        told: by the pushes.
        seen: gain of log evidence from which an effect counts as seen [nat].
    """
    if told is None:
        return []
    scores = [_score(name, told.precision[np.ix_(place, place)], told.slope[place], seen) for name, place in told.places.items()]
    return sorted(scores, key=lambda score: -score.gain)


def _score(name: str, precision: Float64Array, slope: Float64Array, seen: float) -> EffectScore:
    free = np.array([not p.shape for p in EFFECTS[name].parameters])
    start = np.zeros(len(free))
    held = precision[np.ix_(free, free)]
    start[free] = -np.linalg.solve(held, slope[free])
    gain = 0.5 * float(slope[free] @ np.linalg.solve(held, slope[free])) - 0.5 * float(np.linalg.slogdet(held)[1])
    information = precision - np.eye(len(free))
    size = np.linalg.norm(start)
    if size > _MAX_START:
        start *= _MAX_START / size
    return EffectScore(name, gain, start, information, _smallest(name, held, seen))


def _smallest(name: str, precision: Float64Array, seen: float) -> float:
    """Along the first parameter: 1/2 e^2 S^2 / (S + 1) - 1/2 log det(S + 1) = seen, the mean gain of a true value e."""
    first = float(precision[0, 0])
    told = first - 1.0
    if told <= 1e-9:
        return float("inf")
    needed = seen + 0.5 * float(np.linalg.slogdet(precision)[1])
    parameter = EFFECTS[name].parameters[0]
    size = float(np.sqrt(2.0 * needed * first) / told * parameter.scale)
    return size if size <= max(abs(parameter.low), abs(parameter.high)) else float("inf")
