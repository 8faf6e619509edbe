"""Something else as a hypothesis: structure in the residuals that no law of the catalogue stands for.

With the residuals r of a fit (poses, and forces where they are measured), weighted as in its cost, their derivative J by everything that
was fitted and the precision P of the prior,
patterns Phi (`patterns.py`) whose amplitudes have the prior N(0, s^2) raise the log evidence, in the linear range of the fit, by

    B(s) = 1/2 g' (1/s^2 + A)^-1 g - 1/2 log det(1 + s^2 A),       g = Phi' M r,  A = Phi' M Phi,  M = 1 - J (J'J + P)^-1 J'

Where the size of the discrepancy that the frames of a push share is set by the pushes, what a structure does to them counts as discrepancy
in a fit without it. Beside it the discrepancy is smaller, so that B is also computed under smaller sizes, each weighted by its evidence.

M projects out what maps, scales, first poses and named effects could explain. It is the score test of a random effect (Liang, A locally
most powerful test for homogeneity, Biometrika 1987) with its Bayes factor (Rasmussen & Williams, Gaussian Processes for Machine Learning,
2006, section 5.4.1). One hypothesis is the mean of exp B over scales, members and families: each counts by its prior probability, which is
what having looked everywhere costs. The p-value comes from draws of the noise that pass through the same computation. The
factors without each fold of the pushes tell whether a cause acts in all of them or something happened in a few (`odds.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from push_ident.diagnosis.policy import DecisionPolicy
from push_ident.diagnosis.residuals import draw_noise
from push_ident.diagnosis.something_else.family import Family, Member
from push_ident.diagnosis.something_else.patterns import pattern_families
from push_ident.diagnosis.something_else.precision import AmplitudePrecision
from push_ident.geometry.cells import cell_displacement
from push_ident.identification.fitting.discrepancy import groups_of, log_bayes_factor_of_larger, log_prior_of_size
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effect import Mechanism
from push_ident.threads import map_in_threads
from push_ident.types import BoolArray, Float64Array


@dataclass(frozen=True, slots=True)
class Pattern:
    """The best member of a family, with its amplitudes."""

    family: Family
    member: Member
    scale: float
    """Prior standard deviation of the amplitudes under which the evidence is largest."""
    log_bayes_factor: float
    """Of the whole family over the fit [nat]."""
    share: float
    """Probability of the family, if there is something else."""
    amplitude: Float64Array
    """Of each column of the family, shape (n_columns,)."""
    std: float
    """Of the largest amplitude."""


@dataclass(frozen=True, slots=True)
class SomethingElse:
    """What the residuals of a fit show of a cause outside the catalogue."""

    log_bayes_factor: float
    """Of anything of the kind over the fit, all families counted with their prior probability [nat]."""
    p_value: float
    """Probability of as large a log Bayes factor under noise alone."""
    patterns: tuple[Pattern, ...]
    """Of each family, the most probable first."""
    of_discrepancy: float
    """Log Bayes factor of a discrepancy between pushes and model that is larger than usual, in each push in another way [nat]."""
    without: Float64Array
    """Log Bayes factors of the patterns without each fold of the pushes [nat], shape (n_folds, n_patterns); of no folds where none were
    asked for, or nothing was found."""

    @property
    def least(self) -> float:
        """Log Bayes factor of anything of the kind that is left without any one fold [nat]."""
        of_folds = logsumexp(self.without, axis=1) - np.log(len(self.patterns))
        return float(np.min(of_folds, initial=self.log_bayes_factor))

    @property
    def best(self) -> Pattern:
        """Of the most probable family."""
        return self.patterns[0]

    @property
    def mechanisms(self) -> tuple[Mechanism, ...]:
        """Those of which some family is a free law, the most probable first."""
        return tuple(dict.fromkeys(p.family.mechanism for p in self.patterns if p.family.mechanism is not None))

    def of(self, mechanism: Mechanism | None) -> tuple[Pattern, ...]:
        """Free laws of a mechanism, the most probable first; of None those that are no law of any mechanism."""
        return tuple(pattern for pattern in self.patterns if pattern.family.mechanism is mechanism)

    def log_bayes_factors(self, mechanism: Mechanism | None) -> tuple[float, float]:
        """Of the families of a mechanism, each with the prior probability of one of all [nat]: with all pushes, and the least that is left
        without any one fold."""
        here = np.array([pattern.family.mechanism is mechanism for pattern in self.patterns])
        values = np.array([pattern.log_bayes_factor for pattern in self.patterns])
        of_all = float(logsumexp(values[here]) - np.log(len(here)))
        return of_all, float(np.min(logsumexp(self.without[:, here], axis=1) - np.log(len(here)), initial=of_all))

    def log_bayes_factor_as_law(self, mechanism: Mechanism) -> float:
        """Of the free laws of a mechanism among each other [nat]."""
        laws = self.of(mechanism)
        return float(logsumexp([law.log_bayes_factor for law in laws]) - np.log(len(laws)))


_SIZES: Final = (1.0, 0.3, 0.1)
"""Sizes of the shared discrepancy relative to that of the fit, as equally likely beforehand as those of a log-normal prior [1]."""


@dataclass(frozen=True, slots=True)
class _Linear:
    """A fit in its linear range, rows weighted as in its cost: poses of all pushes, then measured forces."""

    jacobian: Float64Array
    """Shape (n_rows, n_unknowns)."""
    observed: Float64Array
    """Observed minus simulated, shape (n_rows,)."""
    weight: Float64Array
    """Root of the weight of each frame and of each mean force, shape (n_rows,)."""
    prior: tuple[float, Float64Array, Float64Array]
    """Cost at the fit of the prior of the unknowns and of what is known of them beforehand, its gradient, shape (n_unknowns,), and its
    Hessian, shape (n_unknowns, n_unknowns)."""
    log_prior: float
    """Of the size of the discrepancy, up to a constant [nat]."""
    rows: tuple[NDArray[np.int64], ...]
    """Rows of each push."""
    hessian: Float64Array
    """J'J + P, shape (n_unknowns, n_unknowns)."""
    onto: Float64Array
    """(J'J + P)^-1 J', shape (n_unknowns, n_rows)."""
    residual: Float64Array
    """At the optimum of the quadratic approximation, observed minus simulated, shape (n_rows,)."""

    @classmethod
    def of(
        cls,
        prior: tuple[float, Float64Array, Float64Array],
        jacobian: Float64Array,
        observed: Float64Array,
        weight: Float64Array,
        rows: tuple[NDArray[np.int64], ...],
        log_prior: float = 0.0,
    ) -> _Linear:
        """With the minimum of the quadratic approximation."""
        hessian = jacobian.T @ jacobian + prior[2]
        onto = np.asarray(np.linalg.solve(hessian, jacobian.T), dtype=np.float64)
        linear = cls(jacobian, observed, weight, prior, log_prior, rows, hessian, onto, observed)
        return replace(linear, residual=np.asarray(observed - jacobian @ linear.step(observed)))

    @property
    def log_evidence(self) -> float:
        """Of the size of the discrepancy, without any pattern, up to a constant [nat]."""
        step, (cost, gradient, hessian) = self.step(self.observed), self.prior
        cost += float(gradient @ step + 0.5 * step @ hessian @ step + 0.5 * self.residual @ self.residual)
        return self.log_prior - 0.5 * float(np.linalg.slogdet(self.hessian)[1]) - cost

    def without_fitted(self, columns: Float64Array) -> Float64Array:
        """M times columns, shape (n_rows, n)."""
        return columns - self.jacobian @ (self.onto @ columns)

    def step(self, observed: Float64Array) -> Float64Array:
        """From the fit to the optimum of the quadratic approximation, for `observed` as in the field, shape (n_unknowns,)."""
        slope = self.jacobian.T @ observed - self.prior[1]
        return np.asarray(np.linalg.solve(self.hessian, slope), dtype=np.float64)

    def without(self, layout: _Layout, fold: Sequence[int]) -> _Linear:
        """The same without some pushes."""
        used = layout.without(fold)
        rows = layout.rows_of_pushes(used)
        return _Linear.of(self.prior, self.jacobian[used], self.observed[used], self.weight[used], rows, self.log_prior)


