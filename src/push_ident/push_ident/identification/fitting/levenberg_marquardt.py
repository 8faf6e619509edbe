"""Gauss-Newton with a trust region (Levenberg 1944, Marquardt 1963): finds the minimum of the cost of a `FitProblem`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from push_ident.identification.fitting.budget import Meter
from push_ident.identification.fitting.problem import FRAME_COST, Evaluation, FitProblem
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import Float64Array, SolveStatus

MAX_ITERATIONS = 60
"""Default number of evaluations."""
FINE = 0.02
"""Tolerance of fits that are compared by their evidence: a fiftieth of a unit of it [nat]."""


@dataclass(frozen=True, slots=True)
class DescentOptions:
    """Numbers of the trust region, and when a solve ends. Dampings are relative to the diagonal of the Hessian [-]."""

    first_damping: float = 1e-3
    least_damping: float = 1e-4
    """Below it a step is Newton's anyway, and a failed step would have to climb from there."""
    failed_damping: float = 1e-2
    """Least one after a failed step: less would hardly shorten the next one."""
    largest_damping: float = 1e8
    creep: float = 10.0
    creep_steps: int = 6
    """Converged, too, when this many steps together lowered the cost by less than `creep` tolerances. The cost has kinks (stick and slip),
    and a solve could creep along one for long between points that the data cannot distinguish."""
    reach: float = 5.0
    """A cost is out of reach when it is further away than this many times the expected gain of the next full step."""
    patience: int = 3
    """Steps before a solve may end because the needed cost is out of reach."""
    smooth_steps: int = 20
    """Evaluations after which a solve expects kinks; few smooth problems need as many."""
    pieces: int = 8
    """Largest number of earlier points that describe the cost around a kink."""


_OPTIONS: Final = DescentOptions()


class Cost(Protocol):
    """What is minimised."""

    meter: Meter
    unknowns: UnknownsSpec

    def evaluate(self, x: Float64Array) -> Evaluation:
        """Cost and derivatives at `x`, shape (size,)."""


NeededCost = Callable[[Evaluation], float]
"""The cost at or below which a result matters, were it to end near a point."""


def minimise(
    problem: FitProblem,
    x0: Float64Array,
    max_iterations: int = MAX_ITERATIONS,
    *,
    tolerance: float = 5e-3,
    start: Evaluation | None = None,
    needed_cost: float | NeededCost = np.inf,
    refine: bool = True,
    relative: bool = False,
) -> tuple[Float64Array, Evaluation, SolveStatus]:
    """Minimise the cost of `problem` from `x0`, shape (problem.size,).

    Args:
        problem: to solve.
        x0: start.
        max_iterations: largest number of evaluations, beside the first.
        tolerance: the solve has converged when a full step is expected to lower the cost by less [nat]: far below a unit of log evidence.
        start: evaluation at `x0`, where it is known already.
        refine: look at the time steps at the end, and go on with shorter ones where the noise demands it, up to three times.
        needed_cost: the result matters only at this cost or below, which may depend on where it is; the solve ends early (`OUT_OF_REACH`)
            when it cannot get there.
        relative: whether a solve that creeps may end earlier where the pushes are explained worse than noise would allow.

    Returns:
        The best point, its evaluation, and how the solve ended.
    """
    creep_at = poorness if relative else lambda end: 1.0
    x, end, status = _descend(problem, np.array(x0, dtype=np.float64), max_iterations, tolerance, start, needed_cost, creep_at)
    for _ in range(3 if refine else 0):
        if status not in (SolveStatus.CONVERGED, SolveStatus.STALLED, SolveStatus.MAX_ITERATIONS) or not problem.refine_steps(x):
            break
        finer = problem.evaluate(x)
        if not np.isfinite(finer.cost):
            break
        problem.meter.rebase(x, finer.cost)
        x, end, status = _descend(problem, x, max_iterations, tolerance, finer, needed_cost, creep_at)
    return x, end, status


def minimise_roughly(
    problem: Cost,
    x0: Float64Array,
    max_iterations: int = MAX_ITERATIONS,
    *,
    start: Evaluation | None = None,
    needed_cost: float = np.inf,
) -> tuple[Float64Array, Evaluation, SolveStatus]:
    """As `minimise`, only so far that others may start from the result, to a tenth of a nat, and with the time steps as they are."""
    return _descend(problem, np.array(x0, dtype=np.float64), max_iterations, 0.1, start, needed_cost, poorness)


def poorness(end: Evaluation) -> float:
    """Cost in units of what noise alone would cost, 1 at least: pushes explained so much worse tell points apart so much less."""
    return max(1.0, end.cost / (FRAME_COST * len(end.residual)))


