"""Random search, the first baseline of the paper."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.fitting.solver import Capabilities, CellByCellSolver
from push_ident.types import Float64Array, SolveStatus

SPAN = 2.0
"""Largest size of a drawn unknown, in prior standard deviations."""


class RandomSearch(CellByCellSolver):
    """Draw all unknowns of the object uniformly, again and again, and keep the best (Song & Boularias 2020, Baselines)."""

    name: ClassVar[str] = "random_search"
    capabilities: ClassVar[Capabilities] = Capabilities(
        gives_posterior=False, takes_effects=False, takes_past=False, resumes=False, cell_by_cell=True
    )

    def solve(self, problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
        """As `CellByCellSolver.solve`: it always ends with its budget."""
        best, meter, n_z = np.array(x0), problem.meter, problem.unknowns.size
        while not meter.spent:
            x = np.array(x0)
            x[:n_z] = rng.uniform(-SPAN, SPAN, n_z)
            if meter.offer(x, problem.cost(x)):
                best = x
        return best, SolveStatus.BUDGET_SPENT


SOLVER = RandomSearch()
