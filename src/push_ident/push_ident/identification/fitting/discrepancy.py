"""The size of the model discrepancy that the frames of a push share, set by the pushes.

No model of pushing is exact, and by how much a recording departs from it nobody knows beforehand. The displacements of the frames by the
discrepancy are unknowns of each push (`Observation.shared`) with a normal prior. Its standard deviations are hyperparameters: one for the
place of the contact, one for positions, one for the yaw, each a factor s on that of the noise model with a log-normal prior. With the
Hessian A and the pull b of the pushes alone at a fit, and the precision P(s) of the prior of all unknowns, the evidence of the linear
problem is

    log p(pushes | s) = 1/2 b' (A + P(s))^-1 b - 1/2 log det (A + P(s)) + 1/2 log det P(s) + const

(MacKay, "Bayesian interpolation", Neural Computation 1992), largest at the size that counts. A fourth factor, of the errors of the frames
that nothing else explains, is that of largest density of the residuals.

Some pushes are worse explained than others: one during which the pusher slips off a corner may err by ten times as much. The prior of a
push has these standard deviations over the root of a precision w of its own, with a gamma prior of shape and rate t / 2: its displacements
are Student's t, as the errors of a frame are. With the displacements d of the push in units of their prior and the number g of those that
the push determines, MacKay's fixed point is

    w = (t + g) / (t + |d|^2),    g = m - w tr Var(d),    t = `TAILS`
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.special import gammainc, logsumexp

from push_ident.identification.fitting.problem import TAILS, Evaluation, FitProblem
from push_ident.identification.observing.observation import NoiseModel
from push_ident.types import Float64Array

WIDTH: Final = 1.0
"""Standard deviation of the logarithm of a factor about that of the noise model [-]: a factor of 2.7 either way. Effect-free pushes of the
simulators here have a third of the default to its double, recordings of others up to ten times as much."""
_ROUNDS: Final = 5
"""Of the size that all pushes share and the precision of each in turn."""
_LARGEST: Final = 5.0
"""Of the logarithm of a factor [-]: of 150, where nothing is predicted any more."""
OF_FRAME: Final = 2.5967
"""By which a frame counts in the logarithm of the size of all [1]: E[(t + 3) r^2 / (t + r^2)] of normal errors r, so that their factor
is 1; 3 would be that of errors with those tails, t = 4 (`problem.TAILS`)."""


@dataclass(frozen=True, slots=True)
class DiscrepancySize:
    """The size of largest evidence, in factors on that of the noise model of a fit."""

    frames: float
    """On `NoiseModel.frame_factor`."""
    shared: Float64Array
    """On `NoiseModel.discrepancy_factor`, shape (3,)."""
    precisions: Float64Array
    """`FitProblem.precisions`, shape (n_pushes,)."""
    log_evidence_gain: float
    """Over the size of the fit [nat]; the prior of the factors is part of it."""


@dataclass(frozen=True, slots=True)
class LinearMinimum:
    """Of pushes in their linear range."""

    unknowns: Float64Array
    """Of the object, shape (n,)."""
    of_push: Float64Array
    """Of each push, shape (n_pushes, m)."""
    variance_of_push: Float64Array
    """Of their posterior, shape (n_pushes, m)."""
    volume: float
    """Half the log determinant of the Hessian, prior included."""
    cost: float
    """Above that of the pushes at the fit [nat]."""


@dataclass(frozen=True, slots=True)
class LinearPushes:
    """Cost of pushes in the linear range of a fit, without the prior: unknowns of the object and, for each push, its own.

    Expanded about the fit, since Hessians of unstable pushes are too large for differences of costs from zero.
    """

    at: Float64Array
    """Unknowns of the object at the fit, shape (n,)."""
    at_push: Float64Array
    """Those of each push, shape (n_pushes, m)."""
    constant: float
    """Cost there, that of the prior of the object included [nat]."""
    prior_hessian: Float64Array
    """Of the prior of the object, and of what is known of it beforehand, shape (n, n)."""
    prior_slope: Float64Array
    """Shape (n,)."""
    hessian: Float64Array
    """By the unknowns of the object, shape (n, n)."""
    slope: Float64Array
    """Shape (n,)."""
    cross: Float64Array
    """Hessian by those of the object and of each push, shape (n_pushes, n, m)."""
    hessian_of_push: Float64Array
    """Shape (n_pushes, m, m)."""
    slope_of_push: Float64Array
    """Shape (n_pushes, m)."""
    group: NDArray[np.intp]
    """Of each unknown of a push: number of its factor, -1 for the first pose, shape (m,)."""
    first: Float64Array
    """Logarithms of the factors of the noise model, shape (3,)."""
    precisions: Float64Array
    """Of the prior of each push, shape (n_pushes,)."""

    @classmethod
    def of(cls, problem: FitProblem, x: Float64Array, hessian: Float64Array, gradient: Float64Array) -> LinearPushes:
        """Of a cost with Hessian and gradient at `x`, shapes (size, size) and (size,), prior included."""
        assert problem.noise is not None
        n, m, n_pushes = problem.unknowns.size, problem.unknowns_of_push, len(problem.records)
        _, prior_slope, prior_hessian = problem.prior_at(x)
        data, slope = hessian - prior_hessian, gradient - prior_slope
        of_pushes = data[n:, n:].reshape(n_pushes, m, n_pushes, m)
        return cls(
            at=x[:n],
            at_push=x[n:].reshape(n_pushes, m),
            constant=problem.prior_at(np.r_[x[:n], np.zeros(m * n_pushes)])[0],
            prior_hessian=prior_hessian[:n, :n],
            prior_slope=prior_slope[:n],
            hessian=data[:n, :n],
            slope=slope[:n],
            cross=data[:n, n:].reshape(n, n_pushes, m).transpose(1, 0, 2),
            hessian_of_push=of_pushes[np.arange(n_pushes), :, np.arange(n_pushes), :],
            slope_of_push=slope[n:].reshape(n_pushes, m),
            group=groups_of(problem),
            first=np.log(problem.noise.discrepancy_factor),
            precisions=np.array(problem.precisions),
        )

    def of_unknowns(self, chosen: NDArray[np.intp]) -> LinearPushes:
        """With some of the unknowns of the object only, the others zero."""
        others = np.setdiff1d(np.arange(len(self.at)), chosen)
        back, both = -self.at[others], self.hessian + self.prior_hessian
        slope = self.slope + self.prior_slope
        return replace(
            self,
            at=self.at[chosen],
            constant=self.constant + float(slope[others] @ back + 0.5 * back @ both[np.ix_(others, others)] @ back),
            prior_hessian=self.prior_hessian[np.ix_(chosen, chosen)],
            prior_slope=self.prior_slope[chosen] + self.prior_hessian[np.ix_(chosen, others)] @ back,
            hessian=self.hessian[np.ix_(chosen, chosen)],
            slope=self.slope[chosen] + self.hessian[np.ix_(chosen, others)] @ back,
            cross=self.cross[:, chosen],
            slope_of_push=self.slope_of_push + np.einsum("pim,i->pm", self.cross[:, others], back),
        )

    def weighted(self, weight: float) -> LinearPushes:
        """With errors of so much more weight."""
        return replace(
            self, hessian=weight * self.hessian, slope=weight * self.slope, cross=weight * self.cross,
            hessian_of_push=weight * self.hessian_of_push, slope_of_push=weight * self.slope_of_push,
        )  # fmt: skip

    def cost(self, logs: Float64Array, width: float = WIDTH, middle: Float64Array | float = 0.0) -> tuple[float, Float64Array]:
        """Negative log evidence under factors with these logarithms on those of the noise model, shape (3,), up to a constant [nat], and
        its derivative. `width` and `middle`: standard deviation and mean of the logarithms of the sizes beforehand [-], the
        latter a number or of shape (3,)."""
        at = self.solve(logs)
        prior = (self.first + logs - middle) / width
        slope = prior / width
        for k in range(3):
            chosen = self.group == k
            expected = np.exp(-2.0 * logs[k]) * (at.of_push[:, chosen] ** 2 + at.variance_of_push[:, chosen])
            slope[k] += float(np.sum(1.0 - self.precisions[:, None] * expected))
        return at.cost + at.volume + self.log_size(logs) + 0.5 * float(prior @ prior), slope

    def with_precisions(self, logs: Float64Array) -> LinearPushes:
        """With those that follow from the displacements under factors with these logarithms, shape (3,)."""
        at, displaced = self.solve(logs), self.group >= 0
        by_factor = np.exp(-2.0 * logs)[self.group[displaced]]
        n = np.count_nonzero(displaced)
        determined = np.clip(n - self.precisions * (at.variance_of_push[:, displaced] @ by_factor), 0.0, n)  # but for rounding
        return replace(self, precisions=(TAILS + determined) / (TAILS + at.of_push[:, displaced] ** 2 @ by_factor))

    def log_size(self, logs: Float64Array) -> float:
        """Logarithms of the standard deviations of all unknowns of the pushes together, and the cost of the precisions [nat]."""
        of_all = float(np.sum(logs[self.group[self.group >= 0]])) * len(self.at_push)
        return of_all - log_density_of_precisions(self.precisions, int(np.count_nonzero(self.group >= 0)))

    def solve(self, logs: Float64Array) -> LinearMinimum:
        """The minimum under factors with these logarithms. Raises LinAlgError where rounding leaves none."""
        precision = np.outer(self.precisions, np.where(self.group < 0, 0.0, np.exp(-2.0 * logs)[self.group]))
        of_push = self.hessian_of_push + precision[:, :, None] * np.eye(len(self.group))
        pull_of_push = -(self.slope_of_push + precision * self.at_push)
        right = np.concatenate([self.cross.transpose(0, 2, 1), pull_of_push[:, :, None]], axis=2)
        # By Cholesky's roots: the difference below stays positive definite, where one by an inverse loses it to rounding.
        root = np.linalg.cholesky(of_push)
        half = np.linalg.inv(root)
        by_root = half @ right
        reduced = self.prior_hessian + self.hessian - np.einsum("pmi,pmj->ij", by_root[:, :, :-1], by_root[:, :, :-1])
        pull = -(self.slope + self.prior_slope) - np.einsum("pmi,pm->i", by_root[:, :, :-1], by_root[:, :, -1])
        covariance = np.linalg.inv(reduced)
        moved = np.asarray(covariance @ pull)
        roots = (np.linalg.cholesky(reduced), root)
        volume = float(sum(np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1))) for root in roots))
        eliminated = half.transpose(0, 2, 1) @ by_root
        gained = 0.5 * float(pull @ moved + np.sum(by_root[:, :, -1] ** 2))
        cost = self.constant + 0.5 * float(np.sum(precision * self.at_push**2)) - gained
        follows = eliminated[:, :, :-1]
        variance = np.sum(half**2, axis=1) + np.sum((follows @ covariance) * follows, axis=2)
        return LinearMinimum(self.at + moved, self.at_push + eliminated[:, :, -1] - follows @ moved, variance, volume, cost)

    def best(self, start: Float64Array, width: float = WIDTH, middle: Float64Array | float = 0.0) -> Float64Array:
        """Logarithms of the factors of largest evidence, shape (3,), from a start."""
        bounds = [(-_LARGEST - value, _LARGEST - value) for value in self.first]
        options = {"maxiter": 30, "ftol": 1e-7}
        return np.asarray(minimize(self.cost, start, args=(width, middle), jac=True, method="L-BFGS-B", bounds=bounds, options=options).x)

    def log_evidence_about(self, middle: Float64Array | float, width: float) -> float:
        """Of sizes whose logarithms have this mean and this standard deviation, by Laplace's approximation, up to a constant [nat]."""
        logs, step = self.best(np.zeros(3), width, middle), 0.05
        slopes = [[self.cost(logs + sign * step * axis, width, middle)[1] for sign in (1.0, -1.0)] for axis in np.eye(3)]
        hessian = np.array([(above - below) / (2.0 * step) for above, below in slopes])
        curvature = np.maximum(np.linalg.eigvalsh(0.5 * (hessian + hessian.T)), width**-2)
        return -self.cost(logs, width, middle)[0] - 0.5 * float(np.sum(np.log(curvature)))

    def least_cost(self) -> float:
        """Negative log evidence at the factors of largest evidence, up to a constant [nat]."""
        return self.cost(self.best(np.zeros(3)))[0]

    def expected_gain(self, at: Float64Array, effect: NDArray[np.intp]) -> float:
        """Gain of the log evidence by some unknowns `effect` of the object [nat], for mean noise, of pushes as they are predicted at `at`.

        `at` has shape (n,). Without these unknowns, a discrepancy that the pushes size grows by what it explains of them. Raises
        LinAlgError where rounding leaves no minimum.
        """
        moved = at - self.at
        slope = self.prior_slope + self.prior_hessian @ moved
        expected = replace(
            self, at=at, constant=self.constant + 0.5 * float((self.prior_slope + slope) @ moved), prior_slope=slope,
            slope=np.zeros_like(self.slope), slope_of_push=np.zeros_like(self.slope_of_push),
        )  # fmt: skip
        others = np.setdiff1d(np.arange(len(at)), effect)
        return expected.of_unknowns(others).least_cost() - expected.least_cost()