@dataclass(frozen=True, slots=True)
class _Layout:
    """Which rows belong to which push."""

    poses: NDArray[np.int64]
    """First row of the poses of each push, and the end of those of the last one, shape (n_pushes + 1,)."""
    forces: NDArray[np.int64]
    """The same of its measured forces."""

    @classmethod
    def of(cls, fit: Fit) -> _Layout:
        poses = np.cumsum([0, *(3 * len(observation.time) for observation in fit.problem.observations)])
        n_rows = [0 if mean is None else 2 * len(mean.force) for mean in fit.problem.forces]
        return cls(poses, poses[-1] + np.cumsum([0, *n_rows]))

    @property
    def all(self) -> BoolArray:
        """A mask of all rows."""
        return np.ones(self.forces[-1], dtype=bool)

    def without(self, fold: Sequence[int]) -> BoolArray:
        """All rows but those of some pushes, of which only the first frame stays: it is the prior of their first pose."""
        used = self.all
        for push in fold:
            used[self.poses[push] + 3 : self.poses[push + 1]] = False
            used[self.forces[push] : self.forces[push + 1]] = False
        return used

    def rows_of_pushes(self, used: BoolArray) -> tuple[NDArray[np.int64], ...]:
        """Rows of each push among those of a mask."""
        number = np.cumsum(used) - 1
        ends = zip(self.poses, self.poses[1:], self.forces, self.forces[1:], strict=False)
        rows_of_push = [np.r_[first:last, first_force:last_force] for first, last, first_force, last_force in ends]
        return tuple(number[rows[used[rows]]] for rows in rows_of_push)


