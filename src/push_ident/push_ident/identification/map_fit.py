"""Maps and their posterior by Gauss-Newton, averaged over how strongly maps vary at all.

Nobody knows beforehand whether an object is even or uneven. With a prior that expects strong contrast, a few bad poses make uneven
maps out of an even object; with a weak one, a hammer is never learned. So the maps are fitted under priors of several amplitudes, each
weighed by its evidence (Laplace approximation), and the posterior is the Gaussian with the mixture's mean and covariance:

    log p(pushes | amplitude) = -cost - 1/2 log det H + const,       H: Hessian of the cost, all unknowns in units of the prior

(MacKay, "Bayesian interpolation", Neural Computation 1992.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.identification.budget import Meter
from push_ident.identification.observation import NoiseModel
from push_ident.identification.parameters import MapParameters, Prior
from push_ident.identification.problem import Evaluation, FitProblem
from push_ident.identification.result import Estimate, ModelPosterior
from push_ident.identification.solvers.gauss_newton import MAX_ITERATIONS, minimise
from push_ident.identification.summary import Summary
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, PushRecord, SolveStatus

__all__ = ["MapFit", "fit_maps"]

_AMPLITUDES = (1.0, 0.3, 0.1)
"""Of the maps, as a share of the prior's deviations."""
_NEGLIGIBLE = 7.0
"""An amplitude whose log evidence is so far below the best is left out, and so are the smaller ones after it."""
_EXPECTED = 4.642
"""Four fifths of chi squared with 3 degrees of freedom lie below it."""
_POOR_FIT = 4.0
"""Misfit per degree of freedom above which the pushes contradict each other or the model."""


@dataclass(frozen=True, slots=True)
class _Fit:
    amplitude: float
    problem: FitProblem
    x: Float64Array
    end: Evaluation
    status: SolveStatus

    @property
    def log_evidence(self) -> float:
        return -self.end.cost - 0.5 * float(np.linalg.slogdet(self.end.hessian)[1])

    @property
    def misfit(self) -> float:
        """Squared residual per degree of freedom, by the frame that four fifths lie below; about 1 where all is right."""
        n_z, n_residuals = self.problem.parameters.size, self.end.residual.size
        used = n_z - float(np.trace(np.linalg.inv(self.end.hessian)[:n_z, :n_z])) + 3 * len(self.problem.records)
        size2 = float(np.quantile(np.sum(self.end.residual**2, axis=1), 0.8))
        return size2 / _EXPECTED * n_residuals / max(n_residuals - used, 0.25 * n_residuals)

    def minimum_at(self, amplitude: float) -> Float64Array:
        """Where the cost would be least under another amplitude if the motion were linear in the unknowns: a start that saves steps."""
        n_z = self.problem.parameters.size
        n_poses = len(self.x) - n_z
        prior = np.r_[np.ones(n_z), np.zeros(n_poses)]
        scale = np.r_[self.problem.parameters.unit(amplitude / self.amplitude), np.ones(n_poses)]
        data = self.end.hessian - np.diag(prior)
        slope = self.end.gradient - prior * self.x
        return np.asarray(np.linalg.solve(scale[:, None] * data * scale + np.diag(prior), scale * (data @ self.x - slope)))


@dataclass(frozen=True, slots=True)
class MapFit:
    """Posterior of the maps, and how it came about."""

    posterior: ModelPosterior
    status: SolveStatus
    problem: FitProblem
    """Of the amplitude with the highest evidence."""
    x: Float64Array
    """Where the fit of `problem` ended."""
    cost: float
    """Of `problem` at `x`."""
    misfit: float
    """Squared residual per degree of freedom of `problem`."""
    starts: tuple[Float64Array, ...]
    """Where the fit of each amplitude ended: a warm start for the same pushes and more."""


