"""Gradient descent by finite differences, the third baseline of the paper."""

from __future__ import annotations

import numpy as np

from push_ident.identification.problem import FitProblem
from push_ident.identification.solvers.descent import descend
from push_ident.types import Float64Array, SolveStatus

__all__ = ["finite_differences"]

_STEP = 1e-3
"""In prior deviations."""


def finite_differences(problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
    """Gradient descent; each gradient simulates all pushes once for every unknown of the object (Song & Boularias 2020, Baselines)."""

    def gradient(x: Float64Array, cost: float) -> Float64Array | None:
        slope = np.zeros(problem.size)
        for i in range(problem.parameters.size):
            if problem.meter.spent:
                return None
            moved = x.copy()
            moved[i] += _STEP
            slope[i] = (problem.cost(moved) - cost) / _STEP
        return slope

    return descend(problem, x0, problem.cost, gradient)
