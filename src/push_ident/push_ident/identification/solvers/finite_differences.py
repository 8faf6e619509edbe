"""Gradient descent by finite differences, the third baseline of the paper."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.fitting.solver import CellByCellSolver, descend
from push_ident.types import Float64Array, SolveStatus


class FiniteDifferences(CellByCellSolver):
    """Gradient descent; each gradient simulates all pushes once per unknown of the object (Song & Boularias 2020, Baselines)."""

    name: ClassVar[str] = "finite_differences"
    step: ClassVar[float] = 1e-3
    """Of the finite differences, in prior standard deviations."""

    def solve(self, problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
        """As `CellByCellSolver.solve`; nothing is random."""

        def gradient(x: Float64Array, cost: float) -> Float64Array | None:
            slope = np.zeros(problem.size)
            for i in range(problem.unknowns.size):
                if problem.meter.spent:
                    return None
                moved = x.copy()
                moved[i] += self.step
                slope[i] = (problem.cost(moved) - cost) / self.step
            return slope

        return descend(problem, x0, problem.cost, gradient)


SOLVER = FiniteDifferences()
