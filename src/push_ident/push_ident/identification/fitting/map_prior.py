"""The prior of the maps, set by the pushes themselves.

Nobody knows beforehand how uneven an object is, whether by its mass, by how its load rests on the table or by its friction, and over what
distance. A prior that expects much makes uneven maps out of an even object and a few bad poses; one that expects little never identifies
a hammer. So the standard deviations of the three log maps and their correlation length are hyperparameters t with a wide prior of their
own, and the pushes set them by the evidence (MacKay, "Bayesian interpolation", Neural Computation 1992): a fit of the unknowns under t
makes the motion linear in them, the evidence of the linear problem is maximal at the next t,

    log p(pushes | t) = -1/2 log det(I + T' A T) + 1/2 r' T (I + T' A T)^-1 T' r + const,      z = T(t) y,   y ~ N(0, I)

with the Hessian A and the slope r of the pushes, and so on until nothing is gained. `z` are the unknowns in the units of the caller's
prior (`UnknownsSpec`), the same whatever t is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.levenberg_marquardt import FINE, minimise, minimise_roughly
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.unknowns.prior import MapPrior
from push_ident.identification.unknowns.spec import UnknownsSpec, map_covariance, relative_distances
from push_ident.types import Float64Array

_MAP_BLOCKS: Final = ("mass_map", "pressure_map", "friction_map")
_WIDTH: Final = np.array([1.0, 1.0, 1.0, 0.5])
"""Standard deviation of the logarithm of each hyperparameter about its start: a factor of 2.7 either way, 1.6 for the length [-]."""
_LARGEST_STEP: Final = float(np.log(4.0))
"""Of a logarithm in one round: the linear problem holds near the fit that it comes from [-]."""
_FAR: Final = 30.0
"""Standard deviations from the prior of any unknown at which the minimum of a linear problem is not believed [-]."""
STARTS: Final = {"uneven mass and friction": MapPrior(0.7, 0.3, 0.7, 0.25), "uneven load": MapPrior(0.1, 1.0, 0.1, 0.25)}
"""Where the search starts, and the median of the prior of each hyperparameter: an object of uneven material, or one on a base that is
not even."""


@dataclass(frozen=True, slots=True)
class EvidenceFit:
    """A fit under the hyperparameters that its pushes set."""

    name: str
    prior: MapPrior
    fit: Fit
    log_evidence: float
    """With the prior of the hyperparameters [nat]."""
    z: Float64Array
    """Unknowns in the units of the caller's prior, shape (unknowns.size,)."""
    covariance: Float64Array
    """Of `z`, over what the hyperparameters may be, shape (unknowns.size, unknowns.size)."""
    is_complete: bool
    """Whether the search ended because nothing more was to be gained."""


class MapTransforms:
    """Unknowns under other priors of the maps, with as many modes, and how they lead to those under the caller's prior, `spec`."""

    def __init__(self, spec: UnknownsSpec) -> None:
        self.spec = spec
        self._distances = relative_distances(spec.shape)
        self._onto_modes = np.asarray(np.linalg.pinv(spec.modes), dtype=np.float64)
        """Least-squares inverse of the modes, shape (n_modes, n_cells)."""
        self._of_modes: dict[float, Float64Array] = {}
        """By length: a search for the hyperparameters asks for the same one more than once."""

    def spec_under(self, maps: MapPrior) -> UnknownsSpec:
        """The same unknowns under another prior of the maps; a map that is not there stays away."""
        spec = self.spec
        prior = replace(
            spec.prior,
            mass_map_std=maps.mass_std,
            pressure_map_std=maps.pressure_std if spec.blocks["pressure_map"].size else spec.prior.pressure_map_std,
            friction_map_std=maps.friction_std,
            correlation_length=maps.length,
        )
        return replace(spec, prior=prior, modes=spec.modes @ self._transform_of_modes(maps.length))

    def matrix(self, maps: MapPrior) -> Float64Array:
        """From `z` of `spec_under(maps)` to that of `spec`, lower triangular, shape (size, size)."""
        spec = self.spec
        transform = np.eye(spec.size)
        modes = self._transform_of_modes(maps.length)
        for name, std in zip(_MAP_BLOCKS, (maps.mass_std, maps.pressure_std, maps.friction_std), strict=True):
            if spec.blocks[name].size:
                transform[spec.slices[name], spec.slices[name]] = std / spec.blocks[name].std[:, None] * modes
        return transform

    def _transform_of_modes(self, length: float) -> Float64Array:
        """Root of the covariance of the modes under a unit map of another correlation length, shape (n_modes, n_modes)."""
        n_modes = self.spec.modes.shape[1]
        if length == self.spec.prior.correlation_length:
            return np.eye(n_modes)
        if length not in self._of_modes:
            covariance = self._onto_modes @ map_covariance(self._distances, length) @ self._onto_modes.T
            self._of_modes[length] = np.asarray(np.linalg.cholesky(covariance + 1e-12 * np.eye(n_modes)), dtype=np.float64)
        return self._of_modes[length]


