"""Gauss-Newton on smooth maps, averaged over the amplitudes of their prior: the default solver, and the one with a posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

import numpy as np

from push_ident.identification.fit import AmplitudePolicy, Fit, fit_amplitudes
from push_ident.identification.levenberg_marquardt import minimise
from push_ident.identification.problem import FitProblem
from push_ident.identification.quadratic import Quadratic
from push_ident.identification.result import ModelPosterior
from push_ident.identification.solver import Capabilities, FitTask, FrameFit, FrameTask, MapFit, Solver
from push_ident.identification.unknowns import Unknowns
from push_ident.types import SolveStatus

__all__ = ["SOLVER", "GaussNewton"]

_POOR_FIT: Final = 4.0
"""Reduced chi-square above which the pushes contradict each other or the model: residuals are then twice the stated noise."""
_FRAME_ITERATIONS: Final = 2
"""Steps in an update at a frame: it starts from the estimate of the frame before."""


class GaussNewton(Solver):
    """Fits under several amplitudes of the prior; the posterior is the Gaussian with the mean and the covariance of their mixture."""

    name: ClassVar[str] = "gauss_newton"
    capabilities: ClassVar[Capabilities] = Capabilities(
        gives_posterior=True, takes_effects=True, takes_past=True, resumes=True, cell_by_cell=False
    )

    def fit(self, task: FitTask) -> MapFit:
        """As `Solver.fit`."""
        task.meter.count(task.scalar.problem.meter.n_simulations)
        unknowns = Unknowns(task.shape, task.prior, modes=task.past.modes if task.past else None, effects=task.effects)

        def problem_at(amplitude: float) -> FitProblem:
            past = task.past.cost.scaled(unknowns.amplitude_unit(amplitude)) if task.past else None
            own, options = unknowns.at_amplitude(amplitude), task.options
            return FitProblem(task.records, own, noise=options.noise, settings=options.numerics, meter=task.meter, past=past)

        # The maps start flat, at the scales and first poses that fit best without them.
        start = task.scalar.problem.layout.moved(task.scalar.x, problem_at(1.0).layout)
        fits = fit_amplitudes(problem_at, start, AmplitudePolicy(task.options.max_iterations, warm_starts=task.warm_starts))
        best = max(fits, key=lambda f: f.log_evidence)
        status = best.status
        if status in (SolveStatus.CONVERGED, SolveStatus.STALLED) and best.reduced_chi2 > _POOR_FIT:
            status = SolveStatus.POOR_FIT
        return MapFit(
            posterior=_average(fits, unknowns),
            status=status,
            problem=best.problem,
            x=best.x,
            cost=best.end.cost,
            reduced_chi2=best.reduced_chi2,
            warm_starts=tuple(f.x for f in fits),
        )

    def fit_frame(self, task: FrameTask) -> FrameFit | None:
        """As `Solver.fit_frame`: the posterior of the finished pushes is the prior, and only the push under way is simulated."""
        before, options = task.before, task.options
        past = Quadratic.beyond_unit_normal(before.z, before.covariance)
        problem = FitProblem([task.partial], before.unknowns, noise=options.noise, settings=options.numerics, past=past)
        if not problem.observations[0].touched:
            return None
        start = np.r_[before.z, np.zeros(3)] if task.latest is None else task.latest
        fit = Fit(problem, *minimise(problem, start, _FRAME_ITERATIONS))
        return FrameFit(fit.x, replace(before, z=fit.z, covariance=fit.covariance), fit.status)


SOLVER = GaussNewton()


def _average(fits: Sequence[Fit], unknowns: Unknowns) -> ModelPosterior:
    """Gaussian with the mean and the covariance of the mixture of the fits, in the units of the full amplitude."""
    evidence = np.array([f.log_evidence for f in fits])
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    means, covariances = [], []
    for fit in fits:
        unit = unknowns.amplitude_unit(fit.amplitude)
        means.append(unit * fit.z)
        covariances.append(unit[:, None] * fit.inflated_covariance * unit)
    mean = weights @ np.array(means)
    zero = np.zeros((unknowns.size, unknowns.size))
    covariance = sum((w * (c + np.outer(m - mean, m - mean)) for w, m, c in zip(weights, means, covariances, strict=True)), zero)
    return replace(ModelPosterior.of_prior(unknowns), z=mean, covariance=0.5 * (covariance + covariance.T))