def _descend(
    problem: Cost,
    x: Float64Array,
    max_iterations: int,
    tolerance: float,
    start: Evaluation | None,
    needed_cost: float | NeededCost,
    creep_at: Callable[[Evaluation], float],
) -> tuple[Float64Array, Evaluation, SolveStatus]:
    """As `minimise`, with the time steps as they are."""
    best = problem.evaluate(x) if start is None else start
    if not np.isfinite(best.cost):
        return x, best, SolveStatus.SIMULATION_FAILED
    problem.meter.offer(x, best.cost, problem.unknowns)
    options, damping = _OPTIONS, _OPTIONS.first_damping
    costs = [best.cost]
    pieces = _Pieces([], [], [])
    for _ in range(max_iterations):
        scale = np.diag(best.hessian)
        factor = cho_factor(best.hessian + damping * np.diag(scale))
        step = -cho_solve(factor, best.gradient)
        expected = -float(best.gradient @ step + 0.5 * step @ best.hessian @ step)
        if len(costs) > options.smooth_steps and pieces.gradients:
            step, expected = pieces.step(best, factor)
        arrived = expected < tolerance and damping <= options.failed_damping
        before = costs[-options.creep_steps - 1] if len(costs) > options.creep_steps else np.inf
        creeps = before - best.cost < options.creep * tolerance * creep_at(best)
        needed = needed_cost(best) if callable(needed_cost) else needed_cost
        if arrived or creeps:
            return x, best, SolveStatus.CONVERGED if best.cost <= needed else SolveStatus.OUT_OF_REACH
        may_give_up = len(costs) > options.patience and damping <= options.failed_damping
        if may_give_up and best.cost - options.reach * expected > needed:
            return x, best, SolveStatus.OUT_OF_REACH
        if problem.meter.spent:
            return x, best, SolveStatus.BUDGET_SPENT
        trial = problem.evaluate(x + step)
        gained = best.cost - trial.cost
        pieces.add(best if gained > 0 else trial, step, gained > 0)
        if gained > 0:
            x, best = x + step, trial
            problem.meter.offer(x, best.cost, problem.unknowns)
            damping = max(damping * (0.1 if gained > 0.5 * expected else 1.0), options.least_damping)
        else:
            damping = max(10.0 * damping, options.failed_damping)
            if damping > options.largest_damping:
                return x, best, SolveStatus.STALLED
        costs.append(best.cost)
    return x, best, SolveStatus.MAX_ITERATIONS


@dataclass(slots=True)
class _Pieces:
    """Tangents of the cost at earlier points, which describe it on the other sides of kinks (bundle method with the Gauss-Newton metric).

    With the gradient g_0 at the best point and g_1, g_2, ... at points s_i from it, the model

        max_i (g_i' d - b_i) + 1/2 d' H d,      b_i = max(|cost - cost_i + g_i' s_i|, 1/2 s_i' H s_i), b_0 = 0

    has its minimum at d = -H^-1 sum_i a_i g_i with weights a_i >= 0 of sum 1: a small quadratic problem, solved by exact descent along
    pairs of weights. Source: Lemarechal, Bundle methods in nonsmooth optimization (1978); b_i is the subgradient locality measure of
    Kiwiel, Methods of descent for nondifferentiable optimization (1985), for costs that are not convex.
    """

    gradients: list[Float64Array]
    costs: list[float]
    offsets: list[Float64Array]
    """Relative to the best point."""

    def add(self, point: Evaluation, step: Float64Array, moved: bool) -> None:
        """Keep the tangent of a trial at `step`, or, where the best point moved by `step`, of the point that it left."""
        if moved:
            self.offsets = [offset - step for offset in self.offsets]
        if np.isfinite(point.cost):
            self.gradients.append(point.gradient)
            self.costs.append(point.cost)
            self.offsets.append(-step if moved else step)
        for values in (self.gradients, self.costs, self.offsets):
            del values[: -_OPTIONS.pieces]

    def step(self, best: Evaluation, factor: tuple[Float64Array, bool]) -> tuple[Float64Array, float]:
        """Minimum of the model, and by how much it is below the cost."""
        gradients = np.array([best.gradient, *self.gradients])
        behind = np.array(
            [0.0]
            + [
                max(abs(best.cost - cost + float(g @ s)), 0.5 * float(s @ best.hessian @ s))
                for g, cost, s in zip(self.gradients, self.costs, self.offsets, strict=True)
            ]
        )
        solved = cho_solve(factor, gradients.T)
        gram = gradients @ solved
        weights = np.eye(len(behind))[0]
        for _ in range(20 * len(behind)):
            slope = gram @ weights + behind
            low, high = int(np.argmin(slope)), int(np.argmax(np.where(weights > 0, slope, -np.inf)))
            bend = gram[low, low] + gram[high, high] - 2 * gram[low, high]
            if slope[high] - slope[low] < 1e-9 * (1.0 + abs(slope[low])) or bend <= 0:
                break
            moved = min(weights[high], (slope[high] - slope[low]) / bend)
            weights[low] += moved
            weights[high] -= moved
        return -solved @ weights, float(0.5 * weights @ gram @ weights + behind @ weights)
