"""Gradient descent through the reference engine by automatic differentiation, the fourth baseline of the paper."""

from __future__ import annotations

import numpy as np

from push_ident.identification.problem import FitProblem
from push_ident.identification.solvers.descent import descend
from push_ident.types import Float64Array, SolveStatus

__all__ = ["autograd"]


def autograd(problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
    """placeholder until the reference engine is there"""

    def gradient(x: Float64Array, cost: float) -> Float64Array | None:
        return problem.evaluate(x).gradient

    return descend(problem, x0, gradient)
