"""The account of a gap: the mean error on held-out pushes as a sum of named parts.

A push that a fit did not use ends beside the prediction of that fit by more than the poses' noise: its maps are known only to within their
posterior, and no model of pushing is exact. With draws of the first and the last pose (noise n), of the unknowns z of the posterior of the
fit without the push, of the displacement s of the contact, and of the model discrepancy d, which grows with travel from the floor of the
noise model (contact is not known better), the cell error e to expect is as follows. Where pushes set the size of s and d, both have the
precision of a push that no fit has seen (`fitting/discrepancy.py`).

    A = E e(f(z_mean, x + n_first) + n_last)                  noise of the poses alone
    B = E e(f(z, x + n_first) + n_last)                       and maps that are not known yet
    C = E e(f(z, x + n_first - s) + s + n_last + d)           and the model's own discrepancy

    before = A + (B - A) + (C - B) + sum over the effects of the error that each removes + (after - C)

`after - C` is unexplained. It is negative where pushes were predicted better than expected, as half of the pushes of a right model are.
Motions that switch are no linear function of the model, so that A, B and C are means over simulated motions, not derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.policy import AccountPolicy
from push_ident.diagnosis.shares import removed_by_cause
from push_ident.geometry.cells import cell_errors
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.problem import TAILS, FitProblem
from push_ident.identification.observing.observation import NoiseModel, Observation
from push_ident.identification.predicting.next_push import end_derivative
from push_ident.identification.results.posterior import lower_root
from push_ident.identification.unknowns.mechanics import Mechanics, mechanics_at
from push_ident.physics.accuracy import choose_steps
from push_ident.physics.effect_values import true_pose
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, Timeline
from push_ident.threads import map_in_threads
from push_ident.types import Float64Array, PushRecord

_UNEXPLAINED: Final = "unexplained"


@dataclass(frozen=True, slots=True)
class ExpectedErrors:
    """Mean cell error of held-out pushes that is to be expected if the model is right."""

    noise: Float64Array
    """A, of the poses' noise alone [m], shape (n_pushes,)."""
    maps: Float64Array
    """B, with the unknowns of the posterior [m], shape (n_pushes,)."""
    discrepancy: Float64Array
    """C, with the model discrepancy [m], shape (n_pushes,)."""
    mean_interval: tuple[float, float]
    """Contains the mean over the pushes with the probability of the policy [m]. An error that all pushes have in common, since they are
    predicted from the same maps, is averaged out by no number of them."""


@dataclass(frozen=True, slots=True)
class AccountPart:
    """One part of the mean error on held-out pushes."""

    name: str
    """`noise`, `maps`, `model`, the effect or effects that were added together (joined by " and "), or `unexplained`."""
    mean: float
    """[m]; the parts add up to the error before effects."""
    interval: tuple[float, float]
    """Contains it with the probability of the policy [m], by bootstrap over the pushes; for `unexplained`, over what the model makes
    expect."""
    is_effect: bool = False


@dataclass(frozen=True)
class Account:
    """The mean error on held-out pushes, part by part."""

    gap: Gap
    expected: ExpectedErrors
    more_pushes: int | None = None
    """Pushes like these after which the part of the maps is expected to be no larger than that of the noise; 0 where it is not larger now,
    None where these pushes do not show it, or more than the policy's largest number would be needed."""
    policy: AccountPolicy = field(default_factory=AccountPolicy)

    @property
    def before(self) -> float:
        """Mean error on held-out pushes without the effects: the sum of all parts [m]."""
        return float(np.mean(self.gap.before))

    @property
    def after(self) -> float:
        """With the effects [m]."""
        return float(np.mean(self.gap.after))

    @property
    def expected_error(self) -> float:
        """Of noise, maps and discrepancy together [m]."""
        return float(np.mean(self.expected.discrepancy))

    @property
    def per_push(self) -> dict[str, Float64Array]:
        """Each part by push [m], shape (n_pushes,): `noise`, `maps`, `model`, the effects, `unexplained`."""
        expected, gap = self.expected, self.gap
        return {
            "noise": expected.noise,
            "maps": expected.maps - expected.noise,
            "model": expected.discrepancy - expected.maps,
            **self._effects,
            _UNEXPLAINED: gap.after - expected.discrepancy,
        }

    @cached_property
    def parts(self) -> tuple[AccountPart, ...]:
        """All of them, in the order in which they are added up."""
        effects = self._effects
        return tuple(self._part(name, values, is_effect=name in effects) for name, values in self.per_push.items())

    @property
    def effects(self) -> tuple[AccountPart, ...]:
        """The parts of effects, in the order in which they were added."""
        return tuple(part for part in self.parts if part.is_effect)

    def __getitem__(self, name: str) -> AccountPart:
        """A part by its name. Raises KeyError where there is none."""
        return {part.name: part for part in self.parts}[name]

    @property
    def is_unexplained(self) -> bool:
        """Whether more than the expected error is certainly there, beyond the accuracy of a cell."""
        part = self[_UNEXPLAINED]
        return part.mean > self.policy.negligible and part.interval[0] > 0.0

    @property
    def is_within_chance(self) -> bool:
        """Whether the unexplained part may be zero."""
        part = self[_UNEXPLAINED]
        return part.interval[0] <= 0.0 <= part.interval[1] or abs(part.mean) <= self.policy.negligible

    @property
    def maps_are_open(self) -> bool:
        """Whether maps that are not known yet cost more than the noise, so that what is smaller than they are stays hidden."""
        return self["maps"].mean > self.accepted_maps

    @property
    def accepted_maps(self) -> float:
        """Part of the maps up to which they count as known [m]."""
        return max(self.policy.max_maps_share * self["noise"].mean, self.policy.negligible)

    @property
    def _effects(self) -> dict[str, Float64Array]:
        gap = self.gap
        return {" and ".join(names): values for names, values in removed_by_cause(gap, gap.before, gap.stages, gap.after).items()}

    def _part(self, name: str, values: Float64Array, *, is_effect: bool) -> AccountPart:
        interval = self.gap.mean_interval(values)
        if name == _UNEXPLAINED:
            low, high = self.expected.mean_interval
            interval = self.after - high, self.after - low
        return AccountPart(name, float(np.mean(values)), interval, is_effect)