@dataclass(frozen=True, slots=True)
class FrameErrors:
    """Cost of the size of the errors of all frames of a fit, by their whitened residuals."""

    frames: NDArray[np.intp]
    """Those that count: all but the first of each push, shape (n,)."""
    share: float
    """Degrees of freedom that the unknowns leave, of all [1]."""
    first: float
    """Logarithm of the factor of the noise model."""

    @classmethod
    def of(cls, problem: FitProblem, end: Evaluation) -> FrameErrors:
        """Of a fit, with its evaluation `end`."""
        assert problem.noise is not None
        starts = np.cumsum([0, *(len(o.time) for o in problem.observations)])
        frames = np.concatenate([np.arange(a + 1, b) for a, b in pairwise(starts)])
        used = problem.size - float(np.trace(np.linalg.solve(end.hessian, problem.prior_at(np.zeros(problem.size))[2])))
        share = max(1.0 - used / (3.0 * max(len(frames), 1)), 0.25)
        return cls(frames, share, float(np.log(problem.noise.frame_factor)))

    def cost(self, residual: Float64Array, log: float = 0.0) -> float:
        """Negative log density of residuals of shape (n_frames, 3) under a factor on that of the fit [nat]."""
        of_size = OF_FRAME * self.share * log * len(self.frames)
        return of_size + FitProblem.weigh(np.exp(-log) * residual[self.frames])[0] + 0.5 * ((self.first + log) / WIDTH) ** 2

    def cost_of_first(self, residual: Float64Array) -> float:
        """Of the first frames of the pushes, whose errors are those of the noise [nat]."""
        first = np.setdiff1d(np.arange(len(residual)), self.frames)
        return FitProblem.weigh(residual[first])[0]

    def best(self, residual: Float64Array) -> float:
        """Logarithm of the factor of least cost."""
        bounds = (-self.first, _LARGEST - self.first)  # the noise is not smaller than it is stated
        return float(minimize_scalar(partial(self.cost, residual), bounds=bounds, method="bounded").x)


