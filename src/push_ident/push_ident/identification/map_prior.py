"""The prior of the maps, set by the pushes themselves.

Nobody knows beforehand how uneven an object is, whether by its mass, by how its load rests on the table or by its friction, and over what
distance. A prior that expects much makes uneven maps out of an even object and a few bad poses; one that expects little never identifies
a hammer. So the standard deviations of the three log maps and their correlation length are hyperparameters t with a wide prior of their
own, and the pushes set them by the evidence (MacKay, "Bayesian interpolation", Neural Computation 1992): a fit of the unknowns under t
makes the motion linear in them, the evidence of the linear problem is maximal at the next t,

    log p(pushes | t) = -1/2 log det(I + T' A T) + 1/2 r' T (I + T' A T)^-1 T' r + const,      z = T(t) y,   y ~ N(0, I)

with the Hessian A and the slope r of the pushes, and so on until nothing is gained. `z` are the unknowns in the units of the caller's
prior (`Unknowns`), the same whatever t is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from push_ident.identification.fit import Fit
from push_ident.identification.levenberg_marquardt import FINE, minimise, minimise_roughly
from push_ident.identification.prior import MapPrior
from push_ident.identification.problem import FitProblem
from push_ident.identification.unknowns import Unknowns
from push_ident.types import Float64Array

__all__ = ["STARTS", "EvidenceFit", "LinearEvidence", "fit_by_evidence"]

_MAPS: Final = ("mass_map", "pressure_map", "friction_map")
_WIDTH: Final = np.array([1.0, 1.0, 1.0, 0.5])
"""Standard deviation of the logarithm of each hyperparameter about its start: a factor of 2.7 either way, 1.6 for the length [-]."""
_LARGEST_STEP: Final = float(np.log(4.0))
"""Of a logarithm in one round: the linear problem holds near the fit that it comes from [-]."""
_NO_GAIN: Final = 0.1
"""Expected gain of log evidence at which the search ends [nat]."""
_ROUNDS: Final = 4
"""Changes of the hyperparameters."""
_DIFFERENCE: Final = 1e-4
"""Of the logarithm of the length, for its derivative [-]."""


STARTS: Final = {
    "uneven mass and friction": MapPrior(0.7, 0.3, 0.7, 0.25),
    "uneven load": MapPrior(0.1, 1.0, 0.1, 0.25),
}
"""Where the search starts, and the median of the prior of each hyperparameter: an object of uneven material, or one on a base that is
not even."""
_WIDE_DIFFERENCE: Final = 0.1
"""Of the logarithm of a hyperparameter, for the curvature: a tenth of the width of its prior [-]."""


@dataclass(frozen=True, slots=True)
class EvidenceFit:
    """A fit under the hyperparameters that its pushes set."""

    name: str
    prior: MapPrior
    fit: Fit
    transform: Float64Array
    """From the unknowns of the fit to those in the units of the caller's prior, shape (unknowns.size, unknowns.size)."""
    log_evidence: float
    """With the prior of the hyperparameters [nat]."""
    covariance: Float64Array
    """Of the unknowns in the units of the caller's prior, over what the hyperparameters may be, shape (unknowns.size, unknowns.size)."""
    is_complete: bool
    """Whether the search ended because nothing more was to be gained."""


def fit_by_evidence(
    name: str,
    unknowns: Unknowns,
    problem_of: Callable[[Unknowns, Float64Array], FitProblem],
    prior: MapPrior,
    start: Float64Array,
    max_iterations: int,
) -> EvidenceFit | None:
    """Fit the unknowns and the prior of their maps; None where the pushes cannot be simulated.

    Args:
        name: of the start in `STARTS`, whose prior of the hyperparameters holds.
        unknowns: under the caller's prior.
        problem_of: the problem of unknowns under another prior of the maps, and the matrix that leads from them to `unknowns`.
        prior: where the search begins.
        start: of the unknowns and first poses, in the units of the caller's prior, shape (problem.size,).
        max_iterations: of each fit.
    """
    centre, n = STARTS[name].logs, unknowns.size
    logs, best, around = prior.logs, None, None
    for last in (False,) * _ROUNDS + (True,):
        maps = MapPrior.of_logs(logs)
        transform = unknowns.map_transform(maps)
        problem = problem_of(unknowns.under(maps), transform)
        x0 = start.copy()
        x0[:n] = solve_triangular(transform, start[:n], lower=True)
        fit = Fit(problem, *minimise_roughly(problem, x0, max_iterations))
        if not np.isfinite(fit.end.cost):
            break
        linear = LinearEvidence(unknowns, fit, transform, centre)
        following, gain = (logs, 0.0) if last else linear.maximum(logs)
        if gain < _NO_GAIN:
            fit = Fit(problem, *minimise(problem, fit.x, max_iterations, tolerance=FINE, start=fit.end))
        evidence = fit.log_evidence - 0.5 * float(np.sum(((logs - centre) / _WIDTH) ** 2))
        if best is None or evidence > best.log_evidence:
            is_complete = gain < _NO_GAIN and not problem.meter.spent
            covariance = transform @ fit.covariance @ transform.T
            best, around = EvidenceFit(name, maps, fit, transform, evidence, covariance, is_complete), linear
        if gain < _NO_GAIN or problem.meter.spent:
            break
        logs, start = following, linear.minimum(following)
    return None if best is None or around is None else replace(best, covariance=around.covariance(best.prior.logs))