def account_of(gap: Gap, problem: FitProblem, policy: AccountPolicy) -> Account:
    """Split a gap, which has its fits, into its parts; `problem`: with all pushes."""
    quantiles, n_drawn = gap.policy.interval_quantiles, gap.policy.bootstrap_draws
    account = Account(gap, expected_errors(gap.fits, gap.folds, problem, policy, quantiles=quantiles, n_drawn=n_drawn), 0, policy)
    return replace(account, more_pushes=_more_pushes(account, problem)) if account.maps_are_open else account


def expected_errors(
    fits: Sequence[Fit],
    folds: Sequence[Sequence[int]],
    problem: FitProblem,
    policy: AccountPolicy,
    *,
    quantiles: tuple[float, float],
    n_drawn: int,
) -> ExpectedErrors:
    """Cell errors to expect of all pushes of a problem; `fits`: to those outside each of the `folds`, which are numbers of pushes.
    `quantiles` bound the interval of their mean, over `n_drawn` draws of it."""
    errors = np.empty((problem.n_pushes, 3, policy.draws))
    results = map_in_threads(lambda task: _errors_of_fold(*task, problem, policy), list(zip(fits, folds, strict=True)))
    for fold, errors_of_fold in zip(folds, results, strict=True):
        errors[list(fold)] = errors_of_fold
    noise, maps, discrepancy = np.nanmean(errors, axis=2).T
    all_parts = errors[:, 2]
    # The variance of a mean of independent errors would be the second term.
    shared = np.var(np.nanmean(all_parts, axis=0), ddof=1) - np.mean(np.nanvar(all_parts, axis=1, ddof=1)) / len(all_parts)
    rng, pushes = np.random.default_rng(0), np.arange(problem.n_pushes)
    means = np.nanmean(all_parts[pushes, rng.integers(policy.draws, size=(n_drawn, problem.n_pushes))], axis=1)
    means += np.sqrt(max(0.0, shared)) * rng.normal(size=n_drawn)
    low, high = np.nanquantile(means, quantiles)
    return ExpectedErrors(noise, maps, discrepancy, (float(low), float(high)))


