"""Weighted sampling, the second baseline of the paper."""

from __future__ import annotations

import numpy as np

from push_ident.identification.problem import FitProblem
from push_ident.identification.solvers.random_search import SPAN
from push_ident.types import Float64Array, SolveStatus

__all__ = ["weighted_sampling"]

_GENERATION = 20
"""Samples drawn around one centre."""
_SHRINK = 0.9
"""Of the spread, from one generation to the next."""
_LEAST = 1e-3
"""Spread at which the search ends."""


def weighted_sampling(problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
    """Uniform samples first, then normal ones around the best so far, with a spread that shrinks (Song & Boularias 2020, Baselines)."""
    best, meter, n_z = np.array(x0), problem.meter, problem.parameters.size
    meter.offer(best, problem.cost(best))
    spread, first = SPAN / 2, True
    while not meter.spent and spread > _LEAST:
        centre = best
        for _ in range(_GENERATION):
            x = np.array(x0)
            x[:n_z] = rng.uniform(-SPAN, SPAN, n_z) if first else rng.normal(centre[:n_z], spread)
            if meter.offer(x, problem.cost(x)):
                best = x
            if meter.spent:
                break
        spread, first = (spread if first else _SHRINK * spread), False
    return best, SolveStatus.BUDGET_SPENT if meter.spent else SolveStatus.MAX_ITERATIONS