def estimate_size(problem: FitProblem, x: Float64Array, end: Evaluation) -> DiscrepancySize:
    """The size of largest evidence near a fit `x`, shape (size,), with its evaluation `end`; factors of 1 where none is estimated."""
    noise = problem.noise
    if noise is None or noise.discrepancy_modes == 0 or not np.isfinite(end.cost):
        return DiscrepancySize(1.0, np.ones(3), np.array(problem.precisions), 0.0)
    linear, errors = LinearPushes.of(problem, x, end.hessian, end.gradient), FrameErrors.of(problem, end)
    sized, logs = linear, np.zeros(3)
    try:
        for _ in range(_ROUNDS):
            logs = sized.best(logs)
            sized = sized.with_precisions(logs)
        gain = linear.cost(np.zeros(3))[0] - sized.cost(logs)[0]
        of_pushes = end.cost - problem.prior_at(x)[0]
        # A cost below zero is no cost: the size would have to be judged outside of the linear range.
        in_range = sized.solve(logs).cost + of_pushes >= 0.0
    except np.linalg.LinAlgError:  # a Hessian with very steep and very flat directions
        in_range = False
    if not in_range:
        logs, sized, gain = np.zeros(3), linear, 0.0
    of_frames = errors.best(end.residual)
    gain += errors.cost(end.residual) - errors.cost(end.residual, of_frames)
    return DiscrepancySize(float(np.exp(of_frames)), np.exp(logs), sized.precisions, gain)