def find_something_else(fit: Fit, policy: DecisionPolicy, folds: Sequence[Sequence[int]]) -> SomethingElse | None:
    """Look for structure in the residuals of a converged fit, which projects out what it has fitted; None where a push cannot be simulated.

    `folds`: numbers of the pushes that are left out together.
    """
    all_families, linear = pattern_families(fit), _linear(fit)
    if all_families is None or linear is None:
        return None
    residuals = np.column_stack([linear.residual, _noise(fit, linear, policy.unknown.draws)])
    results = map_in_threads(lambda family: _evaluate(family, linear, residuals), all_families)
    sized = [linear, *_of_smaller_discrepancy(fit, linear)]
    by_size = np.array(
        [[result[0] for result in results], *([_evaluate_alone(family, one)[0] for family in all_families] for one in sized[1:])]
    )
    sizes = np.array([one.log_evidence for one in sized])
    families = logsumexp(by_size + sizes[:, None], axis=0) - logsumexp(sizes)
    best_of = [sized[k] for k in np.argmax(by_size + sizes[:, None], axis=0)]
    total, under_noise = float(_log_mean(families)), _log_mean(np.array([result[1] for result in results]))
    share = np.exp(families - logsumexp(families))

    def pattern(k: int) -> Pattern:
        family, at = all_families[k], best_of[k]
        _, (member_number, scale_number) = _evaluate_alone(family, at)
        member, scale = family.members[member_number], family.scales[scale_number]
        amplitude, std = _amplitudes(family, member, scale, at)
        return Pattern(family, member, scale, float(families[k]), float(share[k]), amplitude, std)

    order = np.argsort(-families)
    patterns = map_in_threads(pattern, order)
    at_fit = float(_log_mean(by_size[0]))
    p_value = float((1 + np.count_nonzero(under_noise >= at_fit)) / (1 + len(under_noise)))
    without: list[Float64Array] = []
    if total > 0.0:
        size = next(k for k, one in enumerate(sized) if one is best_of[order[0]])
        in_order = [all_families[k] for k in order]
        without = map_in_threads(partial(_evidence_without, sized, size, in_order, _Layout.of(fit)), folds)
    sizes_of = policy.selection.usual_discrepancy, policy.selection.larger_discrepancy
    of_discrepancy = log_bayes_factor_of_larger(fit.problem, fit.x, fit.end, *sizes_of)
    return SomethingElse(total, p_value, tuple(patterns), of_discrepancy, np.array(without).reshape(-1, len(patterns)))


def _of_smaller_discrepancy(fit: Fit, linear: _Linear) -> list[_Linear]:
    """The fit in its linear range under smaller sizes of the discrepancy that the frames of a push share; none where they share none."""
    problem, noise = fit.problem, fit.problem.noise
    if noise is None or noise.discrepancy_modes == 0:
        return []
    of_discrepancy = np.r_[np.zeros(problem.unknowns.size, dtype=bool), np.tile(groups_of(problem) >= 0, len(problem.records))]

    def of_size(size: float) -> _Linear:
        # The unknowns of the fit stay in their units, in which their prior is narrower then.
        added = np.where(of_discrepancy, problem.prior_precision * (1.0 / size**2 - 1.0), 0.0)
        cost, gradient, hessian = linear.prior
        prior = (cost + 0.5 * float(added @ fit.x**2), gradient + added * fit.x, hessian + np.diag(added))
        contact, position, yaw = noise.discrepancy_factor
        smaller = replace(noise, discrepancy_factor=(size * contact, size * position, size * yaw))
        log_prior = log_prior_of_size(smaller) - log_prior_of_size(noise) - float(np.count_nonzero(of_discrepancy)) * float(np.log(size))
        return _Linear.of(prior, linear.jacobian, linear.observed, linear.weight, linear.rows, log_prior)

    return [of_size(size) for size in _SIZES[1:]]