def fit_by_evidence(
    name: str,
    spec: UnknownsSpec,
    problem_of: Callable[[UnknownsSpec, Float64Array], FitProblem],
    prior: MapPrior,
    start: Float64Array,
    max_iterations: int,
    *,
    n_rounds: int = 4,
    no_gain: float = 0.1,
) -> EvidenceFit | None:
    """Fit the unknowns and the prior of their maps, from `prior` on; None where the pushes cannot be simulated.

    `name`: of the start in `STARTS`, whose prior of the hyperparameters holds; `spec`: unknowns under the caller's prior; `problem_of`: the
    problem of unknowns under another prior of the maps, and the matrix that leads from them to the caller's; `start`: of the unknowns and
    first poses, in the units of the caller's prior, shape (problem.size,); `n_rounds`: changes of the hyperparameters, at most; `no_gain`:
    expected gain of log evidence at which the search ends [nat].
    """
    centre, n, transforms = STARTS[name].logs, spec.size, MapTransforms(spec)
    logs, best = prior.logs, None
    for last in (False,) * n_rounds + (True,):
        maps = MapPrior.of_logs(logs)
        transform = transforms.matrix(maps)
        problem = problem_of(transforms.spec_under(maps), transform)
        x0 = start.copy()
        x0[:n] = solve_triangular(transform, start[:n], lower=True)
        fit = Fit(problem, *minimise_roughly(problem, x0, max_iterations))
        if not np.isfinite(fit.end.cost):
            break
        linear = LinearEvidence(transforms, fit, transform, centre)
        following, gain = (logs, 0.0) if last else linear.maximum(logs)
        # Where a push is unstable, as of a pusher at the middle of a face, its derivative holds only nearby.
        expected = linear.minimum(following)
        start = expected if np.max(np.abs(expected)) < _FAR else np.append(transform @ fit.z, fit.x[n:])
        if gain < no_gain:
            fit = Fit(problem, *minimise(problem, fit.x, max_iterations, tolerance=FINE, start=fit.end))
        evidence = fit.log_evidence - 0.5 * float(np.sum(((logs - centre) / _WIDTH) ** 2))
        if best is None or evidence > best[0]:
            best = evidence, maps, fit, linear, transform @ fit.z, gain < no_gain and not problem.meter.spent
        if gain < no_gain or problem.meter.spent:
            break
        logs = following
    if best is None:
        return None
    evidence, maps, fit, linear, z, is_complete = best
    return EvidenceFit(name, maps, fit, evidence, z, linear.covariance(maps.logs), is_complete)


