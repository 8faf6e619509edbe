"""What a solver is: one way to fit the maps of an object, with the capabilities by which callers treat it.

Each file of `solvers/` holds one as `SOLVER`. A solver that fits every cell by itself derives from `CellByCellSolver` and implements
`solve`; any other implements `fit` and `fit_frame`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from push_ident.identification.fitting.budget import Budget, Meter
from push_ident.identification.fitting.fit import Fit, FitOptions
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.fitting.summary import Summary
from push_ident.identification.results.known_effects import KnownEffect
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.results.result import Candidate, WarmStart
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import Float64Array, PushRecord, SolveStatus


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a solver can do."""

    gives_posterior: bool
    """Its result has a covariance; without it the standard deviations stay those of the prior."""
    takes_effects: bool
    """It fits effects together with the maps."""
    takes_past: bool
    """It uses pushes that are summed up (`Summary`); without it, only pushes that are simulated again count."""
    resumes: bool
    """It starts from an earlier result; without it, it ignores one."""
    cell_by_cell: bool
    """Each cell is an unknown of its own; without it, maps are smooth."""


@dataclass(frozen=True, slots=True)
class FitTask:
    """What a solver is given."""

    records: Sequence[PushRecord]
    """Pushes of one object."""
    unknowns: UnknownsSpec
    """Of the object, with the effects that are fitted too, under the caller's prior."""
    options: FitOptions
    meter: Meter
    """Counts simulations and seconds."""
    scalar: Fit
    """Fit of equal cells to the same pushes, on a meter of its own."""
    warm_starts: Sequence[WarmStart] = ()
    """`MapFit.warm_starts` of an earlier fit by this solver to the first of these pushes."""
    past: Summary | None = None
    """Pushes before these, summed up."""
    known: Sequence[KnownEffect] = ()
    """What is known of effects beside these pushes, for solvers that take effects."""


@dataclass(frozen=True, slots=True)
class MapFit:
    """What a solver returns."""

    posterior: ModelPosterior
    status: SolveStatus
    problem: FitProblem
    """Of the best fit."""
    x: Float64Array
    """Where the fit of `problem` ended, shape (problem.size,)."""
    cost: float
    """Of `problem` at `x`."""
    reduced_chi2: float
    """Of `problem` at `x`; NaN for a solver without a posterior."""
    warm_starts: tuple[WarmStart, ...]
    """Starts for a later fit to the same pushes and more."""
    candidates: tuple[Candidate, ...] = ()
    """Priors that were compared."""


@dataclass(frozen=True, slots=True)
class FrameTask:
    """An update in the middle of a push."""

    partial: PushRecord
    """The push so far."""
    before: ModelPosterior
    """Estimate from the finished pushes."""
    records: Sequence[PushRecord]
    """The latest finished pushes."""
    options: FitOptions
    budget: Budget
    """For solvers whose update has no bound of its own."""
    warm_starts: Sequence[WarmStart] = ()
    """Of the fit to `records`."""
    latest: Float64Array | None = None
    """`FrameFit.x` of the frame before, of the same push."""


@dataclass(frozen=True, slots=True)
class FrameFit:
    """Result of an update."""

    x: Float64Array
    """Start of the next update of the same push."""
    posterior: ModelPosterior
    status: SolveStatus


class Solver(ABC):
    """One way to fit the maps."""

    name: ClassVar[str]
    """As in its file and on the command line."""
    capabilities: ClassVar[Capabilities]

    @abstractmethod
    def fit(self, task: FitTask) -> MapFit:
        """Fit the maps to finished pushes."""

    @abstractmethod
    def fit_frame(self, task: FrameTask) -> FrameFit | None:
        """Fit the maps in the middle of a push; None where the pusher does not touch the object yet."""


class CellByCellSolver(Solver):
    """Every cell is an unknown of its own, as in the paper; there is no posterior."""

    capabilities: ClassVar[Capabilities] = Capabilities(
        gives_posterior=False, takes_effects=False, takes_past=False, resumes=True, cell_by_cell=True
    )

    @abstractmethod
    def solve(self, problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
        """Lower the cost of `problem` from `x0`, shape (problem.size,), until its meter is spent.

        Returns:
            The best point, and how the solve ended.
        """

    def fit(self, task: FitTask) -> MapFit:
        """As `Solver.fit`; the time of the fit of equal cells does not count."""
        meter = task.meter
        meter.restart()
        unknowns = task.unknowns
        problem = FitProblem(task.records, unknowns, noise=task.options.noise, settings=task.options.numerics, meter=meter)
        x0 = np.zeros(problem.size)
        if self.capabilities.resumes and task.warm_starts:
            x0 = problem.continued(x0, task.warm_starts[0].x)
        x, status = self.solve(problem, x0, np.random.default_rng(task.options.seed))
        meter.stop()
        return MapFit(
            posterior=replace(ModelPosterior.of_prior(unknowns), z=problem.object_unknowns(x)),
            status=status,
            problem=problem,
            x=x,
            cost=meter.best.cost if meter.best else np.inf,
            reduced_chi2=np.nan,
            warm_starts=(WarmStart(self.name, x),),
        )

    def fit_frame(self, task: FrameTask) -> FrameFit | None:
        """As `Solver.fit_frame`: all latest pushes are fitted again until the budget is spent."""
        records = (*task.records, task.partial)
        options = task.options
        problem = FitProblem(records, task.before.unknowns, noise=options.noise, settings=options.numerics, meter=Meter(task.budget))
        if not problem.observations[-1].touched:
            return None
        x0 = np.zeros(problem.size)
        earlier = task.latest
        if earlier is None and task.warm_starts:
            earlier = task.warm_starts[0].x
        if self.capabilities.resumes and earlier is not None:
            x0 = problem.continued(x0, earlier)
        x, status = self.solve(problem, x0, np.random.default_rng(options.seed))
        return FrameFit(x, replace(task.before, z=problem.object_unknowns(x)), status)


def descend(
    problem: FitProblem,
    x0: Float64Array,
    cost: Callable[[Float64Array], float],
    gradient: Callable[[Float64Array, float], Float64Array | None],
) -> tuple[Float64Array, SolveStatus]:
    """Follow the negative gradient from `x0`, shape (problem.size,), with a step that doubles on success and falls to a quarter on failure.

    `cost`: at a point; `gradient`: of it there, given the cost, or None where the budget ended first.
    """
    first_step, least_step = 0.3, 1e-6  # in prior standard deviations; at the least one the descent has stalled
    x, meter = np.array(x0), problem.meter
    limit = np.inf if meter.budget.max_seconds is None else meter.budget.max_seconds
    best = cost(x)
    if not np.isfinite(best):
        return x, SolveStatus.SIMULATION_FAILED
    meter.offer(x, best)
    step, slowest = first_step, meter.seconds  # time of an evaluation: none starts that the budget would not let end

    def spent() -> bool:
        return meter.spent or limit - meter.seconds < slowest

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
