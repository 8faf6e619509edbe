"""Information from pushes that are no longer simulated: a quadratic in the unknowns.

Around the point x* where a fit ended, the cost of a push is nearly

    1/2 (z - z*)' H (z - z*) + g' (z - z*)

with its own unknowns minimised over (Schur complement). Such quadratics add up, so that old pushes cost nothing however many they are:
the square-root filter of smoothing and mapping (Kaess et al., iSAM, IEEE Trans. Robotics 2008), with Hessians in place of roots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.quadratic import Quadratic
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, PushRecord


@dataclass(frozen=True, slots=True)
class Summary:
    """Pushes of one object, summed up."""

    n_pushes: int
    modes: Float64Array
    """Of the maps, see `UnknownsSpec`, shape (n_cells, n_modes)."""
    cost: Quadratic
    """Of the unknowns, in units of the prior at full amplitude."""
    feet: int
    """`Prior.feet` of the unknowns."""
    has_prior: bool = False
    """Whether the cost holds a prior of the maps already, beyond a unit normal one: that of a model that was adopted."""

    def __add__(self, other: Summary) -> Summary:
        """Both; `other` is the later one, around whose fit the costs are taken."""
        has_prior = self.has_prior or other.has_prior
        return Summary(self.n_pushes + other.n_pushes, self.modes, self.cost + other.cost, self.feet, has_prior)


def summarise(record: PushRecord, posterior: ModelPosterior, noise: NoiseModel | None, settings: SimulationSettings | None) -> Summary:
    """Sum up one push around the mean of a posterior that was fitted to it; a push that cannot be simulated adds no information."""
    unknowns = posterior.unknowns
    problem = FitProblem([record], unknowns, noise=noise, settings=settings)
    n_z, modes, feet = unknowns.size, unknowns.modes, unknowns.prior.feet
    x = np.r_[posterior.z, np.zeros(problem.unknowns_of_push)]
    for _ in range(2):  # Newton steps to the best unknowns of the push itself
        terms = problem.evaluate_push(x, 0)
        if terms is None:
            return Summary(1, modes, Quadratic.zero(n_z), feet)
        x[n_z:] -= np.linalg.solve(terms.hessian[n_z:, n_z:], terms.gradient[n_z:])
    full = problem.evaluate_push(x, 0)
    if full is None:
        return Summary(1, modes, Quadratic.zero(n_z), feet)
    of_push, shared = full.hessian[n_z:, n_z:], full.hessian[:n_z, n_z:]
    onto = np.linalg.solve(of_push, shared.T).T
    hessian = full.hessian[:n_z, :n_z] - onto @ shared.T
    gradient = full.gradient[:n_z] - onto @ full.gradient[n_z:]
    return Summary(1, modes, Quadratic(posterior.z, gradient, hessian), feet)
