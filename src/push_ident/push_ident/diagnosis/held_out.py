"""Errors of predictions on held-out pushes, before and after effects are added."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtrc

from push_ident.diagnosis.earlier import EarlierFits
from push_ident.diagnosis.fits import without_pushes
from push_ident.diagnosis.policy import ValidationPolicy
from push_ident.diagnosis.settings import Progress
from push_ident.geometry.cells import cell_errors
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.predicting.prediction import PredictionErrors, prediction_errors
from push_ident.physics.effects import EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.threads import map_in_threads
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class MotionGap:
    """Cell error over the motion of held-out pushes, root mean square over the frames: a latency changes no end. Each of shape
    (n_pushes,) [m]."""

    before: Float64Array
    """Without the effects."""
    after: Float64Array
    """With them."""
    noise: Float64Array
    """That the noise of the poses would make if the model were right."""
    stages: dict[str, Float64Array] = field(default_factory=dict)
    """With some of the effects only, as `Gap.stages`."""
    start: Float64Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Observed position before each push, table frame [m], shape (n_pushes, 2)."""
    end: Float64Array = field(default_factory=lambda: np.zeros((0, 2)))
    """The same after it."""
    displacement_before: Float64Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Observed minus predicted position there, without the effects [m], shape (n_pushes, 2)."""
    displacement_after: Float64Array = field(default_factory=lambda: np.zeros((0, 2)))
    """The same with them."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Mean cell error at the end of held-out pushes."""

    before: Float64Array
    """Of each push, without the effects [m], shape (n_pushes,)."""
    after: Float64Array
    """With them [m], shape (n_pushes,)."""
    noise: Float64Array
    """That the noise of the poses would make if the model were right [m], shape (n_pushes,)."""
    log_density_gain: Float64Array
    """Log predictive density of pushes that are held out together, with the effects minus without [nat], shape (n_folds,)."""
    estimates: Float64Array
    """Values of the effects in the fits without each of the folds, shape (n_folds, n_values)."""
    folds: tuple[tuple[int, ...], ...] = ()
    """Numbers of the pushes that were held out together."""
    log_bayes_factor_without: Float64Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Of each stage and of all effects over the stage before, in the fits without each of the folds [nat], shape (n_stages + 1, n_folds);
    no row where there is no effect."""
    stages: dict[str, Float64Array] = field(default_factory=dict)
    """Of each push with some of the effects only, by their names [m], shape (n_pushes,); in the order in which they were added."""
    names: tuple[str, ...] = ()
    """Effects that are added."""
    motion: MotionGap | None = None
    """The same over the motion; None where only ends are known."""
    fits: tuple[Fit, ...] = ()
    """With the effects, to the pushes outside each of the folds."""
    policy: ValidationPolicy = field(default_factory=ValidationPolicy)
    """By which the gap is judged."""

    @property
    def effects_std(self) -> Float64Array:
        """Standard deviation of the values of the effects by the jackknife over the folds, shape (n_values,). Pushes that contradict each
        other widen it; the curvature of a fit does not show them (Efron & Stein, The jackknife estimate of variance, Ann. Statist.
        1981)."""
        n = len(self.estimates)
        return np.asarray(np.sqrt((n - 1) * np.var(self.estimates, axis=0)))

    def determines(self, name: str) -> bool:
        """Whether the fits without some of the pushes agree that an effect acts: its values differ from those at which it does not by more
        than the jackknife of `effects_std` explains (chi squared)."""
        effects = self.fits[0].fitted_effects
        acting = [not parameter.shape for parameter in EFFECTS[name].parameters]
        values = self.estimates[:, effects.slice_of(name)][:, acting] - EFFECTS[name].nominal[acting]
        n, mean = len(values), values.mean(axis=0)
        covariance = (n - 1) * np.atleast_2d(np.cov(values.T, ddof=0)) + 1e-12 * np.diag(mean**2)
        distance2 = float(mean @ np.linalg.lstsq(covariance, mean)[0])
        return bool(chdtrc(len(mean), distance2) < self.policy.max_p_value)

    @property
    def is_above_noise(self) -> bool:
        """Whether there was a gap to close."""
        excess = self.before - self.noise
        return bool(np.mean(excess) > self.policy.min_gap_standard_errors * np.std(excess, ddof=1) / np.sqrt(len(excess)))

    @property
    def is_worse(self) -> bool:
        """Whether held-out pushes are no nearer to their prediction with the effects, neither at their end nor over their motion, and not
        certainly more probable."""
        return not self.is_more_probable and all(float(np.mean(closed)) <= 0.0 for closed in self._closed)

    @property
    def closes_error(self) -> bool:
        """Whether held-out pushes are certainly nearer to their prediction with the effects, at the end or over the motion."""
        return any(self.mean_interval(closed)[0] > 0.0 for closed in self._closed)

    def closes_error_at(self, stage: int) -> bool:
        """The same of what was added at one of the `stages`, or after the last of them."""
        closed = [_removed_at(stage, self.before, self.stages, self.after)]
        if self.motion is not None:
            closed.append(_removed_at(stage, self.motion.before, self.motion.stages, self.motion.after))
        return any(self.mean_interval(removed)[0] > 0.0 for removed in closed)

    @property
    def is_more_probable(self) -> bool:
        """Whether held-out pushes are certainly more probable with the effects."""
        gain = self.log_density_gain
        return bool(np.mean(gain) > self.policy.min_gap_standard_errors * np.std(gain, ddof=1) / np.sqrt(len(gain)))

    @property
    def _closed(self) -> list[Float64Array]:
        """Error that the effects remove, at the end and over the motion [m], each of shape (n_pushes,)."""
        return [self.before - self.after, *([] if self.motion is None else [self.motion.before - self.motion.after])]

    def mean_interval(self, values: Float64Array) -> tuple[float, float]:
        """Contains the mean of values, one for each push, shape (n,), with the probability of the policy, by bootstrap over the pushes."""
        rng, n = np.random.default_rng(0), len(values)
        drawn = values[rng.integers(n, size=(self.policy.bootstrap_draws, n))].mean(axis=1)
        low, high = np.quantile(drawn, self.policy.interval_quantiles)
        return float(low), float(high)

    @property
    def shrink(self) -> float:
        """1 - (after - noise) / (before - noise): 1 where only noise remains; NaN where there was no gap."""
        return _shrink(self.before, self.after, self.noise) if self.is_above_noise else float("nan")

    @property
    def shrink_interval(self) -> tuple[float, float]:
        """Contains `shrink` with the probability of the policy, by bootstrap over the pushes; NaN where there was no gap."""
        if not self.is_above_noise:
            return float("nan"), float("nan")
        rng, n = np.random.default_rng(0), len(self.before)
        resampled = rng.integers(n, size=(self.policy.bootstrap_draws, n))
        drawn = [_shrink(self.before[i], self.after[i], self.noise[i]) for i in resampled]
        low, high = np.nanquantile(drawn, self.policy.interval_quantiles)
        return float(low), float(high)


def _removed_at(stage: int, before: Float64Array, stages: Mapping[str, Float64Array], after: Float64Array) -> Float64Array:
    errors = [before, *stages.values(), after]
    return np.asarray(errors[stage] - errors[stage + 1])


def _shrink(before: Float64Array, after: Float64Array, noise: Float64Array) -> float:
    gap = float(np.mean(before - noise))
    return 1.0 - float(np.mean(after - noise)) / gap if gap > 0 else float("nan")


@dataclass(frozen=True, slots=True)
class _HeldOutFold:
    """What a fit without the pushes of a fold predicts of them."""

    errors: PredictionErrors
    """Of each push."""
    log_density: float
    """Of the pushes of the fold under the fit to the others, up to a constant [nat]."""
    fit: Fit
    """To the other pushes."""


class HeldOutFits:
    """Fits without some pushes, and what they predict of these pushes; each is made once, from an earlier one where there is one."""

    def __init__(self, earlier: EarlierFits | None = None) -> None:
        self._earlier = earlier or EarlierFits()
        self._results: dict[tuple[int, tuple[int, ...]], tuple[Fit, _HeldOutFold]] = {}
        """By the identity of the fit to all pushes, which is kept, and the fold."""

    def of(self, fits: Sequence[Fit], folds: Sequence[Sequence[int]]) -> list[list[_HeldOutFold]]:
        """Of each fit, the results of all folds."""
        requested = {(id(fit), tuple(fold)): fit for fit in fits for fold in folds}
        missing = [(key, fit) for key, fit in requested.items() if key not in self._results]
        results = map_in_threads(lambda task: _hold_out(task[1], task[0][1], self._earlier), missing)
        self._results |= {key: (fit, result) for (key, fit), result in zip(missing, results, strict=True)}
        return [[self._results[id(fit), tuple(fold)][1] for fold in folds] for fit in fits]

    @property
    def fits(self) -> list[tuple[Fit, tuple[int, ...]]]:
        """All of them, with the numbers of the pushes that they do not use."""
        return [(result.fit, fold) for (_, fold), (_, result) in self._results.items()]


def measure_gap(
    base: Fit,
    fit: Fit,
    policy: ValidationPolicy,
    on_progress: Progress | None = None,
    *,
    between: Mapping[str, Fit] | None = None,
    held_out: HeldOutFits | None = None,
) -> Gap:
    """Hold each push out of both fits once, and predict it.

    `base`: without the effects; `fit`: with them, may be `base` itself; `between`: with some of them, by their names, for the `stages` of
    the gap; `held_out`: known fits without some pushes, to which those of this gap are added.
    """
    report = on_progress or (lambda text: None)
    n = base.problem.n_pushes
    folds = folds_of(n, policy.max_folds)
    report(f"holding out each of {n} pushes once, in {len(folds)} fits")
    stages = {} if fit is base else dict(between or {})
    fits = [base] if fit is base else [base, *stages.values(), fit]
    by_fit = (held_out or HeldOutFits()).of(fits, folds)
    errors, of_motion, displacement = (
        np.array([_by_push([getattr(result.errors, kind) for result in results], folds) for results in by_fit])
        for kind in ("at_end", "over_motion", "end_displacement")
    )
    starts, ends = (np.array([observation.pose[frame, :2] for observation in base.problem.observations[:n]]) for frame in (0, -1))
    noise, noise_of_motion = noise_errors(fit, policy.noise_draws)
    density = np.array([[result.log_density for result in results] for results in by_fit])
    evidence = np.array([one.log_evidence for one in fits])[:, None] - density
    return Gap(
        before=errors[0],
        after=errors[-1],
        noise=noise,
        log_density_gain=density[-1] - density[0],
        estimates=np.array([result.fit.fitted_effects.values for result in by_fit[-1]]),
        folds=tuple(map(tuple, folds)),
        log_bayes_factor_without=np.diff(evidence, axis=0),
        stages=dict(zip(stages, errors[1:-1], strict=True)),
        names=tuple(name for name in fit.names if name not in base.names),
        motion=MotionGap(
            of_motion[0],
            of_motion[-1],
            noise_of_motion,
            dict(zip(stages, of_motion[1:-1], strict=True)),
            starts,
            ends,
            displacement[0],
            displacement[-1],
        ),
        fits=tuple(result.fit for result in by_fit[-1]),
        policy=policy,
    )


def folds_of(n_pushes: int, max_folds: int) -> list[list[int]]:
    """Numbers of the pushes that are held out together: one each, or two and more where there are more pushes than folds."""
    n_folds = min(n_pushes, max_folds)
    return [list(range(first, n_pushes, n_folds)) for first in range(n_folds)]


def _by_push(of_folds: Sequence[Float64Array], folds: Sequence[Sequence[int]]) -> Float64Array:
    """Values of the pushes of all folds in the order of the pushes, shape (n_pushes, ...)."""
    return np.concatenate(of_folds)[np.argsort(np.concatenate([np.array(fold, dtype=int) for fold in folds]))]


def _hold_out(fit: Fit, pushes: Sequence[int], earlier: EarlierFits) -> _HeldOutFold:
    rest, problem = without_pushes(fit, pushes, earlier.start(fit, pushes)), fit.problem
    records = [problem.records[push] for push in pushes]
    observations = [problem.observations[push] for push in pushes]
    errors = prediction_errors(rest.model, records, effects=rest.effects, settings=problem.settings, observed=observations)
    return _HeldOutFold(errors, fit.log_evidence - rest.log_evidence, rest)


def noise_errors(fit: Fit, n_draws: int) -> tuple[Float64Array, Float64Array]:
    """Cell error that the noise of the poses would make if the model were right, at the end of each push and over its motion [m], shape
    (n_pushes,) each.

    What an error of the first pose makes of the end is taken from pushes that begin a standard deviation to either side: where a pusher
    just touches a corner the derivative is hundreds of times that.
    """
    problem = fit.problem
    mechanics = fit.mechanics
    normal = np.random.default_rng(0).normal(size=(problem.n_pushes, n_draws, 2, 3))

    def errors(push: int) -> tuple[float, float]:
        record, observation = problem.records[push], problem.observations[push]

        def motion(first: Float64Array) -> Float64Array:
            scenario = PushScenario(record.pusher, first, observation.time[1:], record.order)
            return mechanics.simulate(scenario, settings=problem.settings_of(push)).pose

        first, roots = problem.first_pose(fit.x, push), np.linalg.cholesky(observation.first_covariance).T
        by_first = np.array([motion(first + root) - motion(first - root) for root in roots]) / 2.0
        expected = motion(first)
        draws = np.einsum("di,ifj->dfj", normal[push, :, 0], by_first)
        ends = draws[:, -1] + normal[push, :, 1] @ np.linalg.cholesky(observation.last_covariance).T
        at_end = np.median(cell_errors(record.shape.cells, expected[-1], expected[-1] + ends))
        of_frames = np.random.default_rng([2, push]).normal(size=draws.shape)
        draws += np.einsum("fij,dfj->dfi", np.linalg.inv(observation.whitening[1:]), of_frames)
        of_motion = np.sqrt(np.mean(cell_errors(record.shape.cells, expected, expected + draws) ** 2, axis=1))
        return float(at_end), float(np.median(of_motion))

    ends, motions = zip(*map_in_threads(errors, range(problem.n_pushes)), strict=True)
    return np.array(ends), np.array(motions)
