"""Gradient descent on the cost, for any source of the gradient."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from push_ident.identification.fitting.problem import FitProblem
from push_ident.types import Float64Array, SolveStatus


def descend(
    problem: FitProblem,
    x0: Float64Array,
    cost: Callable[[Float64Array], float],
    gradient: Callable[[Float64Array, float], Float64Array | None],
    *,
    first_step: float = 0.3,
    least_step: float = 1e-6,
) -> tuple[Float64Array, SolveStatus]:
    """Follow the negative gradient with a step that doubles on success and shrinks to a quarter on failure.

    Args:
        problem: what to fit.
        x0: start, shape (problem.size,).
        cost: at a point.
        gradient: of the cost at a point, given the cost there; None where the budget ended first.
        first_step, least_step: lengths, in prior standard deviations; at the least one the descent has stalled.
    """
    x, meter = np.array(x0), problem.meter
    best = cost(x)
    if not np.isfinite(best):
        return x, SolveStatus.SIMULATION_FAILED
    meter.offer(x, best)
    step, slowest = first_step, meter.seconds  # time of an evaluation: none starts that the budget would not let end

    def spent() -> bool:
        return meter.spent or meter.seconds_left < slowest

    while True:
        began = meter.seconds
        slope = None if spent() else gradient(x, best)
        if slope is None:
            return x, SolveStatus.BUDGET_SPENT
        size = float(np.linalg.norm(slope))
        if size == 0.0 or not np.isfinite(size):
            return x, SolveStatus.CONVERGED if size == 0.0 else SolveStatus.SIMULATION_FAILED
        while True:
            trial = x - step / size * slope
            trial_cost = cost(trial)
            slowest = max(slowest, meter.seconds - began)
            if trial_cost < best:
                break
            step *= 0.25
            if step < least_step:
                return x, SolveStatus.STALLED
            if spent():
                return x, SolveStatus.BUDGET_SPENT
            began = meter.seconds
        x, best = trial, trial_cost
        meter.offer(x, best)
        step *= 2.0
