"""How far off predictions are on pushes that the fit did not see, before and after the effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from push_ident.diagnosis.fits import EffectFit, without_pushes
from push_ident.diagnosis.parallel import side_by_side
from push_ident.identification.prediction import cell_error, held_out_errors
from push_ident.physics.scenario import PushScenario
from push_ident.types import Float64Array

__all__ = ["Gap", "measure_gap"]

_N_DRAWS = 64
_N_BOOTSTRAP = 2000
_N_FOLDS = 10
"""Pushes are held out one by one, and where they are more than this, some or all of them two or more at a time."""
_NOTHING = 2.0
"""The gap before counts as one where it is so many standard errors above the noise."""

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Gap:
    """Mean cell error at the end of pushes held out."""

    before: Float64Array
    """Of each push, without the effects [m], shape (n_pushes,)."""
    after: Float64Array
    """With them [m], shape (n_pushes,)."""
    noise: Float64Array
    """That the noise of the poses alone would make [m], shape (n_pushes,)."""
    log_density_gain: Float64Array
    """Of pushes held out together, with the effects over without [nat], shape (n_folds,)."""
    estimates: Float64Array
    """Values of the effects in the fits without each of the folds, shape (n_folds, n_values)."""
    folds: tuple[tuple[int, ...], ...] = ()
    """Numbers of the pushes that were held out together."""
    gain_without: Float64Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Of log evidence, of each stage and of all effects over the stage before, in the fits without each of the folds [nat], shape
    (n_stages + 1, n_folds); no row where there is no effect."""
    stages: dict[str, Float64Array] = field(default_factory=dict)
    """Of each push with some of the effects only, by their names [m], shape (n_pushes,); in the order in which they were added."""

    @property
    def effects_std(self) -> Float64Array:
        """Deviation of the values of the effects by the jackknife over the folds, shape (n_values,): pushes that contradict each other
        widen it, which the curvature of a fit does not know of (Efron & Stein, The jackknife estimate of variance, Ann. Statist. 1981)."""
        n = len(self.estimates)
        return np.asarray(np.sqrt((n - 1) * np.var(self.estimates, axis=0)))

    @property
    def is_above_noise(self) -> bool:
        """Whether there was a gap to close."""
        excess = self.before - self.noise
        return bool(np.mean(excess) > _NOTHING * np.std(excess, ddof=1) / np.sqrt(len(excess)))

    @property
    def shrink(self) -> float:
        """1 - (after - noise) / (before - noise): 1 where nothing but noise is left; NaN where there was no gap."""
        return _shrink(self.before, self.after, self.noise) if self.is_above_noise else float("nan")

    @property
    def shrink_interval(self) -> tuple[float, float]:
        """Holds `shrink` at 90 %, by bootstrap over the pushes; NaN where there was no gap."""
        if not self.is_above_noise:
            return float("nan"), float("nan")
        rng, n = np.random.default_rng(0), len(self.before)
        drawn = [_shrink(self.before[i], self.after[i], self.noise[i]) for i in rng.integers(n, size=(_N_BOOTSTRAP, n))]
        low, high = np.nanquantile(drawn, [0.05, 0.95])
        return float(low), float(high)


def _shrink(before: Float64Array, after: Float64Array, noise: Float64Array) -> float:
    gap = float(np.mean(before - noise))
    return 1.0 - float(np.mean(after - noise)) / gap if gap > 0 else float("nan")


def measure_gap(
    base: EffectFit, fit: EffectFit, on_progress: Progress | None = None, *, between: Mapping[str, EffectFit] | None = None
) -> Gap:
    """Leave each push out of both fits once, and predict it.

    Args:
        base: without the effects.
        fit: with them; may be `base` itself.
        on_progress: told what is fitted.
        between: fits with some of them, by what they have; for the `stages` of the gap.
    """
    report = on_progress or (lambda text: None)
    n = len(base.problem.records)
    n_folds = min(n, _N_FOLDS)
    folds = [list(range(first, n, n_folds)) for first in range(n_folds)]
    report(f"holding out each of {n} pushes once, in {n_folds} fits")
    stages = dict(between or {})
    fits = [base] if fit is base else [base, *stages.values(), fit]
    results = side_by_side(lambda which: _left_out(*which), [(one, fold) for one in fits for fold in folds])
    errors = np.empty((len(fits), n))
    density, evidence = np.empty((len(fits), n_folds)), np.empty((len(fits), n_folds))
    for k, (error, gain, _) in enumerate(results):
        one, fold = divmod(k, n_folds)
        errors[one, folds[fold]], density[one, fold] = error, gain
        evidence[one, fold] = fits[one].log_evidence - gain
    estimates = np.array([values for _, _, values in results[-n_folds:]])
    by_stage = dict(zip(stages, errors[1:-1], strict=True)) if fit is not base else {}
    return Gap(
        before=errors[0],
        after=errors[-1],
        noise=_noise_errors(fit),
        log_density_gain=density[-1] - density[0],
        estimates=estimates,
        folds=tuple(map(tuple, folds)),
        gain_without=np.diff(evidence, axis=0),
        stages=by_stage,
    )


def _left_out(fit: EffectFit, pushes: Sequence[int]) -> tuple[Float64Array, float, Float64Array]:
    """Cell errors of pushes under the fit to the others [m], their log density under it up to a constant [nat], and its effects."""
    rest, problem = without_pushes(fit, pushes), fit.problem
    records = [problem.records[push] for push in pushes]
    errors = held_out_errors(rest.model, records, effects=rest.effects, noise=problem.noise, settings=problem.settings)
    return errors, fit.log_evidence - rest.log_evidence, rest.effects.values


def _noise_errors(fit: EffectFit) -> Float64Array:
    """Cell error that the noise of the first and the last pose would make if the model were true [m], shape (n_pushes,)."""
    rng = np.random.default_rng(0)
    problem = fit.problem
    mechanics = fit.parameters.mechanics(fit.z)
    errors = []
    for push, (record, seen) in enumerate(zip(problem.records, problem.observations, strict=True)):
        motion = mechanics.simulate(
            PushScenario(record.pusher, problem.first_pose(fit.x, push), seen.time[-1:], record.order),
            settings=problem.settings,
            jacobian=True,
        )
        by_first = motion.jacobian[-1, :, :3]
        first_root = np.linalg.cholesky(seen.first_covariance)
        last_root = np.linalg.cholesky(seen.last_covariance)
        draws: Sequence[Float64Array] = [
            by_first @ first_root @ rng.normal(size=3) + last_root @ rng.normal(size=3) for _ in range(_N_DRAWS)
        ]
        errors.append(float(np.median([cell_error(record.shape.cells, motion.pose[-1], motion.pose[-1] + d) for d in draws])))
    return np.array(errors)