def _evidence_without(
    sized: Sequence[_Linear], size: int, families: Sequence[Family], layout: _Layout, fold: Sequence[int]
) -> Float64Array:
    """Log Bayes factor of each family without some pushes, under one of the sizes of the discrepancy [nat], shape (n_families,)."""
    rows, rests = layout.without(fold), [linear.without(layout, fold) for linear in sized]
    remaining = [replace(family, columns=family.columns[rows]) for family in families]
    found = np.array([_evaluate_alone(family, rests[size])[0] for family in remaining])
    return np.asarray(found + rests[size].log_evidence - logsumexp([rest.log_evidence for rest in rests]))


def error_with_patterns(fit: Fit, patterns: Sequence[Pattern], folds: Sequence[Sequence[int]]) -> Float64Array:
    """Cell error of held-out pushes with patterns that were found less that without [m], shape (n_pushes,): below 0 where they help.

    Both are predicted in the linear range of the fit, from all pushes outside a fold and the first poses of those within; with the patterns
    as a mean over those that are probable, by their shares. `patterns`: the most probable first; `folds`: numbers of the pushes that are
    held out together.
    """
    linear = _linear(fit)
    assert linear is not None, "patterns were found in the residuals of this fit"
    probable = [pattern for pattern in patterns if pattern.share >= 0.1 * patterns[0].share]
    weights = np.array([pattern.share for pattern in probable])
    ends = np.empty((1 + len(probable), fit.problem.n_pushes, 3))
    for fold, residuals_of_fold in zip(folds, map_in_threads(partial(_end_residuals, fit, linear, probable), folds), strict=True):
        ends[:, list(fold)] = residuals_of_fold
    with_them = np.tensordot(weights / weights.sum(), ends[1:], axes=1)
    return np.asarray(np.linalg.norm(with_them, axis=1) - np.linalg.norm(ends[0], axis=1))


def _end_residuals(fit: Fit, linear: _Linear, patterns: Sequence[Pattern], fold: Sequence[int]) -> Float64Array:
    """Displacement of the cells at the end of each push of a fold from its prediction without the fold [m], shape (1 + n_patterns,
    n_pushes of the fold, 3): first without any pattern, then with each of them."""
    problem, layout = fit.problem, _Layout.of(fit)
    rows, rest = layout.without(fold), linear.without(layout, fold)
    predicted = [linear.jacobian @ rest.step(rest.observed)]
    for pattern in patterns:
        family = replace(pattern.family, columns=pattern.family.columns[rows])
        amplitude, _ = _amplitudes(family, pattern.member, pattern.scale, rest)
        change = pattern.family.columns @ amplitude
        predicted.append(change + linear.jacobian @ rest.step(rest.observed - change[rows]))
    residuals = np.empty((len(predicted), len(fold), 3))
    for row, push in enumerate(fold):
        ends = slice(layout.poses[push + 1] - 3, layout.poses[push + 1])
        observation = problem.observations[push]
        whitening = linear.weight[ends][:, None] * observation.whitening[-1]
        in_metres = cell_displacement(problem.records[push].shape.cells, observation.pose[-1, 2]) @ np.linalg.inv(whitening)
        residuals[:, row] = [in_metres @ (linear.observed - prediction)[ends] for prediction in predicted]
    return residuals


def _linear(fit: Fit) -> _Linear | None:
    problem = fit.problem
    linear = problem.linearise(fit.x)
    if linear is None:
        return None
    residuals = (*linear.poses, *linear.forces)
    weight = np.concatenate([np.repeat(np.sqrt(problem.frame_weight(residual)), residual.shape[1]) for residual in residuals])
    weighted = np.concatenate([linear.by_poses, linear.by_forces]) * weight[:, None]
    # The residual of a problem is simulated minus observed.
    observed = -weight * np.concatenate([residual.ravel() for residual in residuals])
    layout = _Layout.of(fit)
    return _Linear.of(problem.prior_at(fit.x), weighted, observed, weight, layout.rows_of_pushes(layout.all))


