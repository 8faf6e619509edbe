"""Gauss-Newton with a trust region (Levenberg 1944, Marquardt 1963): finds the minimum of the cost of a `FitProblem`."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from push_ident.identification.problem import Evaluation, FitProblem
from push_ident.types import Float64Array, SolveStatus

__all__ = ["MAX_ITERATIONS", "minimise"]

MAX_ITERATIONS = 60
"""Default number of evaluations."""
_FIRST_DAMPING = 1e-3
"""Of the diagonal of the Hessian, as all dampings here [-]."""
_DAMPING = (1e-4, 1e8)
"""Smallest and largest damping. Below the smallest a step is Newton's anyway, and a failed step would have to climb from there."""
_FAILED_DAMPING = 1e-2
"""Smallest damping after a failed step: less would hardly shorten the next one."""
_TOLERANCE = 5e-3
"""Converged when a full step is expected to lower the cost by less [nat]: far below a unit of log evidence."""
_CREEP = 10.0
_CREEP_STEPS = 6
"""Converged, too, when this many steps together lowered the cost by less than `_CREEP` tolerances. The cost has kinks (stick and slip),
and a solve could creep along one for long between points that the data cannot distinguish."""
_REACH = 5.0
"""A cost is out of reach when it is further away than this many times the expected gain of the next full step."""
_STEPS_BEFORE_GIVING_UP = 3
"""Steps before a solve may end because the needed cost is out of reach."""


def minimise(
    problem: FitProblem,
    x0: Float64Array,
    max_iterations: int = MAX_ITERATIONS,
    *,
    tolerance: float = _TOLERANCE,
    start: Evaluation | None = None,
    needed_cost: float = np.inf,
) -> tuple[Float64Array, Evaluation, SolveStatus]:
    """Minimise the cost of `problem` from `x0`, shape (problem.size,).

    Args:
        problem: to solve.
        x0: start.
        max_iterations: largest number of evaluations, beside the first.
        tolerance: the solve has converged when a full step is expected to lower the cost by less [nat].
        start: evaluation at `x0`, where it is known already.
        needed_cost: the result matters only at this cost or below; the solve ends early (`OUT_OF_REACH`) when it cannot get there.

    Returns:
        The best point, its evaluation, and how the solve ended.
    """
    x = np.array(x0, dtype=np.float64)
    best = problem.evaluate(x) if start is None else start
    if not np.isfinite(best.cost):
        return x, best, SolveStatus.SIMULATION_FAILED
    problem.meter.offer(x, best.cost, problem.unknowns)
    damping = _FIRST_DAMPING
    costs = [best.cost]
    for _ in range(max_iterations):
        scale = np.diag(best.hessian)
        step = -cho_solve(cho_factor(best.hessian + damping * np.diag(scale)), best.gradient)
        expected = -float(best.gradient @ step + 0.5 * step @ best.hessian @ step)
        if expected < tolerance and damping <= _FAILED_DAMPING:
            return x, best, SolveStatus.CONVERGED
        if len(costs) > _CREEP_STEPS and costs[-_CREEP_STEPS - 1] - best.cost < _CREEP * tolerance:
            return x, best, SolveStatus.CONVERGED
        if len(costs) > _STEPS_BEFORE_GIVING_UP and damping <= _FAILED_DAMPING and best.cost - _REACH * expected > needed_cost:
            return x, best, SolveStatus.OUT_OF_REACH
        if problem.meter.spent:
            return x, best, SolveStatus.BUDGET_SPENT
        trial = problem.evaluate(x + step)
        gained = best.cost - trial.cost
        if gained > 0:
            x, best = x + step, trial
            problem.meter.offer(x, best.cost, problem.unknowns)
            damping = max(damping * (0.1 if gained > 0.5 * expected else 1.0), _DAMPING[0])
        else:
            damping = max(10.0 * damping, _FAILED_DAMPING)
            if damping > _DAMPING[1]:
                return x, best, SolveStatus.STALLED
        costs.append(best.cost)
    return x, best, SolveStatus.MAX_ITERATIONS
