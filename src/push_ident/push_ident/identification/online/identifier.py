"""Identification while pushes arrive: bounded work at every frame, and every push counts."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.identification.fitting.budget import Budget
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.fitting.problem import unknowns_of_push, without_first_push
from push_ident.identification.fitting.solver import FrameTask
from push_ident.identification.fitting.summary import Summary, summarise
from push_ident.identification.identify import Earlier, identify
from push_ident.identification.observing.observation import NoiseModel, noise_at_rest, observe_push
from push_ident.identification.predicting.scoring import PushScore, score_push
from push_ident.identification.results.known_effects import KnownEffect, with_known_effects
from push_ident.identification.results.posterior import ModelPosterior, prior_posterior
from push_ident.identification.results.result import Identification, WarmStart
from push_ident.identification.solvers import DEFAULT_SOLVER, solver_of
from push_ident.identification.unknowns.outline import outline_modes
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.quadratic import Quadratic
from push_ident.physics.accuracy import quick_steps
from push_ident.types import Float64Array, ObjectShape, PushRecord, SolveStatus


@dataclass(frozen=True, slots=True)
class OnlineState:
    """Everything that determines the estimate of an object after a finished push: an identifier made from it continues bit by bit."""

    shape: ObjectShape
    prior: Prior
    records: tuple[PushRecord, ...]
    """The latest pushes, which are simulated again at every solve."""
    past: Summary | None
    """The pushes before them, summed up; or a model that was adopted."""
    warm_starts: tuple[WarmStart, ...]
    """Where the last solve ended."""
    posterior: ModelPosterior
    status: SolveStatus | None
    """Of the last solve; None before the first."""
    known: tuple[KnownEffect, ...] = ()
    """What is known of effects from elsewhere."""

    @property
    def n_pushes(self) -> int:
        """Number of finished pushes in the estimate."""
        return len(self.records) + (self.past.n_pushes if self.past else 0)


@dataclass(frozen=True, slots=True)
class FrameUpdate:
    """Estimate in the middle of a push."""

    posterior: ModelPosterior
    status: SolveStatus
    time_s: float
    """Duration of the update [s]."""


class OnlineIdentifier:
    """Estimate of one object that improves with every push and at every frame of a push.

    A finished push is fitted together with the latest ones before it; older ones count through the quadratic that sums them up. During a
    push the solver updates the estimate at every frame. Such updates are not kept: the estimate after the push depends on the finished
    pushes only.

    Args:
        state: to continue from; see `OnlineIdentifier.new`.
        noise: of the observed poses.
        method: solver, a name in `SOLVERS`. One without `Capabilities.takes_past` uses only the latest pushes.
        window: number of pushes that are simulated again at every solve.
        max_seconds: of the solve after a push [s].
        frame_seconds: of an update at a frame, for solvers whose update has no bound of its own [s].
    """

    def __init__(
        self,
        state: OnlineState,
        *,
        noise: NoiseModel | None = None,
        method: str = DEFAULT_SOLVER,
        window: int = 8,
        max_seconds: float = 30.0,
        frame_seconds: float = 0.02,
    ) -> None:
        self.state = state
        self.result: Identification | None = None
        """Of the last solve of this identifier."""
        self.posterior: ModelPosterior = state.posterior
        """The latest estimate, in the middle of a push too."""
        self._options, self._solver, self._window = FitOptions(noise=noise), solver_of(method), window
        # An update in the middle of a push must be quick, and nothing of it is kept.
        self._frame_options = replace(self._options, noise=noise_at_rest(state.records, noise), numerics=quick_steps(None))
        self._budget, self._frame_budget = Budget(max_seconds=max_seconds), Budget(max_seconds=frame_seconds)
        self._under_way: tuple[float, Float64Array] | None = None

    @staticmethod
    def new(shape: ObjectShape, prior: Prior | None = None) -> OnlineState:
        """State of an object that was never pushed."""
        prior = prior or Prior()
        return OnlineState(shape, prior, (), None, (), prior_posterior(shape, prior), None)

    @staticmethod
    def known(posterior: ModelPosterior) -> OnlineState:
        """State of an object whose model is known already: further pushes add to it."""
        unknowns, mass = posterior.unknowns, posterior.total_mass
        prior = posterior.prior
        if posterior.total_mass_identifiable and unknowns.blocks["total_mass"].size == 0:
            prior = replace(prior, total_mass=mass.value, total_mass_std=mass.std / mass.value)
        known = Quadratic.beyond_unit_normal(posterior.z, posterior.covariance)
        past = Summary(0, unknowns.modes, known, prior.feet, has_prior=True)
        return OnlineState(unknowns.shape, prior, (), past, (), posterior, None)

    @staticmethod
    def with_effects(state: OnlineState, known: Sequence[KnownEffect]) -> OnlineState:
        """The state with these effects beside the maps, and with no others but errors of sensors; to be solved anew (`solve_again`).

        Pushes that were summed up are left out: they were fitted without these effects. A model that was adopted stays.
        """
        posterior, onto = with_known_effects(state.posterior, known)
        past = state.past if state.past is not None and state.past.has_prior else None
        if past is not None:
            past = replace(past, cost=past.cost.transformed(onto))
        return replace(state, past=past, warm_starts=(), posterior=posterior, known=tuple(known))

    @property
    def n_pushes(self) -> int:
        """Number of finished pushes in the estimate."""
        return self.state.n_pushes

    def add(self, record: PushRecord) -> Identification:
        """Add a finished push to the estimate."""
        state = self.state
        records, past, starts = state.records, state.past, state.warm_starts
        options = self._options
        while len(records) >= self._window:
            oldest = summarise(records[0], state.posterior, noise_at_rest(records, options.noise), options.numerics)
            n_of_push = unknowns_of_push(state.shape, options.noise)
            starts = tuple(replace(start, x=without_first_push(start.x, len(records), n_of_push)) for start in starts)
            records, past = records[1:], oldest if past is None else past + oldest
        # An object has one shape, and its unknowns stay the same from push to push: what is summed up counts in them.
        return self._solve((*records, replace(record, shape=state.shape)), past, starts)

    def refine(self, shape: ObjectShape) -> Identification:
        """Fit the latest pushes again with a better outline of the same object, which has the same unknowns.

        Only while every push is simulated anew: what is summed up counts from the outline before.
        """
        starts = self.state.warm_starts if len(outline_modes(shape)) == len(outline_modes(self.state.shape)) else ()
        self.state = replace(self.state, shape=shape)
        return self._solve(tuple(replace(record, shape=shape) for record in self.state.records), None, starts)

    def solve_again(self) -> Identification | None:
        """Fit the latest pushes of the state anew; None where there are none."""
        return self._solve(self.state.records, self.state.past, self.state.warm_starts) if self.state.records else None

    def _solve(self, records: tuple[PushRecord, ...], past: Summary | None, starts: tuple[WarmStart, ...]) -> Identification:
        """Fit these pushes together with the summed up ones, and keep the result."""
        state, prior = self.state, self.state.prior
        if past is None and prior != (prior := prior.with_force_offset(records)):
            starts = ()  # they lack the total mass
        effects = state.posterior.effects.names if self._solver.capabilities.takes_effects else ()
        earlier = Earlier(starts, past, state.known)
        result = identify(
            records, prior, method=self._solver.name, effects=effects, options=self._options, budget=self._budget, earlier=earlier
        )
        self.result, self.posterior, self._under_way = result, result.posterior, None
        self._frame_options = replace(self._frame_options, noise=noise_at_rest(records, self._options.noise))
        posterior, status = result.posterior, result.status
        if past is not None and len(past.cost.point) != (n := posterior.unknowns.size):
            # A solver that fits cell by cell uses no past, and its unknowns are not those of a model that was adopted.
            past = Summary(past.n_pushes, posterior.unknowns.modes, Quadratic.zero(n), posterior.prior.feet)
        self.state = OnlineState(state.shape, prior, records, past, result.warm_starts, posterior, status, state.known)
        return result

    def drop_update(self) -> bool:
        """Forget what was estimated from the push so far, which is not finished; whether there was anything."""
        had, self._under_way, self.posterior = self._under_way is not None, None, self.state.posterior
        return had

    def update(self, partial: PushRecord) -> FrameUpdate | None:
        """Estimate from the push so far; None where the pusher does not touch the object yet."""
        started = time.perf_counter()
        start = float(partial.pusher.time[0])
        latest = self._under_way[1] if self._under_way and self._under_way[0] == start else None
        state = self.state
        task = FrameTask(partial, state.posterior, state.records, self._frame_options, self._frame_budget, state.warm_starts, latest)
        fit = self._solver.fit_frame(task)
        if fit is None:
            return None
        if np.all(np.isfinite(fit.x)) and fit.status is not SolveStatus.SIMULATION_FAILED:
            self._under_way, self.posterior = (start, fit.x), fit.posterior
        return FrameUpdate(self.posterior, fit.status, time.perf_counter() - started)


def running_record(records: Sequence[PushRecord], prior: Prior | None = None) -> list[PushScore]:
    """Score every push of one object that touches it, in order, by the model of those before it; the first by the prior."""
    online = OnlineIdentifier(OnlineIdentifier.new(records[0].shape, prior))
    scores: list[PushScore] = []
    for record in records:
        if observe_push(record).touched:
            scores.append(score_push(online.posterior, record, len(scores) + 1))
            online.add(record)
    return scores