def _noise(fit: Fit, linear: _Linear, n_draws: int) -> Float64Array:
    """Draws of what `_Linear.residual` is under noise alone, shape (n_rows, n_draws)."""
    rng, problem = np.random.default_rng(0), fit.problem
    pushes = zip(problem.observations, problem.precisions, strict=True)
    drawn = [draw_noise(observation, rng, n_draws, precision) for observation, precision in pushes]
    forces = [mean for mean in problem.forces if mean is not None]
    drawn += [rng.normal(size=(n_draws, len(mean.force), 2)) * np.isfinite(mean.std)[:, None] for mean in forces]
    # The slope of the cost of a draw, by which it is judged, has the weights of the draw.
    scores = [(part * problem.frame_weight(part)[..., None]).reshape(n_draws, -1) for part in drawn]
    noise = np.hstack(scores).T / linear.weight[:, None]
    return np.asarray(noise - linear.jacobian @ (linear.onto @ noise))


def _evaluate(family: Family, linear: _Linear, residuals: Float64Array) -> tuple[float, Float64Array, tuple[int, int]]:
    """Log Bayes factor of a family [nat], the same under draws of noise, shape (n_draws,), and the numbers of its best member and scale.

    `residuals`: those of the fit, then the draws, shape (n_rows, 1 + n_draws).
    """
    slope = _slope(family, linear, residuals)
    pairs = zip(family.members, _precisions(family, linear), strict=True)
    values = np.array([precision.log_bayes_factors(member.gathered(slope), family.scales) for member, precision in pairs])
    both = _log_mean(values.reshape(-1, values.shape[2]))
    member_number, scale_number = np.unravel_index(np.argmax(values[:, :, 0]), values.shape[:2])
    return float(both[0]), both[1:], (int(member_number), int(scale_number))


def _evaluate_alone(family: Family, linear: _Linear) -> tuple[float, tuple[int, int]]:
    """Log Bayes factor of a family for the residuals of the fit alone [nat], and the numbers of its best member and scale."""
    value, _, best = _evaluate(family, linear, linear.residual[:, None])
    return value, best


def _precisions(family: Family, linear: _Linear) -> list[AmplitudePrecision]:
    """Of the amplitudes of each member."""
    if family.columns_of_push and all(member.weights is None for member in family.members):
        blocks = _blocks(family, linear)
        by_unknowns = np.hstack([linear.jacobian[rows].T @ columns for rows, columns in blocks])
        grams = [columns.T @ columns for _, columns in blocks]
        return [AmplitudePrecision.of_blocks(grams, family.columns_of_push, by_unknowns, linear.hessian)] * len(family.members)
    information = family.columns.T @ linear.without_fitted(family.columns)
    return [AmplitudePrecision.of(member.gathered(member.gathered(information).T)) for member in family.members]


def _slope(family: Family, linear: _Linear, residuals: Float64Array) -> Float64Array:
    """Columns of a family times residuals, shape (n_columns, n)."""
    if not family.columns_of_push:
        return np.asarray(family.columns.T @ residuals)
    return np.concatenate([columns.T @ residuals[rows] for rows, columns in _blocks(family, linear)])


def _blocks(family: Family, linear: _Linear) -> list[tuple[NDArray[np.int64], Float64Array]]:
    """Rows of each push, and the part of its columns there."""
    return [(rows, family.columns[rows, columns]) for rows, columns in zip(linear.rows, family.columns_of_push, strict=True)]


def _log_mean(values: Float64Array) -> Float64Array:
    """Logarithm of the mean of exp(values) over the first axis."""
    return np.asarray(logsumexp(values, axis=0) - np.log(len(values)))


def _amplitudes(family: Family, member: Member, scale: float, linear: _Linear) -> tuple[Float64Array, float]:
    """Of each column of a family, where one of its members acts, shape (n_columns,), and the standard deviation of the largest."""
    (precision,) = _precisions(replace(family, members=(member,)), linear)
    slope = member.gathered(_slope(family, linear, linear.residual[:, None]))[:, 0]
    amplitudes = member.spread(precision.amplitudes(slope, scale))
    largest = member.gathered(np.eye(len(amplitudes))[:, [np.argmax(np.abs(amplitudes))]])[:, 0]
    return amplitudes, float(np.sqrt(np.maximum(largest @ precision.amplitudes(largest, scale), 0.0)))
