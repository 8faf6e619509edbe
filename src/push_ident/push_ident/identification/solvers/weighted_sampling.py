"""Weighted sampling, the second baseline of the paper."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.fitting.solver import Capabilities, CellByCellSolver
from push_ident.identification.solvers.random_search import SPAN, RandomSearch
from push_ident.types import Float64Array, SolveStatus


class WeightedSampling(CellByCellSolver):
    """Uniform samples, then normal ones around the best one with a spread that shrinks (Song & Boularias 2020, Baselines)."""

    name: ClassVar[str] = "weighted_sampling"
    capabilities: ClassVar[Capabilities] = RandomSearch.capabilities
    generation: ClassVar[int] = 20
    """Number of samples around one centre."""
    shrink: ClassVar[float] = 0.9
    """Factor of the spread from one generation to the next."""
    least: ClassVar[float] = 1e-3
    """Spread at which the search ends, in prior standard deviations."""

    def solve(self, problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
        """As `CellByCellSolver.solve`; `MAX_ITERATIONS` where the generations end, with the smallest spread, before the budget."""
        best, meter, n_z = np.array(x0), problem.meter, problem.unknowns.size
        spread, first = SPAN / 2, True
        while not meter.spent and spread > self.least:
            centre = best
            for _ in range(self.generation):
                x = np.array(x0)
                x[:n_z] = rng.uniform(-SPAN, SPAN, n_z) if first else rng.normal(centre[:n_z], spread)
                if meter.offer(x, problem.cost(x)):
                    best = x
                if meter.spent:
                    break
            spread, first = (spread if first else self.shrink * spread), False
        return best, SolveStatus.BUDGET_SPENT if meter.spent else SolveStatus.MAX_ITERATIONS


SOLVER = WeightedSampling()
