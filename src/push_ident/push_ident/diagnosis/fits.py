"""The maps fitted together with some effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.diagnosis.parallel import side_by_side
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.parameters import MapParameters, Prior
from push_ident.identification.problem import Evaluation, FitProblem
from push_ident.identification.result import Estimate, ModelPosterior
from push_ident.identification.solvers.gauss_newton import minimise
from push_ident.physics.effect_values import EffectValues
from push_ident.types import Float64Array, ObjectModel, PushRecord, SolveStatus

__all__ = ["EffectFit", "fit_base", "fit_effects"]

_AMPLITUDES = (1.0, 0.3, 0.1)
_MAX_ITERATIONS = 40
_SHRUNK = 0.4
"""A second start, so much of the way to the first: a linear guess may overshoot."""


@dataclass(frozen=True, slots=True)
class EffectFit:
    """Maps and effects that fit a set of pushes best."""

    problem: FitProblem
    x: Float64Array
    """Unknowns of the problem, shape (problem.size,)."""
    end: Evaluation
    status: SolveStatus

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return self.problem.parameters.effects.names

    @property
    def parameters(self) -> MapParameters:
        return self.problem.parameters

    @property
    def z(self) -> Float64Array:
        """Unknowns of maps and effects, shape (parameters.size,)."""
        return self.x[: self.parameters.size]

    @property
    def model(self) -> ObjectModel:
        return self.parameters.model(self.z)

    @property
    def effects(self) -> EffectValues:
        return self.parameters.effects_at(self.z)

    @property
    def log_evidence(self) -> float:
        """By Laplace's approximation; only differences between fits of the same pushes mean anything."""
        return -self.end.cost - 0.5 * float(np.linalg.slogdet(self.end.hessian)[1])

    @property
    def covariance(self) -> Float64Array:
        """Of `z`, shape (parameters.size, parameters.size)."""
        n = self.parameters.size
        covariance = np.linalg.inv(self.end.hessian)[:n, :n]
        return np.asarray(0.5 * (covariance + covariance.T))

    @property
    def posterior(self) -> ModelPosterior:
        """As an identification has it; the total mass is left as the prior has it."""
        prior = self.parameters.prior
        return ModelPosterior(
            self.parameters,
            self.z,
            self.covariance,
            Estimate(prior.total_mass, prior.total_mass * prior.total_mass_std),
            prior.total_mass_std == 0,
        )


def fit_base(records: Sequence[PushRecord], settings: DiagnosisSettings) -> EffectFit:
    """The base model, under that amplitude of the maps' prior which the pushes speak for most.

    Raises InputError where there is no push, or pushes of different objects.
    """
    shape, full = records[0].shape, settings.base_prior
    modes = MapParameters(shape, full).modes

    def fit(amplitude: float) -> EffectFit:
        prior = replace(full, mass_map_std=amplitude * full.mass_map_std, friction_map_std=amplitude * full.friction_map_std)
        return _fit(records, settings, prior, modes, settings.base_effects)

    return max(side_by_side(fit, _AMPLITUDES), key=lambda fit: fit.log_evidence)


def fit_effects(
    base: EffectFit, names: Sequence[str], start: Float64Array | None = None, records: Sequence[PushRecord] | None = None
) -> EffectFit:
    """Fit other effects under the prior of `base`.

    Args:
        base: an earlier fit, whose maps are the start.
        names: of all effects of the fit.
        start: unknowns of the effects to start from, shape (n_values,); those of `base`, else zero. A second start is tried where this
            one hardly helps.
        records: the pushes; those of `base` by default. Of others, the first poses start anew.
    """
    before = base.parameters
    parameters = MapParameters(before.shape, before.prior, modes=before.modes, effects=names)
    guess = np.zeros(len(parameters.effects))
    for name in names:
        if name in base.names:
            guess[parameters.effects.slice_of(name)] = base.z[before.effect_slice][before.effects.slice_of(name)]
    first = guess if start is None else start
    fits = [_refit(base, parameters, first, records)]
    if start is not None and np.any(start) and fits[0].end.cost > base.end.cost - 1.0:
        fits.append(_refit(base, parameters, guess + _SHRUNK * (start - guess), records))
    return max(fits, key=lambda fit: fit.log_evidence)


def _refit(base: EffectFit, parameters: MapParameters, start: Float64Array, records: Sequence[PushRecord] | None) -> EffectFit:
    problem, before = base.problem, base.parameters
    chosen = problem.records if records is None else list(records)
    maps, scales = base.z[: 2 * before.n_modes], base.z[-2:]
    poses = base.x[before.size :].reshape(-1, 3)
    known = {id(record): pose for record, pose in zip(problem.records, poses, strict=True)}
    first = [known.get(id(record), np.zeros(3)) for record in chosen]
    new = FitProblem(chosen, parameters, noise=problem.noise, settings=problem.settings)
    x0 = np.concatenate([maps, start, scales, *first])
    x, end, status = minimise(new, x0, _MAX_ITERATIONS)
    return EffectFit(new, x, end, status)


def _fit(
    records: Sequence[PushRecord],
    settings: DiagnosisSettings,
    prior: Prior,
    modes: Float64Array,
    names: Sequence[str],
) -> EffectFit:
    parameters = MapParameters(records[0].shape, prior, modes=modes, effects=names)
    problem = FitProblem(records, parameters, noise=settings.noise, settings=settings.numerics)
    x, end, status = minimise(problem, np.zeros(problem.size), _MAX_ITERATIONS)
    return EffectFit(problem, x, end, status)
