"""Gauss-Newton with a trust region (Levenberg-Marquardt), the default solver."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from push_ident.identification.problem import Evaluation, FitProblem
from push_ident.types import Float64Array, SolveStatus

__all__ = ["gauss_newton"]

_MAX_DAMPING = 1e8


def gauss_newton(
    problem: FitProblem,
    x0: Float64Array,
    *,
    max_iterations: int = 60,
    tolerance: float = 5e-3,
    on_iteration: Callable[[int, float], None] | None = None,
) -> tuple[Float64Array, Evaluation, SolveStatus]:
    """Minimise the cost of `problem` from `x0`.

    Args:
        problem: what to fit.
        x0: start, shape (problem.size,).
        max_iterations: evaluations of the cost at most.
        tolerance: converged when a full step is expected to lower the cost by less (in units of 1/2 chi^2).
        on_iteration: told the number of the iteration and the cost.

    Returns:
        The best point, its evaluation, and how the solve ended.
    """
    x = np.array(x0, dtype=np.float64)
    best = problem.evaluate(x)
    if not np.isfinite(best.cost):
        return x, best, SolveStatus.SIMULATION_FAILED
    damping = 1e-3
    for iteration in range(1, max_iterations):
        scale = np.diag(best.hessian)
        step = -cho_solve(cho_factor(best.hessian + damping * np.diag(scale)), best.gradient)
        expected = -float(best.gradient @ step + 0.5 * step @ best.hessian @ step)
        if expected < tolerance and damping <= 1e-2:
            return x, best, SolveStatus.CONVERGED
        trial = problem.evaluate(x + step)
        gained = best.cost - trial.cost
        if gained > 0:
            x, best = x + step, trial
            damping = max(damping * (0.1 if gained > 0.5 * expected else 1.0), 1e-9)
        else:
            damping *= 10.0
            if damping > _MAX_DAMPING or (expected < tolerance and damping > 1e2):
                # The motion has kinks (stick and slip); at one of them the slope need not vanish.
                return x, best, SolveStatus.CONVERGED if expected < tolerance else SolveStatus.STALLED
        if on_iteration:
            on_iteration(iteration, best.cost)
    return x, best, SolveStatus.MAX_ITERATIONS
