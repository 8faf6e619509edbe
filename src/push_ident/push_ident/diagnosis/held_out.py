"""How far off predictions are on pushes that the fit did not see, before and after the effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.diagnosis.fits import EffectFit, fit_effects
from push_ident.diagnosis.parallel import side_by_side
from push_ident.identification.prediction import cell_error, held_out_errors
from push_ident.types import Float64Array

__all__ = ["Gap", "measure_gap"]

_N_DRAWS = 64
_N_BOOTSTRAP = 2000
_NOTHING = 2.0
"""The gap before counts as one where it is so many standard errors above the noise."""

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Gap:
    """Mean cell error at the end of pushes held out one at a time."""

    before: Float64Array
    """Of each push, without the effects [m], shape (n_pushes,)."""
    after: Float64Array
    """With them [m], shape (n_pushes,)."""
    noise: Float64Array
    """That the noise of the poses alone would make [m], shape (n_pushes,)."""
    log_density_gain: Float64Array
    """Of the held-out push with the effects over without [nat], shape (n_pushes,)."""

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


def measure_gap(base: EffectFit, fit: EffectFit, on_progress: Progress | None = None) -> Gap:
    """Leave each push out of both fits in turn, and predict it.

    Args:
        base: without the effects.
        fit: with them; may be `base` itself.
        on_progress: told what is fitted.
    """
    report = on_progress or (lambda text: None)
    n = len(base.problem.records)
    report(f"leaving out each of {n} pushes in turn")
    fits = [base] if fit is base else [base, fit]
    results = side_by_side(lambda which: _left_out(*which), [(one, push) for one in fits for push in range(n)])
    error, density = np.array(results).reshape(len(fits), n, 2).transpose(2, 0, 1)
    return Gap(error[0], error[-1], _noise_errors(fit), density[-1] - density[0])


def _left_out(fit: EffectFit, push: int) -> tuple[float, float]:
    """Cell error of a push under the fit to the others [m], and its log density under it up to a constant [nat]."""
    records = fit.problem.records
    others = [record for i, record in enumerate(records) if i != push]
    rest = fit_effects(fit, fit.names, records=others)
    error = held_out_errors(rest.model, [records[push]], effects=rest.effects, noise=fit.problem.noise, settings=fit.problem.settings)
    return float(error[0]), fit.log_evidence - rest.log_evidence


def _noise_errors(fit: EffectFit) -> Float64Array:
    """Cell error that the noise of the first and the last pose would make if the model were true [m], shape (n_pushes,)."""
    rng = np.random.default_rng(0)
    problem = fit.problem
    mechanics = fit.parameters.mechanics(fit.z)
    errors = []
    for push, (record, seen) in enumerate(zip(problem.records, problem.observations, strict=True)):
        motion = mechanics.simulate(
            record.pusher, problem.first_pose(fit.x, push), seen.time[-1:], settings=problem.settings, order=record.order, jacobian=True
        )
        by_first = motion.jacobian[-1, :, :3]
        first_root = np.linalg.cholesky(seen.first_covariance)
        last_root = np.linalg.cholesky(seen.last_covariance)
        draws: Sequence[Float64Array] = [
            by_first @ first_root @ rng.normal(size=3) + last_root @ rng.normal(size=3) for _ in range(_N_DRAWS)
        ]
        errors.append(float(np.median([cell_error(record.shape.cells, motion.pose[-1], motion.pose[-1] + d) for d in draws])))
    return np.array(errors)
