"""Gauss-Newton with a trust region (Levenberg-Marquardt), the default solver."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from push_ident.identification.problem import Evaluation, FitProblem
from push_ident.types import Float64Array, SolveStatus

__all__ = ["MAX_ITERATIONS", "gauss_newton", "minimise"]

_MAX_DAMPING = 1e8
_TOLERANCE = 5e-3
"""Converged when a full step is expected to lower the cost by less (in units of 1/2 chi^2)."""
MAX_ITERATIONS = 60


def gauss_newton(problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
    """Solver interface of `minimise`; nothing is random."""
    x, _, status = minimise(problem, x0)
    return x, status


def minimise(problem: FitProblem, x0: Float64Array, max_iterations: int = MAX_ITERATIONS) -> tuple[Float64Array, Evaluation, SolveStatus]:
    """Minimise the cost of `problem` from `x0`, shape (problem.size,).

    Returns:
        The best point, its evaluation, and how the solve ended.
    """
    x = np.array(x0, dtype=np.float64)
    best = problem.evaluate(x)
    if not np.isfinite(best.cost):
        return x, best, SolveStatus.SIMULATION_FAILED
    problem.meter.offer(x, best.cost)
    damping = 1e-3
    for _ in range(max_iterations):
        scale = np.diag(best.hessian)
        step = -cho_solve(cho_factor(best.hessian + damping * np.diag(scale)), best.gradient)
        expected = -float(best.gradient @ step + 0.5 * step @ best.hessian @ step)
        if expected < _TOLERANCE and damping <= 1e-2:
            return x, best, SolveStatus.CONVERGED
        if problem.meter.spent:
            return x, best, SolveStatus.BUDGET_SPENT
        trial = problem.evaluate(x + step)
        gained = best.cost - trial.cost
        if gained > 0:
            x, best = x + step, trial
            problem.meter.offer(x, best.cost)
            damping = max(damping * (0.1 if gained > 0.5 * expected else 1.0), 1e-9)
        else:
            damping *= 10.0
            if damping > _MAX_DAMPING or (expected < _TOLERANCE and damping > 1e2):
                # The motion has kinks (stick and slip); at one of them the slope need not vanish.
                return x, best, SolveStatus.CONVERGED if expected < _TOLERANCE else SolveStatus.STALLED
    return x, best, SolveStatus.MAX_ITERATIONS
