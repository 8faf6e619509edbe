"""One file for each way to fit the maps, one registry. All solve the same `FitProblem` on the same meter.

A solver takes the problem, a start and a random generator, and returns its best point and how it ended.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from push_ident.identification.problem import FitProblem
from push_ident.identification.solvers.autograd import autograd
from push_ident.identification.solvers.fast_gradient import fast_gradient
from push_ident.identification.solvers.finite_differences import finite_differences
from push_ident.identification.solvers.gauss_newton import gauss_newton
from push_ident.identification.solvers.random_search import random_search
from push_ident.identification.solvers.weighted_sampling import weighted_sampling
from push_ident.types import Float64Array, SolveStatus

__all__ = ["SOLVERS", "Solver"]

Solver = Callable[[FitProblem, Float64Array, np.random.Generator], tuple[Float64Array, SolveStatus]]

SOLVERS: dict[str, Solver] = {
    "gauss_newton": gauss_newton,
    "fast_gradient": fast_gradient,
    "autograd": autograd,
    "finite_differences": finite_differences,
    "random_search": random_search,
    "weighted_sampling": weighted_sampling,
}
"""By name. `gauss_newton` works on smooth maps and yields a posterior; the others are the paper's, cell by cell, and yield none."""
