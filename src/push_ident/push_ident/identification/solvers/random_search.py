"""Random search, the first baseline of the paper."""

from __future__ import annotations

import numpy as np

from push_ident.identification.problem import FitProblem
from push_ident.types import Float64Array, SolveStatus

__all__ = ["SPAN", "random_search"]

SPAN = 2.0
"""Unknowns are drawn within so many prior deviations."""


def random_search(problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
    """Draw all unknowns of the object uniformly, again and again, and keep the best (Song & Boularias 2020, Baselines)."""
    best, meter, n_z = np.array(x0), problem.meter, problem.parameters.size
    meter.offer(best, problem.cost(best))
    while not meter.spent:
        x = np.array(x0)
        x[:n_z] = rng.uniform(-SPAN, SPAN, n_z)
        if meter.offer(x, problem.cost(x)):
            best = x
    return best, SolveStatus.BUDGET_SPENT