def log_bayes_factor_of_larger(problem: FitProblem, x: Float64Array, end: Evaluation, usual: float, larger: float) -> float:
    """Log Bayes factor of a discrepancy `larger` times the usual one over the usual one, near a fit `x` evaluated as `end` [nat].

    Larger is that of the contact, that of the motion, or both. Beforehand, either size is known to a factor of `usual`, one standard
    deviation.
    0 where no size is estimated, or rounding leaves none.
    """
    if problem.noise is None or problem.noise.discrepancy_modes == 0 or not np.isfinite(end.cost):
        return 0.0
    linear, width = LinearPushes.of(problem, x, end.hessian, end.gradient), float(np.log(usual))
    try:
        of_larger = [linear.log_evidence_about(np.log(larger) * np.array(which), width) for which in ((1, 0, 0), (0, 1, 1), (1, 1, 1))]
        return float(logsumexp(of_larger) - np.log(len(of_larger))) - linear.log_evidence_about(0.0, width)
    except np.linalg.LinAlgError:
        return 0.0


def usual_size(noise: NoiseModel, n_pushes: int) -> DiscrepancySize:
    """That of the defaults, in factors on that of a noise model."""
    return DiscrepancySize(1.0, 1.0 / np.array(noise.discrepancy_factor), np.ones(n_pushes), 0.0)


