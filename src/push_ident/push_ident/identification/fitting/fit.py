"""A fit of unknowns to pushes, its evidence, and fits under several amplitudes of the maps' prior.

Nobody knows beforehand whether an object is even or uneven. Under a prior that expects strong contrast, a few bad poses make uneven maps
out of an even object; under a weak one, a hammer is never identified. So the maps are fitted under priors of several amplitudes, which
their log evidence compares (Laplace's approximation):

    log p(pushes | amplitude) = -cost - 1/2 log det H + 1/2 log det P + const

with the Hessian H of the cost and the precision P of the prior, all unknowns in units of their prior standard deviation (MacKay,
"Bayesian interpolation", Neural Computation 1992).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from push_ident.identification.fitting.discrepancy import (
    OF_FRAME,
    DiscrepancySize,
    estimate_size,
    log_density_of_precisions,
    log_prior_of_size,
)
from push_ident.identification.fitting.levenberg_marquardt import MAX_ITERATIONS, NeededCost, minimise, poorness
from push_ident.identification.fitting.problem import Evaluation, FitProblem
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.mechanics import Mechanics, effects_at, mechanics_at, model_at
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.effect_values import EffectValues
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, ObjectModel, SolveStatus

AMPLITUDES: Final = (1.0, 0.3, 0.1)
"""Prior standard deviation of the log maps, relative to `Prior.mass_map_std` and `Prior.friction_map_std`; the largest first."""


@dataclass(frozen=True, slots=True)
class FitOptions:
    """How pushes are simulated and compared with observations in a fit."""

    noise: NoiseModel | None = None
    """Of the observed poses; the defaults of `NoiseModel` where None."""
    numerics: SimulationSettings | None = None
    """Of the simulation; the defaults of `SimulationSettings` where None."""
    max_iterations: int = MAX_ITERATIONS
    """Of Gauss-Newton, for each fit."""
    seed: int = 0
    """Of solvers that draw at random."""
    threads: int = 1
    """Fits that know nothing of each other may run beside each other, in so many threads; results are the same with any number."""


@dataclass(frozen=True)
class Fit:
    """The unknowns that fit a set of pushes best."""

    problem: FitProblem
    x: Float64Array
    """Unknowns of the problem, shape (problem.size,)."""
    end: Evaluation
    """At `x`."""
    status: SolveStatus
    amplitude: float = 1.0
    """Of the maps' prior, relative to that of the caller."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fitted effects."""
        return self.unknowns.effects.names

    @property
    def unknowns(self) -> UnknownsSpec:
        """Unknowns of the object."""
        return self.problem.unknowns

    @property
    def z(self) -> Float64Array:
        """Values of `unknowns`, shape (unknowns.size,)."""
        return self.problem.object_unknowns(self.x)

    @property
    def effect_unknowns(self) -> Float64Array:
        """The block `effects` of `z`, shape (n_values,)."""
        return self.z[self.unknowns.slices["effects"]]

    @property
    def model(self) -> ObjectModel:
        """The fitted object."""
        return model_at(self.unknowns, self.z)

    @property
    def mechanics(self) -> Mechanics:
        """The moving body of the fit, with its derivative."""
        return mechanics_at(self.unknowns, self.z)

    @property
    def effects(self) -> EffectValues:
        """All effects that act, those shared with a reference with their changes."""
        return effects_at(self.unknowns, self.z)

    @property
    def fitted_effects(self) -> EffectValues:
        """The effects of `names`: with a reference, changes since."""
        if self.unknowns.shared is None:
            return self.effects
        effects = self.unknowns.effects
        # A change may be negative where a value may not.
        return replace(effects, values=effects.values + self.unknowns.effect_std * self.effect_unknowns)

    @cached_property
    def discrepancy_size(self) -> DiscrepancySize:
        """Of largest evidence, where the noise has a discrepancy that the frames of a push share."""
        return estimate_size(self.problem, self.x, self.end)

    def has_discrepancy_above(self, factor: float) -> bool:
        """Whether the pushes set a discrepancy, of the contact or of the motion, above this factor on its default."""
        return self.problem.noise is not None and max(self.problem.noise.discrepancy_factor) > factor

    @cached_property
    def log_evidence(self) -> float:
        """Up to a constant of the pushes [nat], under the discrepancy of largest evidence: compare fits of the same pushes only."""
        at_size = -self.end.cost - self.end.log_volume - self._log_size_of_frames
        n_displacements = self.problem.unknowns_of_push - 3
        of_size = log_prior_of_size(self.problem.noise) + log_density_of_precisions(np.array(self.problem.precisions), n_displacements)
        return at_size + of_size + self.discrepancy_size.log_evidence_gain

    @cached_property
    def push_log_densities(self) -> Float64Array:
        """Log density of each push at the unknowns of the object, its own displacements integrated out by Laplace's approximation, up to a
        constant of the pushes [nat], shape (n_pushes,)."""
        problem, noise = self.problem, self.problem.noise
        n, m, n_pushes = problem.unknowns.size, problem.unknowns_of_push, len(problem.records)
        ends = np.cumsum([len(o.time) for o in problem.observations])[:-1]
        frames = np.array([FitProblem.weigh(residual)[0] for residual in np.split(self.end.residual, ends)])
        if noise is not None:
            frames += float(np.log(noise.frame_factor)) * OF_FRAME * np.array([len(o.time) - 1 for o in problem.observations])
        own, precision = self.x[n:].reshape(n_pushes, m), problem.prior_precision[n:].reshape(n_pushes, m)
        blocks = self.end.hessian[n:, n:].reshape(n_pushes, m, n_pushes, m)[np.arange(n_pushes), :, np.arange(n_pushes), :]
        log_prior = 0.5 * np.sum(np.log(precision, where=precision > 0.0, out=np.zeros_like(precision)) - precision * own**2, axis=1)
        return np.asarray(log_prior - frames - 0.5 * np.linalg.slogdet(blocks)[1])

    @property
    def _log_size_of_frames(self) -> float:
        """By which the errors of all frames are larger than stated: the cost leaves it out [nat]."""
        noise = self.problem.noise
        if noise is None or noise.frame_factor == 1.0:
            return 0.0
        return float(np.log(noise.frame_factor)) * OF_FRAME * sum(len(o.time) - 1 for o in self.problem.observations)

    @property
    def covariance(self) -> Float64Array:
        """Posterior covariance of `z`, shape (unknowns.size, unknowns.size)."""
        covariance = self._inverse_hessian
        return np.asarray(0.5 * (covariance + covariance.T))

    @property
    def _inverse_hessian(self) -> Float64Array:
        """Block of the inverse Hessian that belongs to `z`: not symmetric to the last bit."""
        n = self.unknowns.size
        return np.asarray(np.linalg.inv(self.end.hessian)[:n, :n])

    @property
    def posterior(self) -> ModelPosterior:
        """As a Gaussian; the total mass is that of the prior."""
        return replace(ModelPosterior.of_prior(self.unknowns), z=self.z, covariance=self.covariance)

    @property
    def reduced_chi2(self) -> float:
        """Squared residual per degree of freedom, about 1 where the model is right; from a quantile of the frames, so that a few wrong
        poses do not count."""
        n_residuals = self.end.residual.size
        size2 = float(np.quantile(np.sum(self.end.residual**2, axis=1), 0.8))
        # Chi squared with 3 degrees of freedom is below 4.642 with that probability.
        return size2 / 4.642 * n_residuals / self.degrees_of_freedom

    @property
    def degrees_of_freedom(self) -> float:
        """Residuals beyond the unknowns that the pushes determine, at least a quarter of the residuals."""
        n_residuals = self.end.residual.size
        used = self.unknowns.size - float(np.trace(self._inverse_hessian)) + 3 * len(self.problem.records)
        return max(n_residuals - used, 0.25 * n_residuals)

    def minimum_at(self, amplitude: float) -> Float64Array:
        """Minimum of the cost under another amplitude if the motion were linear in the unknowns: a start that saves steps."""
        prior = self.problem.unit_prior
        scale = np.ones(self.problem.size)
        scale[: self.unknowns.size] = self.unknowns.amplitude_unit(amplitude / self.amplitude)
        data = self.end.hessian - np.diag(prior)
        slope = self.end.gradient - prior * self.x
        return np.asarray(np.linalg.solve(scale[:, None] * data * scale + np.diag(prior), scale * (data @ self.x - slope)))


