"""The catalogue of solvers: every module of this folder holds one as `SOLVER`. To add a solver, add a file."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import Final

from push_ident.errors import InputError
from push_ident.identification.fitting.solver import Solver


def discover() -> dict[str, Solver]:
    """The solvers in the files of this folder, those with a posterior first, else in alphabetical order."""
    solvers: dict[str, Solver] = {}
    for name in sorted(module.name for module in iter_modules(__path__)):
        solver: Solver = import_module(f"{__name__}.{name}").SOLVER
        if solver.name != name:
            raise ImportError(f"The solver in {name}.py is called {solver.name!r}; give file and solver the same name.")
        solvers[name] = solver
    return dict(sorted(solvers.items(), key=lambda item: not item[1].capabilities.gives_posterior))


SOLVERS: Final = discover()
"""All solvers by name."""
DEFAULT_SOLVER: Final = next(iter(SOLVERS))
"""Name of the solver that is used where none is named."""


def solver_of(method: str) -> Solver:
    """The solver of a name. Raises InputError for a name that is not in `SOLVERS`."""
    if method not in SOLVERS:
        raise InputError(f"There is no method `{method}`; choose one of {', '.join(SOLVERS)}.")
    return SOLVERS[method]