class LinearEvidence:
    """The problem around a fit, as if the motion were linear in the unknowns; in the units of the caller's prior."""

    def __init__(self, transforms: MapTransforms, fit: Fit, transform: Float64Array, centre: Float64Array) -> None:
        self._transforms, self._centre, n = transforms, centre, transforms.spec.size
        unit = fit.problem.unit_prior
        hessian, slope = fit.end.hessian - np.diag(unit), fit.end.gradient - unit * fit.x
        # First poses have no hyperparameters: minimised over.
        self._of_poses = _factor(hessian[n:, n:])
        self._shared, pull = hessian[:n, n:], hessian @ fit.x - slope
        self._pull_of_poses = pull[n:]
        reduced = hessian[:n, :n] - self._shared @ cho_solve(self._of_poses, self._shared.T)
        slope = pull[:n] - self._shared @ cho_solve(self._of_poses, pull[n:])
        self._transform = transform
        half = solve_triangular(transform, reduced, lower=True, trans=1)
        self._hessian = solve_triangular(transform, half.T, lower=True, trans=1).T
        self._slope = solve_triangular(transform, slope, lower=True, trans=1)

    def maximum(self, logs: Float64Array) -> tuple[Float64Array, float]:
        """Logarithms of the hyperparameters of largest evidence, not far from `logs`, and what they gain [nat]."""
        bounds = [(value - _LARGEST_STEP, value + _LARGEST_STEP) for value in logs]
        optimum = minimize(self.cost_and_slope, logs, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 30, "ftol": 1e-6})
        return optimum.x, float(self._cost(logs)[0] - optimum.fun)

    def minimum(self, logs: Float64Array) -> Float64Array:
        """Unknowns and first poses at which the cost is least, shape (problem.size,)."""
        _, transform, factor = self._cost(logs)
        z = transform @ cho_solve(factor, transform.T @ self._slope)
        y = solve_triangular(self._transform, z, lower=True)
        return np.concatenate([z, cho_solve(self._of_poses, self._pull_of_poses - self._shared.T @ y)])

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
        """Second derivative of the cost by the hyperparameters, by differences of the gradient over a tenth of the width of their prior."""
        steps = 0.1 * np.eye(len(logs))
        rows = [(self.cost_and_slope(logs + step)[1] - self.cost_and_slope(logs - step)[1]) / (2 * 0.1) for step in steps]
        return 0.5 * (np.array(rows) + np.array(rows).T)

    def _cost(self, logs: Float64Array) -> tuple[float, Float64Array, tuple[Float64Array, bool]]:
        """Negative log evidence, the transform, and a factor of its Hessian."""
        transform = self._transforms.matrix(MapPrior.of_logs(logs))
        factor = _factor(np.eye(len(transform)) + transform.T @ self._hessian @ transform, lower=True)
        pull = transform.T @ self._slope
        cost = float(np.sum(np.log(np.diag(factor[0])))) - 0.5 * float(pull @ cho_solve(factor, pull))
        return cost + 0.5 * float(np.sum(((logs - self._centre) / _WIDTH) ** 2)), transform, factor

    def cost_and_slope(self, logs: Float64Array) -> tuple[float, Float64Array]:
        """Negative log evidence up to a constant [nat], with its derivative by the logarithms of the hyperparameters, shape (4,)."""
        cost, transform, factor = self._cost(logs)
        y = cho_solve(factor, transform.T @ self._slope)
        variance = np.diag(cho_solve(factor, np.eye(len(y))))
        gradient = (logs - self._centre) / _WIDTH**2
        for k, name in enumerate(_MAP_BLOCKS):
            at = self._transforms.spec.slices[name]
            # Where the evidence is maximal, unknowns are as large as their prior expects.
            gradient[k] += float(np.sum(1.0 - variance[at] - y[at] ** 2))
        step, difference = logs.copy(), 1e-4
        step[3] += difference
        gradient[3] = (self._cost(step)[0] - cost) / difference
        return cost, gradient


def _factor(matrix: Float64Array, *, lower: bool = False) -> tuple[Float64Array, bool]:
    """Cholesky's factor of a positive definite matrix, also where rounding makes it indefinite.

    A motion that is unstable by its first pose has directions that are steeper than others by more than doubles resolve; the diagonal then
    grows by what rounding loses.
    """
    added = 0.0
    while True:
        try:
            factor, is_lower = cho_factor(matrix + added * np.eye(len(matrix)) if added else matrix, lower=lower)
            return np.asarray(factor), bool(is_lower)
        except np.linalg.LinAlgError:
            added = max(10.0 * added, len(matrix) * float(np.finfo(float).eps * np.max(np.abs(np.diag(matrix)))))
