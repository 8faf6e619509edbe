"""Gauss-Newton with a trust region (Levenberg-Marquardt), the default solver."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from push_ident.identification.problem import Evaluation, FitProblem
from push_ident.types import Float64Array, SolveStatus

__all__ = ["MAX_ITERATIONS", "gauss_newton", "minimise"]

_DAMPING = (1e-4, 1e8)
"""Least and most; below the least a step is Newton's anyway, and a failure would have to climb from there."""
_FAILED_DAMPING = 1e-2
"""At least so much after a step that failed: less would only shorten it by a hair."""
_TOLERANCE = 5e-3
"""Converged when a full step is expected to lower the cost by less (in units of 1/2 chi^2)."""
_CREEP = 10.0
_CREEP_STEPS = 6
"""Converged, too, when so many steps together lowered the cost by less than so many tolerances: the cost has kinks (stick and slip),
along which a solve could creep for long without the data being able to tell one point from the next."""
_HOPE = 5.0
"""A solve that has to lower the cost by more than so many times what its next full step is expected to, to be worth its while, ends."""
_FIRST_STEPS = 3
"""Steps that are made before that is asked."""
MAX_ITERATIONS = 60


def gauss_newton(problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
    """Solver interface of `minimise`; nothing is random."""
    x, _, status = minimise(problem, x0)
    return x, status


def minimise(
    problem: FitProblem,
    x0: Float64Array,
    max_iterations: int = MAX_ITERATIONS,
    *,
    tolerance: float = _TOLERANCE,
    start: Evaluation | None = None,
    worth: float = np.inf,
) -> tuple[Float64Array, Evaluation, SolveStatus]:
    """Minimise the cost of `problem` from `x0`, shape (problem.size,).

    Args:
        problem: to solve.
        x0: where to begin.
        max_iterations: evaluations at most, beside the first.
        tolerance: a full step that is expected to lower the cost by less is not worth its while (in units of 1/2 chi^2).
        start: evaluation at `x0`, where it is known already.
        worth: cost from which the result matters; a solve that has no hope to get there ends early.

    Returns:
        The best point, its evaluation, and how the solve ended.
    """
    x = np.array(x0, dtype=np.float64)
    best = problem.evaluate(x) if start is None else start
    if not np.isfinite(best.cost):
        return x, best, SolveStatus.SIMULATION_FAILED
    problem.meter.offer(x, best.cost)
    damping = 1e-3
    costs = [best.cost]
    for _ in range(max_iterations):
        scale = np.diag(best.hessian)
        step = -cho_solve(cho_factor(best.hessian + damping * np.diag(scale)), best.gradient)
        expected = -float(best.gradient @ step + 0.5 * step @ best.hessian @ step)
        if expected < tolerance and damping <= 1e-2:
            return x, best, SolveStatus.CONVERGED
        if len(costs) > _CREEP_STEPS and costs[-_CREEP_STEPS - 1] - best.cost < _CREEP * tolerance:
            return x, best, SolveStatus.CONVERGED
        if len(costs) > _FIRST_STEPS and damping <= _FAILED_DAMPING and best.cost - _HOPE * expected > worth:
            return x, best, SolveStatus.BUDGET_SPENT
        if problem.meter.spent:
            return x, best, SolveStatus.BUDGET_SPENT
        trial = problem.evaluate(x + step)
        gained = best.cost - trial.cost
        if gained > 0:
            x, best = x + step, trial
            problem.meter.offer(x, best.cost)
            damping = max(damping * (0.1 if gained > 0.5 * expected else 1.0), _DAMPING[0])
        else:
            damping = max(10.0 * damping, _FAILED_DAMPING)
            if damping > _DAMPING[1]:
                return x, best, SolveStatus.STALLED
        costs.append(best.cost)
    return x, best, SolveStatus.MAX_ITERATIONS