def log_density_of_precisions(precisions: Float64Array, n: int) -> float:
    """By which precisions of the pushes, shape (n_pushes,), change the prior density of their `n` displacements and have their own, over
    precisions of 1 [nat]."""
    logs = np.log(precisions)
    return 0.5 * float(np.sum(n * logs + TAILS * (logs - precisions + 1.0)))


def departing_pushes(precisions: Float64Array, max_p_value: float) -> dict[int, float]:
    """Numbers of pushes that depart from the model by more than one of as many does by chance, and how many times as far as the others.

    `precisions`: of `FitProblem.precisions`, shape (n_pushes,).
    """
    p_values = gammainc(TAILS / 2, TAILS / 2 * precisions)
    return {int(push): float(precisions[push] ** -0.5) for push in np.flatnonzero(p_values * len(precisions) < max_p_value)}


def log_prior_of_size(noise: NoiseModel | None) -> float:
    """Logarithm of the prior density of the size of a noise model, up to a constant [nat]."""
    if noise is None or noise.discrepancy_modes == 0:
        return 0.0
    return -0.5 * float(np.sum((np.log([*noise.discrepancy_factor, noise.frame_factor]) / WIDTH) ** 2))


def with_size(problem: FitProblem, x: Float64Array, size: DiscrepancySize, *, sets_rest: bool = False) -> tuple[FitProblem, Float64Array]:
    """The problem under a discrepancy of another size, and the unknowns of the same motions, shape (size,).

    `sets_rest`: whether modes that the frames of a push do not share have that size, too.
    """
    noise = problem.noise
    assert noise is not None, "a size was estimated"
    contact, position, yaw = (float(value) for value in noise.discrepancy_factor * size.shared)
    frames = noise.frame_factor * size.frames
    rest = (position, yaw) if sets_rest else noise.rest_factor
    other = problem.with_noise(
        replace(noise, discrepancy_factor=(contact, position, yaw), rest_factor=rest, frame_factor=frames), size.precisions.tolist()
    )
    group = groups_of(problem)
    scale = np.where(group < 0, 1.0, size.shared[group])
    return other, x / np.r_[np.ones(problem.unknowns.size), np.tile(scale, len(problem.records))]


def groups_of(problem: FitProblem) -> NDArray[np.intp]:
    """Of each unknown of a push: number of its factor, -1 for the first pose, shape (unknowns_of_push,)."""
    assert problem.noise is not None
    group = np.r_[[-1, -1, -1, 0, 0], np.repeat([1, 1, 2], problem.noise.discrepancy_modes)]
    return group[: problem.unknowns_of_push].astype(np.intp)