def fit_maps(
    records: Sequence[PushRecord],
    prior: Prior,
    *,
    noise: NoiseModel | None,
    settings: SimulationSettings | None,
    meter: Meter,
    x_scalar: Float64Array,
    warm_starts: Sequence[Float64Array] = (),
    past: Summary | None = None,
    effects: Sequence[str] = (),
    max_iterations: int = MAX_ITERATIONS,
) -> MapFit:
    """Fit the maps under every amplitude that the pushes leave possible, and average.

    Args:
        records: pushes of one object.
        prior: beliefs; its map deviations are the largest amplitude.
        noise: of the observed poses.
        settings: numerics of the simulation.
        meter: counts the simulations of all fits.
        x_scalar: unknowns without maps: friction scale, pusher friction and first poses, shape (2 + 3 n_records,).
        warm_starts: `starts` of an earlier fit of fewer or as many pushes.
        past: pushes before these, summed up.
        effects: names of effects that are fitted too.
        max_iterations: of each amplitude.
    """
    parameters = MapParameters(records[0].shape, prior, modes=past.modes if past else None, effects=effects)
    fits: list[_Fit] = []
    for i, amplitude in enumerate(_AMPLITUDES):
        own_prior = replace(prior, mass_map_std=amplitude * prior.mass_map_std, friction_map_std=amplitude * prior.friction_map_std)
        own = MapParameters(records[0].shape, own_prior, modes=parameters.modes, effects=effects)
        own_past = past.cost.scaled(own.unit(amplitude)) if past else None
        problem = FitProblem(records, own, noise=noise, settings=settings, meter=meter, past=own_past)
        x0 = np.zeros(problem.size)
        if fits:
            x0 = fits[-1].minimum_at(amplitude)
        else:
            # The maps start flat, at the scales and first poses that fit best without them.
            x0[own.size - 2 :] = x_scalar
        if i < len(warm_starts) and own.size <= len(warm_starts[i]) <= problem.size:
            x0[: len(warm_starts[i])] = warm_starts[i]
        x, end, status = minimise(problem, x0, max_iterations)
        fits.append(_Fit(amplitude, problem, x, end, status))
        if fits[-1].log_evidence < max(f.log_evidence for f in fits) - _NEGLIGIBLE or meter.spent:
            break
    best = max(fits, key=lambda f: f.log_evidence)
    status = best.status
    if status in (SolveStatus.CONVERGED, SolveStatus.STALLED) and best.misfit > _POOR_FIT:
        status = SolveStatus.POOR_FIT
    return MapFit(
        posterior=_average(fits, parameters),
        status=status,
        problem=best.problem,
        x=best.x,
        cost=best.end.cost,
        misfit=best.misfit,
        starts=tuple(f.x for f in fits),
    )


def _average(fits: Sequence[_Fit], parameters: MapParameters) -> ModelPosterior:
    """Gaussian with the mean and the covariance of the mixture, in the units of the full amplitude."""
    evidence = np.array([f.log_evidence for f in fits])
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    n_z = parameters.size
    means, covariances = [], []
    for fit in fits:
        unit = parameters.unit(fit.amplitude)
        # A fit worse than its noise says that something is not in the model: then nothing is known as well as it seems.
        covariance = np.linalg.inv(fit.end.hessian)[:n_z, :n_z] * max(1.0, fit.misfit)
        means.append(unit * fit.x[:n_z])
        covariances.append(unit[:, None] * covariance * unit)
    mean = weights @ np.array(means)
    covariance = sum(
        (w * (c + np.outer(m - mean, m - mean)) for w, m, c in zip(weights, means, covariances, strict=True)), np.zeros((n_z, n_z))
    )
    prior = parameters.prior
    return ModelPosterior(
        parameters=parameters,
        z=mean,
        covariance=0.5 * (covariance + covariance.T),
        total_mass=Estimate(prior.total_mass, prior.total_mass * prior.total_mass_std),
        total_mass_identifiable=prior.total_mass_std == 0,
    )
