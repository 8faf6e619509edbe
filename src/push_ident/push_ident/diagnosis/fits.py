"""The maps fitted together with some effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.threads import map_in_threads
from push_ident.identification.parameters import MapParameters, Prior
from push_ident.identification.problem import Evaluation, FitProblem
from push_ident.identification.quadratic import Quadratic
from push_ident.identification.result import Estimate, ModelPosterior
from push_ident.identification.solvers.gauss_newton import minimise
from push_ident.physics.effect_values import EffectValues
from push_ident.types import Float64Array, ObjectModel, PushRecord, SolveStatus

__all__ = ["EffectFit", "fit_base", "fit_effects", "fit_effects_but", "polished", "with_another", "without_pushes"]

_AMPLITUDES = (1.0, 0.3, 0.1)
_MAX_ITERATIONS = 40
_MAX_BASE_ITERATIONS = 150
"""The base model has to converge even where a strong effect bends it."""
_ROUGH = 0.05
"""Tolerance of fits that are only compared, where whole units of evidence decide [nat]."""
_AWAY = 0.8
"""Share of its unknowns at which a fit to fewer pushes starts."""
_HELD = 1e8
"""Precision of an unknown that is held."""
_HOPED = 1.0
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
        prior = np.eye(self.parameters.size) + self.problem.past.hessian
        return -self.end.cost - 0.5 * float(np.linalg.slogdet(self.end.hessian)[1] - np.linalg.slogdet(prior)[1])

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

    return max(map_in_threads(fit, _AMPLITUDES), key=lambda fit: fit.log_evidence)


def fit_effects(
    base: EffectFit, names: Sequence[str], start: Float64Array | None = None, expected: float = np.inf, worth: float = -np.inf
) -> EffectFit:
    """Fit other effects to the same pushes under the same prior, as far as it takes to compare it with other fits; see `polished`.

    Args:
        base: an earlier fit, whose maps are the start.
        names: of all effects of the fit.
        start: unknowns of the effects to start from, shape (n_values,); those of `base`, else zero.
        expected: gain of log evidence [nat]. A second start, nearer to zero, is tried where the first hardly helps although it should.
        worth: gain from which the fit matters [nat]; one that has no hope to get there ends early.
    """
    before = base.parameters
    parameters = MapParameters(before.shape, before.prior, modes=before.modes, effects=names)
    guess = np.zeros(len(parameters.effects))
    for name in names:
        if name in base.names:
            guess[parameters.effects.slice_of(name)] = base.z[before.effect_slice][before.effects.slice_of(name)]
    first = guess if start is None else start
    target = base.end.cost - worth
    fits = [_refit(base, parameters, first, worth=target)]
    if start is not None and expected > _HOPED and fits[0].end.cost > base.end.cost - 1.0:
        fits.append(_refit(base, parameters, guess + _SHRUNK * (start - guess), worth=target))
    return max(fits, key=lambda fit: fit.log_evidence)


def with_another(fit: EffectFit, old: str, new: str, other: EffectFit) -> EffectFit:
    """Fit with one effect in the place of another.

    Args:
        fit: to start from.
        old: the effect that goes.
        new: the one that comes.
        other: a fit that has it.
    """
    names = [*(name for name in fit.names if name != old), new]
    parameters = MapParameters(fit.parameters.shape, fit.parameters.prior, modes=fit.parameters.modes, effects=names)
    start = np.zeros(len(parameters.effects))
    for name in names:
        source = other if name == new else fit
        start[parameters.effects.slice_of(name)] = source.z[source.parameters.effect_slice][source.parameters.effects.slice_of(name)]
    return _refit(fit, parameters, start)


def polished(fit: EffectFit) -> EffectFit:
    """The same fit, converged to full tolerance."""
    problem = fit.problem.of(fit.parameters, fit.problem.past)
    return EffectFit(problem, *minimise(problem, fit.x, _MAX_ITERATIONS, start=fit.end))


def fit_effects_but(base: EffectFit, names: Sequence[str], start: Float64Array, held: Sequence[int]) -> EffectFit:
    """As `fit_effects`, with some values of the effects held at zero, as if they had never been there.

    Args:
        base: an earlier fit, whose maps are the start.
        names: of all effects of the fit.
        start: unknowns of the effects to start from, shape (n_values,).
        held: numbers of the values that are held, from the first value of the first effect.
    """
    before = base.parameters
    parameters = MapParameters(before.shape, before.prior, modes=before.modes, effects=names)
    n, precision = parameters.size, np.zeros(parameters.size)
    precision[[parameters.effect_slice.start + number for number in held]] = _HELD
    return _refit(base, parameters, start, Quadratic(np.zeros(n), np.zeros(n), np.diag(precision)))


def without_pushes(fit: EffectFit, pushes: Sequence[int]) -> EffectFit:
    """Fit of the same model to all pushes but some.

    It starts a way off the fit to all: the cost has kinks (stick and slip), and from the fit itself it would stay in those that the
    pushes left out had chosen, and predict them too well.

    Args:
        fit: converged.
        pushes: numbers of the pushes in its problem.
    """
    problem, n_z = fit.problem.without(pushes), fit.parameters.size
    poses = np.delete(fit.x[n_z:].reshape(-1, 3), pushes, axis=0)
    return EffectFit(problem, *minimise(problem, np.r_[_AWAY * fit.z, poses.ravel()], _MAX_ITERATIONS, tolerance=_ROUGH))


def _refit(
    base: EffectFit, parameters: MapParameters, start: Float64Array, past: Quadratic | None = None, worth: float = np.inf
) -> EffectFit:
    before = base.parameters
    maps, scales, poses = base.z[: 2 * before.n_modes], base.z[-2:], base.x[before.size :]
    problem, x0 = base.problem.of(parameters, past), np.concatenate([maps, start, scales, poses])
    return EffectFit(problem, *minimise(problem, x0, _MAX_ITERATIONS, tolerance=_ROUGH, worth=worth))


def _fit(
    records: Sequence[PushRecord],
    settings: DiagnosisSettings,
    prior: Prior,
    modes: Float64Array,
    names: Sequence[str],
) -> EffectFit:
    parameters = MapParameters(records[0].shape, prior, modes=modes, effects=names)
    problem = FitProblem(records, parameters, noise=settings.noise, settings=settings.numerics)
    return EffectFit(problem, *minimise(problem, np.zeros(problem.size), _MAX_BASE_ITERATIONS))