def fit_amplitudes(
    problem_at: Callable[[float], FitProblem],
    start: Float64Array,
    max_iterations: int = MAX_ITERATIONS,
    warm_starts: Sequence[Float64Array] = (),
) -> list[Fit]:
    """Fit the same pushes under several amplitudes of the maps' prior, the largest amplitude first; `start` has shape (problem.size,).

    Beside a fit that explains the pushes, those that cannot come near its evidence are given up (`OUT_OF_REACH`). Fits that creep may end
    earlier where the pushes are explained badly, as in `minimise`. `warm_starts`: results of an earlier search for the first of the same
    pushes, one per amplitude.
    """
    fits: list[Fit] = []
    for i, amplitude in enumerate(AMPLITUDES):
        problem = problem_at(amplitude)
        x0 = problem.continued(start, warm_starts[i]) if i < len(warm_starts) else start
        end = minimise(problem, x0, max_iterations, relative=True, needed_cost=_needed_cost(fits))
        fits.append(Fit(problem, *end, amplitude))
    return fits


def _needed_cost(others: Sequence[Fit], hopeless: float = 20.0) -> float | NeededCost:
    """Cost above which a fit is hopeless beside others; none where no other one explains the pushes to their noise.

    Steps then promise what they bring. Where a strong effect is missing, kinks make a fit gain hundreds of nat that no step promises.
    `hopeless` is the difference of log evidence [nat] to another fit, with five times what the next step promises: odds of 5e8 to 1.
    """
    least = max((fit.log_evidence for fit in others if poorness(fit.end) <= 1.0), default=-np.inf) - hopeless
    return np.inf if np.isinf(least) else lambda end: -least - end.log_volume