class LinearEvidence:
    """The problem around a fit, as if the motion were linear in the unknowns; in the units of the caller's prior."""

    def __init__(self, unknowns: Unknowns, fit: Fit, transform: Float64Array, centre: Float64Array) -> None:
        self._unknowns, self._centre, n = unknowns, centre, unknowns.size
        unit = fit.problem.unit_prior
        hessian, slope = fit.end.hessian - np.diag(unit), fit.end.gradient - unit * fit.x
        # First poses have no hyperparameters: minimised over.
        self._own = cho_factor(hessian[n:, n:])
        self._shared, pull = hessian[:n, n:], hessian @ fit.x - slope
        self._pull_of_poses = pull[n:]
        reduced = hessian[:n, :n] - self._shared @ cho_solve(self._own, self._shared.T)
        slope = pull[:n] - self._shared @ cho_solve(self._own, pull[n:])
        self._transform = transform
        half = solve_triangular(transform, reduced, lower=True, trans=1)
        self._hessian = solve_triangular(transform, half.T, lower=True, trans=1).T
        self._slope = solve_triangular(transform, slope, lower=True, trans=1)

    def maximum(self, logs: Float64Array) -> tuple[Float64Array, float]:
        """Logarithms of the hyperparameters of largest evidence, not far from `logs`, and what they gain [nat]."""
        bounds = [(value - _LARGEST_STEP, value + _LARGEST_STEP) for value in logs]
        found = minimize(self.cost_and_slope, logs, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 30, "ftol": 1e-6})
        return found.x, float(self._cost(logs)[0] - found.fun)

    def minimum(self, logs: Float64Array) -> Float64Array:
        """Unknowns and first poses at which the cost is least, shape (problem.size,)."""
        _, transform, factor = self._cost(logs)
        z = transform @ cho_solve(factor, transform.T @ self._slope)
        own = solve_triangular(self._transform, z, lower=True)
        return np.concatenate([z, cho_solve(self._own, self._pull_of_poses - self._shared.T @ own)])

    def covariance(self, logs: Float64Array) -> Float64Array:
        """Of the unknowns in the units of the caller's prior, over the hyperparameters near `logs`, where the evidence is largest.

        The hyperparameters are a Gaussian, and the mean over it the mean over two points on each axis (cubature rule of degree 3:
        Arasaratnam & Haykin, IEEE Trans. Automatic Control 2009). Only the covariance is averaged: the mean stays at the best.
        """
        n = len(logs)
        value, axes = np.linalg.eigh(self._curvature(logs))
        # The prior of the hyperparameters alone has this curvature at least: less is a saddle of the linear problem.
        std = 1.0 / np.sqrt(np.maximum(value, _WIDTH.max() ** -2))
        total = np.zeros_like(self._hessian)
        for k in range(n):
            for sign in (-1.0, 1.0):
                _, transform, factor = self._cost(logs + sign * np.sqrt(n) * std[k] * axes[:, k])
                total += transform @ cho_solve(factor, transform.T)
        return total / (2 * n)

    def _curvature(self, logs: Float64Array) -> Float64Array:
        """Second derivative of the cost by the hyperparameters, by differences of the gradient."""
        rows = []
        for k in range(len(logs)):
            step = np.zeros(len(logs))
            step[k] = _WIDE_DIFFERENCE
            rows.append((self.cost_and_slope(logs + step)[1] - self.cost_and_slope(logs - step)[1]) / (2 * _WIDE_DIFFERENCE))
        return 0.5 * (np.array(rows) + np.array(rows).T)

    def _cost(self, logs: Float64Array) -> tuple[float, Float64Array, tuple[Float64Array, bool]]:
        """Negative log evidence, the transform, and a factor of its Hessian."""
        transform = self._unknowns.map_transform(MapPrior.of_logs(logs))
        factor = cho_factor(np.eye(len(transform)) + transform.T @ self._hessian @ transform, lower=True)
        pull = transform.T @ self._slope
        cost = float(np.sum(np.log(np.diag(factor[0])))) - 0.5 * float(pull @ cho_solve(factor, pull))
        return cost + 0.5 * float(np.sum(((logs - self._centre) / _WIDTH) ** 2)), transform, factor

    def cost_and_slope(self, logs: Float64Array) -> tuple[float, Float64Array]:
        """Negative log evidence up to a constant [nat], with its derivative by the logarithms of the hyperparameters, shape (4,)."""
        cost, transform, factor = self._cost(logs)
        y = cho_solve(factor, transform.T @ self._slope)
        variance = np.diag(cho_solve(factor, np.eye(len(y))))
        gradient = (logs - self._centre) / _WIDTH**2
        for k, name in enumerate(_MAPS):
            own = self._unknowns.slice_of(name)
            # Where the evidence is maximal, unknowns are as large as their prior expects.
            gradient[k] += float(np.sum(1.0 - variance[own] - y[own] ** 2))
        step = logs.copy()
        step[3] += _DIFFERENCE
        gradient[3] = (self._cost(step)[0] - cost) / _DIFFERENCE
        return cost, gradient
