"""Score tests of every absent effect from one fit, without refitting.

The motion is differentiable by the parameters of an effect at their null, so the gain of an effect is known at once to second order
(Rao's score test with the maps, the scales and the first poses as nuisance parameters):

    S = H_ee - H_eb H_bb^-1 H_be,   g = g_e - H_eb H_bb^-1 g_b         e: parameters of the effect, b: everything that was fitted
    estimate -(S + 1)^-1 g,   log Bayes factor 1/2 g' (S + 1)^-1 g - 1/2 log det(S + 1)      (parameters in units of their prior)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.identification.fitting.discrepancy import WIDTH, FrameErrors, LinearPushes
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.problem import FitProblem
from push_ident.physics.effect_values import effect_values
from push_ident.physics.effects import CAUSES, EFFECTS, FORCE_CAUSES
from push_ident.threads import map_in_threads
from push_ident.types import Float64Array

_ROUNDS: Final = 3
"""Of the size of errors of frames and of the discrepancy in turn."""
_SAME_SIZE: Final = 0.05
"""Of the logarithm of the former [-]."""


@dataclass(frozen=True, slots=True)
class EffectScore:
    """What one absent effect promises before it is refitted."""

    name: str
    expected_log_bayes_factor: float
    """[nat]; below 0 where the effect explains less than its freedom costs."""
    start: Float64Array
    """One-step estimate of its unknowns, clipped, in units of their prior, shape (n_parameters,)."""
    information: Float64Array
    """S, of the unknowns beside everything that is fitted, shape (n_parameters, n_parameters)."""
    smallest_detectable: float
    """Size of its first parameter that would be detected on average, in its unit; infinite where no sensible size would."""
    under_usual: bool = False
    """Whether it is that near a fit with a discrepancy of the usual size."""
    by_chance: float = 0.0
    """What a change since a reference gains by chance, which is taken from its log Bayes factors [nat]."""

    def beyond(self, by_chance: float) -> EffectScore:
        """The score less what the effect gains by chance [nat]."""
        return replace(self, expected_log_bayes_factor=self.expected_log_bayes_factor - by_chance, by_chance=by_chance)


@dataclass(frozen=True, slots=True)
class EffectInformation:
    """What the pushes determine about absent effects beside everything that was fitted."""

    indices: dict[str, NDArray[np.int64]]
    """Places of the unknowns of each effect."""
    precision: Float64Array
    """S + 1 of all of them, where 1 is their prior, shape (n, n)."""
    slope: Float64Array
    """g, shape (n,)."""
    linear: LinearRange | None = None
    """Where the size of a discrepancy is set by the pushes, of everything fitted and the effects."""


@dataclass(frozen=True, slots=True)
class LinearRange:
    """A fit with absent effects in its linear range, under any size of its discrepancy.

    What an absent effect does to the pushes counts as discrepancy in the fit without it. With it, the discrepancy is smaller.
    """

    pushes: LinearPushes
    fitted: NDArray[np.intp]
    """Unknowns of the object that the fit has, among all."""
    new: NDArray[np.intp]
    """Those of the absent effects."""
    x: Float64Array
    """All unknowns at the fit, shape (size,)."""
    residual: Float64Array
    """Whitened, shape (n_frames, 3)."""
    jacobian: Float64Array
    """Its derivative, shape (3 n_frames, size)."""
    forces: Float64Array
    """Whitened residuals of measured forces, shape (n_windows, 2); of no windows where there are none."""
    by_forces: Float64Array
    """Their derivative, shape (2 n_windows, size)."""
    errors: FrameErrors

    def log_evidence(self, effect: NDArray[np.intp], policy: SelectionPolicy) -> tuple[float, Float64Array]:
        """With some of the new unknowns, up to a constant [nat], and the unknowns of the object of largest density."""
        chosen = np.r_[self.fitted, self.new[effect]]
        starts = [np.zeros(3)]
        if np.max(np.exp(self.pushes.first)) > policy.usual_discrepancy:  # it may be what the effect does
            starts.append(-self.pushes.first)
        return max((self._log_evidence_from(chosen, logs) for logs in starts), key=itemgetter(0))

    def _log_evidence_from(self, chosen: NDArray[np.intp], logs: Float64Array) -> tuple[float, Float64Array]:
        """With some unknowns of the object; `logs`: logarithms of the factors of the discrepancy at the start, shape (3,)."""
        n, linear, log = len(self.pushes.at), self.pushes.of_unknowns(chosen), 0.0
        for _ in range(_ROUNDS):
            weighted, before = linear.weighted(np.exp(-2.0 * log)), log
            logs = weighted.best(logs)
            linear = replace(linear, precisions=weighted.with_precisions(logs).precisions)
            at = linear.weighted(np.exp(-2.0 * log)).solve(logs)
            moved = -self.x
            moved[chosen] += at.unknowns
            moved[n:] += at.of_push.ravel()
            residual = self.residual + (self.jacobian @ moved).reshape(-1, 3)
            log = self.errors.best(residual)
            if abs(log - before) < _SAME_SIZE:
                break
        group, factor = self.pushes.group, np.exp(-logs)
        of_pushes = at.of_push[:, group >= 0] * factor[group[group >= 0]]
        size2 = float(
            np.sum(at.unknowns**2) + linear.precisions @ np.sum(of_pushes**2, axis=1) + np.sum(((self.pushes.first + logs) / WIDTH) ** 2)
        )
        forces = self.forces + (self.by_forces @ moved).reshape(-1, 2)
        cost = self.errors.cost(residual, log) + self.errors.cost_of_first(residual) + FitProblem.weigh(forces)[0]
        cost += 0.5 * size2 + at.volume + linear.log_size(logs)
        return -cost, at.unknowns


def effect_information(fit: Fit, *, shared: bool = False) -> EffectInformation | None:
    """Information of the pushes of a fit about all effects that they can show and it does not have; None where they cannot be simulated.

    `shared`: about effects that pushes of a reference have, too; without it, beside a reference, about changes since.
    """
    visible = (*CAUSES, *FORCE_CAUSES) if fit.problem.uses_forces else CAUSES
    before = fit.unknowns
    known = before.shared if shared else before.effects
    assert known is not None, "only pushes beside a reference share effects"
    absent = [name for name in visible if name not in known.names]
    with_all = effect_values((*known.names, *absent))
    unknowns = replace(before, shared=with_all) if shared else replace(before, effects=with_all)
    problem = fit.problem.of(unknowns)
    n_new, start = unknowns.size - before.size, before.slices["shared_effects" if shared else "effects"].stop
    new = np.arange(start, start + n_new)
    x = np.insert(fit.x, start, np.zeros(n_new))
    end = problem.evaluate(x)
    if not np.isfinite(end.cost):
        return None
    fitted = np.setdiff1d(np.arange(problem.size), new)
    onto = np.linalg.solve(end.hessian[np.ix_(fitted, fitted)], end.hessian[np.ix_(fitted, new)]).T
    slices = [with_all.slice_of(name) for name in absent]
    indices = {name: np.arange(o.start, o.stop) - len(known) for name, o in zip(absent, slices, strict=True)}
    between = end.hessian[np.ix_(fitted, new)]
    precision, slope = end.hessian[np.ix_(new, new)] - onto @ between, end.gradient[new] - onto @ end.gradient[fitted]
    noise = problem.noise
    linear = problem.linearise(x) if noise is not None and noise.discrepancy_modes else None
    if linear is None:
        return EffectInformation(indices, precision, slope)
    pushes, errors = LinearPushes.of(problem, x, end.hessian, end.gradient), FrameErrors.of(fit.problem, fit.end)
    of_object = np.arange(unknowns.size)
    fitted_of_object, forces = np.setdiff1d(of_object, new), np.concatenate(linear.forces)
    in_range = LinearRange(pushes, fitted_of_object, new, x, end.residual, linear.by_poses, forces, linear.by_forces, errors)
    return EffectInformation(indices, precision, slope, in_range)


def score_effects(information: EffectInformation | None, policy: SelectionPolicy) -> list[EffectScore]:
    """Score absent effects, the most promising first; none where there is no information."""
    if information is None:
        return []
    precision, slope = information.precision, information.slope
    scores = [_score(name, precision[np.ix_(index, index)], slope[index], policy) for name, index in information.indices.items()]
    if (linear := information.linear) is not None:
        without = linear.log_evidence(np.zeros(0, dtype=np.intp), policy)[0]
        scores = map_in_threads(lambda score: _in_range(score, linear, information.indices[score.name], without, policy), scores)
    return sorted(scores, key=lambda score: -score.expected_log_bayes_factor)


def score_in_place(fit: Fit, name: str, gained: float, policy: SelectionPolicy) -> list[EffectScore]:
    """Scores of absent effects in the place of one that a fit has, relative to it; none where the pushes have no linear range.

    Errors of tool, camera, clock and outline move the contact alike. Near a fit that has one of them, the others need not move it first.
    `gained`: by the effect [nat]. Where the linear range does not show most of that as lost without it, as of the friction of a pusher that
    sticks with it, there is none.
    """
    information = effect_information(fit)
    if information is None or information.linear is None:
        return []
    taken = fit.unknowns.slice_of_effect(name)
    linear = information.linear
    # Its columns keep their places: those of absent effects follow.
    others = replace(linear, fitted=np.setdiff1d(linear.fitted, np.arange(taken.start, taken.stop)))
    try:
        with_it, without = (one.log_evidence(np.zeros(0, dtype=np.intp), policy)[0] for one in (linear, others))
    except np.linalg.LinAlgError:
        return []
    if with_it - without < policy.promise_share * gained:
        return []
    scores = score_effects(replace(information, linear=None), policy)
    unscored = [replace(score, expected_log_bayes_factor=-np.inf) for score in scores]
    return map_in_threads(lambda score: _in_range(score, others, information.indices[score.name], with_it, policy), unscored)


def clipped_start(start: Float64Array, max_start: float) -> Float64Array:
    """A one-step estimate, shortened to `max_start` prior standard deviations where it is longer: the linear range ends there."""
    size = float(np.linalg.norm(start))
    return start * (max_start / size) if size > max_start else start


def _in_range(score: EffectScore, linear: LinearRange, index: NDArray[np.int64], without: float, policy: SelectionPolicy) -> EffectScore:
    """The score under the size of the discrepancy that is left beside the effect."""
    free = np.array([not p.shape for p in EFFECTS[score.name].parameters])
    try:
        evidence, unknowns = linear.log_evidence(index[free], policy)
    except np.linalg.LinAlgError:
        return score
    start = np.zeros(len(free))
    start[free] = unknowns[len(linear.fitted) :]
    return replace(score, expected_log_bayes_factor=evidence - without, start=clipped_start(start, policy.max_start))


def _score(name: str, precision: Float64Array, slope: Float64Array, policy: SelectionPolicy) -> EffectScore:
    free = np.array([not p.shape for p in EFFECTS[name].parameters])
    start = np.zeros(len(free))
    held = precision[np.ix_(free, free)]
    start[free] = -np.linalg.solve(held, slope[free])
    expected = 0.5 * float(slope[free] @ np.linalg.solve(held, slope[free])) - 0.5 * float(np.linalg.slogdet(held)[1])
    information = precision - np.eye(len(free))
    smallest = _smallest_detectable(name, held, policy.min_log_bayes_factor)
    return EffectScore(name, expected, clipped_start(start, policy.max_start), information, smallest)


def _smallest_detectable(name: str, precision: Float64Array, min_log_bayes_factor: float) -> float:
    """Along the first parameter: a true value e brings 1/2 e^2 S^2 / (S + 1) - 1/2 log det(S + 1) on average, set to the threshold."""
    first = float(precision[0, 0])
    information = first - 1.0
    if information <= 1e-9:
        return float("inf")
    needed = min_log_bayes_factor + 0.5 * float(np.linalg.slogdet(precision)[1])
    parameter = EFFECTS[name].parameters[0]
    size = float(np.sqrt(2.0 * needed * first) / information * parameter.scale)
    return size if size <= max(abs(parameter.low), abs(parameter.high)) else float("inf")