def _errors_of_fold(fit: Fit, pushes: Sequence[int], problem: FitProblem, policy: AccountPolicy) -> Float64Array:
    """Cell errors [m], shape (n_pushes, 3, n_draws): with noise, with the maps, with the discrepancy; NaN where a simulation failed."""
    # The same for every push and every fold, so that the means over the pushes show what pushes have in common. Cholesky's root gives the
    # maps the same draws whatever effects follow them.
    normal = policy.posterior_scale * np.random.default_rng(0).normal(size=(policy.draws, fit.unknowns.size))
    drawn = [mechanics_at(fit.unknowns, z) for z in fit.z + normal @ lower_root(fit.covariance).T]
    mean = fit.mechanics
    floor = (problem.noise or NoiseModel()).floor
    errors = np.full((len(pushes), 3, policy.draws), np.nan)
    for row, push in enumerate(pushes):
        record, observed = problem.records[push], problem.observations[push]
        first, last, discrepancy = np.random.default_rng([1, push]).normal(size=(3, policy.draws, 3))
        starts = observed.pose[0] + first @ lower_root(observed.first_covariance - floor).T
        last = last @ lower_root(observed.last_covariance - floor).T
        discrepancy = discrepancy * np.sqrt(np.diag(floor) + observed.discrepancy[-1] ** 2)
        # The object that is touched is displaced from the one that is seen.
        displacement = np.random.default_rng([2, push]).normal(size=(policy.draws, 3)) * [observed.surface_std, observed.surface_std, 0.0]
        if problem.noise is not None and problem.noise.discrepancy_modes:
            tails = 1.0 / np.sqrt(np.random.default_rng([3, push]).gamma(TAILS / 2, 2 / TAILS, size=(policy.draws, 1)))
            discrepancy, displacement = tails * discrepancy, tails * displacement
        end_of = _EndPoses(record, observed, problem.settings, mean)
        with_maps = last + [end_of(model, start) for model, start in zip(drawn, starts, strict=True)]
        displaced = with_maps
        if observed.surface_std > 0.0:
            touched = [end_of(model, start) for model, start in zip(drawn, starts - displacement, strict=True)]
            displaced = last + touched + displacement
        ends = np.array([last + [end_of(mean, start) for start in starts], with_maps, displaced + discrepancy])
        errors[row] = cell_errors(record.shape.cells, ends, end_of(mean, observed.pose[0]))
    return errors


class _EndPoses:
    """Where a push ends, by model and reported first pose, under the numerics that its prediction had."""

    def __init__(self, record: PushRecord, observed: Observation, settings: SimulationSettings, mean: Mechanics) -> None:
        self._record, self._time = record, observed.time[-1:]
        self._timelines: dict[SimulationSettings, Timeline] = {}
        self.settings = settings

        def end_pose(numerics: SimulationSettings) -> Float64Array:
            self.settings = numerics
            return self(mean, observed.pose[0])

        self.settings = choose_steps(end_pose, settings, observed.end_covariance, record.pusher.time[-1] - record.pusher.time[0]).settings

    def __call__(self, model: Mechanics, first: Float64Array) -> Float64Array:
        scenario = PushScenario(self._record.pusher, true_pose(model.effects, first), self._time, self._record.order)
        if self.settings not in self._timelines:
            self._timelines[self.settings] = Timeline.of(scenario, self.settings)
        return np.asarray(model.simulate(scenario, settings=self.settings, timeline=self._timelines[self.settings]).pose[-1])


def _more_pushes(account: Account, problem: FitProblem) -> int | None:
    """Further pushes after which the maps count as known, see `Account.more_pushes`.

    The pushes of a fit add the information H to the prior, which is 1. As many pushes like them as bring s H leave the covariance
    (1 + s H)^-1, and with the derivative G of the end of a held-out push the error sqrt(tr(G (1 + s H)^-1 G')). The part of the maps that
    was found by simulation is scaled with the mean of that.
    """
    terms: list[tuple[Float64Array, Float64Array, int]] = []
    tasks = [(fit, push) for fit, fold in zip(account.gap.fits, account.gap.folds, strict=True) for push in fold]
    for (fit, _), rows in zip(tasks, map_in_threads(lambda task: _end_by_unknowns(task[0], problem, task[1]), tasks), strict=True):
        if rows is not None:
            information, directions = np.linalg.eigh(np.linalg.inv(fit.covariance) - np.eye(fit.unknowns.size))
            terms.append((np.sum((rows @ directions) ** 2, axis=0), np.maximum(information, 0.0), len(fit.problem.records)))
    noise, both = account["noise"].mean, account["noise"].mean + account["maps"].mean
    if not terms or not np.isfinite(both):
        return None

    def error(n_pushes: int | None) -> float:
        """Of the maps after as many pushes [m], root mean square over the cells; None: as many as in each fit."""
        scaled = [np.sum(size2 / (1.0 + (1.0 if n_pushes is None else n_pushes / n) * added)) for size2, added, n in terms]
        return float(np.mean(np.sqrt(scaled)))

    # The scale of the posterior cancels out.
    simulated = np.sqrt(both**2 - noise**2) / error(None)
    for more in range(1, account.policy.max_more_pushes + 1):
        if np.hypot(noise, simulated * error(len(problem.records) + more)) - noise <= account.accepted_maps:
            return more
    return None


def _end_by_unknowns(fit: Fit, problem: FitProblem, push: int) -> Float64Array | None:
    """d(cell displacement at the end of a push) / d(unknowns of a fit) [m], shape (3, n_unknowns); None where no derivative predicts it."""
    record, observed = problem.records[push], problem.observations[push]
    mechanics = fit.mechanics
    scenario = PushScenario(record.pusher, true_pose(mechanics.effects, observed.pose[0]), observed.time[-1:], record.order)
    motion = mechanics.simulate(scenario, settings=problem.settings, jacobian=True)
    return end_derivative(mechanics, record.shape.cells, motion, observed.pose[0, 2])
