"""Identification that goes on while pushes come in: bounded work at every frame, all pushes remembered."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.identification.budget import Budget, Meter
from push_ident.identification.identify import identify, prior_posterior
from push_ident.identification.observation import NoiseModel
from push_ident.identification.parameters import Prior
from push_ident.identification.problem import FitProblem
from push_ident.identification.quadratic import Quadratic
from push_ident.identification.result import Identification, ModelPosterior
from push_ident.identification.solvers import SOLVERS
from push_ident.identification.solvers.gauss_newton import minimise
from push_ident.identification.summary import Summary, summarise
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, ObjectShape, PushRecord, SolveStatus

__all__ = ["FrameUpdate", "OnlineIdentifier", "OnlineState"]

_FRAME_ITERATIONS = 2
"""Of Gauss-Newton at a frame: the start is the estimate of the frame before."""


@dataclass(frozen=True, slots=True)
class OnlineState:
    """All that the estimate of an object rests on after a finished push: an identifier made from it goes on as if it had never stopped."""

    shape: ObjectShape
    prior: Prior
    records: tuple[PushRecord, ...]
    """The latest pushes, which are simulated again at every solve."""
    past: Summary | None
    """The pushes before them, summed up; or a model that was taken over."""
    starts: tuple[Float64Array, ...]
    """Where the last solve ended."""
    posterior: ModelPosterior
    status: SolveStatus | None
    """Of the last solve; None before the first."""

    @property
    def n_pushes(self) -> int:
        """Finished pushes that the estimate rests on."""
        return len(self.records) + (self.past.n_pushes if self.past else 0)


@dataclass(frozen=True, slots=True)
class FrameUpdate:
    """Estimate in the middle of a push."""

    posterior: ModelPosterior
    status: SolveStatus
    time_s: float
    """That the update took."""


class OnlineIdentifier:
    """Estimate of one object that improves with every push and at every frame of one.

    A finished push is fitted together with the latest ones before it; older ones count by the quadratic that they were summed up to.
    During a push only this push is simulated: all that was learned before is the Gaussian it starts from. What a push under way
    told is not kept, so that the estimate after it depends on the finished pushes alone.

    Args:
        state: to go on from; see `OnlineIdentifier.new`.
        noise: of the observed poses.
        settings: numerics of the simulation.
        method: solver, a name in `SOLVERS`. All but `gauss_newton` know only the latest pushes.
        window: number of pushes that are simulated again at every solve.
        max_seconds: of the solve after a push [s].
        frame_seconds: of an update at a frame [s]; `gauss_newton` is bounded by its number of steps instead.
    """

    def __init__(
        self,
        state: OnlineState,
        *,
        noise: NoiseModel | None = None,
        settings: SimulationSettings | None = None,
        method: str = "gauss_newton",
        window: int = 8,
        max_seconds: float = 30.0,
        frame_seconds: float = 0.02,
    ) -> None:
        self.state = state
        self.result: Identification | None = None
        """Of the last solve of this identifier."""
        self.posterior: ModelPosterior = state.posterior
        """The latest, in the middle of a push too."""
        self._noise, self._settings, self._method, self._window = noise, settings, method, window
        self._budget, self._frame_budget = Budget(max_seconds=max_seconds), Budget(max_seconds=frame_seconds)
        self._under_way: tuple[float, Float64Array] | None = None

    @staticmethod
    def new(shape: ObjectShape, prior: Prior | None = None) -> OnlineState:
        """State of an object that was never pushed."""
        prior = prior or Prior()
        return OnlineState(shape, prior, (), None, (), prior_posterior(shape, prior), None)

    @staticmethod
    def known(posterior: ModelPosterior) -> OnlineState:
        """State of an object whose model is known from elsewhere: further pushes add to it."""
        parameters, mass = posterior.parameters, posterior.total_mass
        prior = posterior.prior
        if posterior.total_mass_identifiable:
            prior = replace(prior, total_mass=mass.value, total_mass_std=mass.std / mass.value)
        past = Summary(0, parameters.modes, Quadratic.beyond_unit_normal(posterior.z, posterior.covariance), np.array([]))
        return OnlineState(parameters.shape, prior, (), past, (), posterior, None)

    @property
    def n_pushes(self) -> int:
        """Finished pushes that the estimate rests on."""
        return self.state.n_pushes

    def add(self, record: PushRecord) -> Identification:
        """Take in a finished push and polish the estimate."""
        state = self.state
        records, past, starts = state.records, state.past, state.starts
        n_z = state.posterior.parameters.size
        while len(records) >= self._window:
            oldest = summarise(records[0], state.posterior, self._noise, self._settings)
            records, past = records[1:], oldest if past is None else past + oldest
            starts = tuple(np.delete(x, np.s_[n_z : n_z + 3]) for x in starts)
        records = (*records, record)
        result = identify(
            records,
            state.prior,
            method=self._method,
            noise=self._noise,
            settings=self._settings,
            budget=self._budget,
            starts=starts,
            past=past,
        )
        self.result, self.posterior, self._under_way = result, result.posterior, None
        self.state = OnlineState(state.shape, state.prior, records, past, result.starts, result.posterior, result.status)
        return result

    def update(self, partial: PushRecord) -> FrameUpdate | None:
        """Estimate with the push under way, as far as it has come; None where it does not touch the object yet."""
        started = time.perf_counter()
        start = float(partial.pusher.time[0])
        latest = self._under_way[1] if self._under_way and self._under_way[0] == start else None
        fit = self._fit_frame(partial, latest)
        if fit is None:
            return None
        x, posterior, status = fit
        if np.all(np.isfinite(x)) and status is not SolveStatus.SIMULATION_FAILED:
            self._under_way, self.posterior = (start, x), posterior
        return FrameUpdate(self.posterior, status, time.perf_counter() - started)

    def _fit_frame(self, partial: PushRecord, latest: Float64Array | None) -> tuple[Float64Array, ModelPosterior, SolveStatus] | None:
        before = self.state.posterior
        n_z = before.parameters.size
        if self._method == "gauss_newton":
            past = Quadratic.beyond_unit_normal(before.z, before.covariance)
            problem = FitProblem([partial], before.parameters, noise=self._noise, settings=self._settings, past=past)
            if not problem.observations[0].touched:
                return None
            x, end, status = minimise(problem, np.r_[before.z, np.zeros(3)] if latest is None else latest, _FRAME_ITERATIONS)
            covariance = np.linalg.inv(end.hessian)[:n_z, :n_z]
            return x, replace(before, z=x[:n_z], covariance=0.5 * (covariance + covariance.T)), status
        records: Sequence[PushRecord] = (*self.state.records, partial)
        meter = Meter(self._frame_budget)
        problem = FitProblem(records, before.parameters, noise=self._noise, settings=self._settings, meter=meter)
        if not problem.observations[-1].touched:
            return None
        x0 = np.zeros(problem.size)
        known = latest if latest is not None else (self.state.starts[0] if self.state.starts else x0)
        x0[: len(known)] = known
        x, status = SOLVERS[self._method](problem, x0, np.random.default_rng(0))
        return x, replace(before, z=x[:n_z]), status
