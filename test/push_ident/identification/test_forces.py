"""Measured forces in a fit: their derivative, what they add, and what a wrong sensor must not do to the maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, random_records, with_forces
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import observe_forces
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import Float64Array, WrenchTrack


def test_forces_become_means_over_windows_with_their_noise() -> None:
    record = random_records(hammer(2), 1, 2)[0]
    time = np.linspace(0.01, 2.0, 200)
    force = np.tile([3.0, -1.0], (200, 1)) + 0.3 * np.random.default_rng(0).normal(size=(200, 2))
    seen = observe_forces(replace(record, wrench=WrenchTrack(time, force)))
    assert seen is not None and len(seen.force) == 20
    assert seen.edges[0] == pytest.approx(0.0) and seen.edges[-1] == 2.0
    assert np.abs(seen.force - [3.0, -1.0]).max() < 0.4
    # 0.3 N over 10 samples, and 10 % of 3.2 N in twice as many windows as share it.
    expected = np.hypot(0.3 / np.sqrt(10), np.sqrt(2) * 0.1 * np.hypot(3, 1))
    assert np.median(seen.std[np.isfinite(seen.std)]) == pytest.approx(expected, rel=0.1)
    assert observe_forces(record) is None


def test_a_window_without_a_sample_says_nothing() -> None:
    record = random_records(hammer(2), 1, 2)[0]
    time = np.r_[np.linspace(0.01, 0.5, 50), np.linspace(1.51, 2.0, 50)]
    seen = observe_forces(replace(record, wrench=WrenchTrack(time, np.ones((100, 2)))))
    assert seen is not None and np.isinf(seen.std).sum() >= 8
    assert np.all(seen.residual(np.zeros_like(seen.force))[np.isinf(seen.std)] == 0.0)


def test_a_pusher_that_stands_still_against_the_object_says_nothing_of_it() -> None:
    """Friction holds a body at rest against any force below its limit: what presses it after the stop is that of springs in the arm."""
    truth = hammer(1)
    record = with_forces(random_records(truth, 1, 1)[0], truth)
    assert record.wrench is not None
    end, rest = record.pusher.time[-1], np.arange(0.01, 0.5, 0.01)
    stop = record.pusher.time[np.flatnonzero(np.any(np.diff(record.pusher.position, axis=0) != 0.0, axis=1))[-1]]
    time = np.r_[record.wrench.time, end + rest]
    force = np.vstack([record.wrench.force, np.full((len(rest), 2), 0.4)])
    pusher = replace(
        record.pusher,
        time=np.r_[record.pusher.time, end + rest],
        position=np.vstack([record.pusher.position, np.tile(record.pusher.position[-1], (len(rest), 1))]),
    )
    seen = observe_forces(replace(record, pusher=pusher, wrench=WrenchTrack(time, force)))
    assert seen is not None
    assert np.all(np.isinf(seen.std[seen.edges[:-1] > stop]))
    # The window in which it stops says nothing either: a force that lasts as long as the pusher leans would be taken for a late stop.
    (at_stop,) = np.flatnonzero((seen.edges[:-1] <= stop) & (seen.edges[1:] > stop))
    assert np.isinf(seen.std[at_stop])
    assert np.all(np.isfinite(seen.std[seen.edges[1:] < stop])) and np.count_nonzero(seen.edges[1:] < stop) > 5


def problem_with_forces(effects: tuple[str, ...]) -> tuple[FitProblem, Float64Array]:
    truth = hammer(1)
    records = [with_forces(r, truth) for r in random_records(truth, 2, 1)]
    problem = FitProblem(records, UnknownsSpec.of(records[0].shape, Prior().with_force_offset(records), effects=effects))
    return problem, 0.3 * np.random.default_rng(0).normal(size=problem.size)


def test_gradient_with_forces_equals_central_differences() -> None:
    problem, x = problem_with_forces(("force_offset", "force_scale", "force_delay", "table_tilt", "pusher_friction"))
    gradient, own = problem.evaluate(x).gradient, problem.unknowns
    chosen = [0, 5, 41, 60, *range(own.slices["effects"].start, problem.size)]
    for i in chosen:
        step = np.zeros(problem.size)
        step[i] = 1e-5
        difference = (problem.evaluate(x + step).cost - problem.evaluate(x - step).cost) / 2e-5
        assert gradient[i] == pytest.approx(difference, rel=1e-3, abs=1e-2), i
        assert problem.cost(x + step) == pytest.approx(problem.evaluate(x + step).cost)


def test_total_mass_and_friction_of_the_object_are_known_together_better_than_each() -> None:
    truth = hammer(2)
    records = [with_forces(r, truth) for r in random_records(truth, 4, 2)]
    posterior = identify(records).posterior
    scale, mass = (posterior.unknowns.slices[name].start for name in ("friction_scale", "total_mass"))
    std = np.array([posterior.unknowns.blocks[name].std[0] for name in ("friction_scale", "total_mass")])
    both = posterior.covariance[np.ix_([scale, mass], [scale, mass])] * np.outer(std, std)
    product = np.sqrt(both.sum())
    assert product < 0.06 and product < 0.5 * np.sqrt(np.diag(both)).min()
    found = posterior.model.mass @ posterior.model.friction
    assert found == pytest.approx(truth.mass @ truth.friction, rel=0.08)


def test_an_offset_of_the_sensor_is_found_and_leaves_the_maps_alone() -> None:
    truth = hammer(2)
    records = random_records(truth, 4, 2)
    good = identify([with_forces(r, truth) for r in records]).posterior
    stale = identify([with_forces(r, truth, {"force_offset": [0.6, -0.4]}) for r in records]).posterior
    found = stale.effects.values[stale.effects.slice_of("force_offset")]
    assert found == pytest.approx([0.6, -0.4], abs=0.1)
    change = stale.model.mass * stale.model.friction - good.model.mass * good.model.friction
    assert np.abs(change).max() < np.max(good.mass_friction_std)


def test_late_forces_are_found_and_leave_the_maps_alone() -> None:
    truth = hammer(2)
    records = random_records(truth, 4, 2)
    good = identify([with_forces(r, truth) for r in records]).posterior
    late = identify([with_forces(r, truth, {"force_delay": [0.03]}) for r in records]).posterior
    (found,) = late.effects.values[late.effects.slice_of("force_delay")]
    assert found == pytest.approx(0.03, abs=0.004)
    change = late.model.mass * late.model.friction - good.model.mass * good.model.friction
    assert np.abs(change).max() < np.max(good.mass_friction_std)


def test_pushes_that_are_summed_up_keep_what_their_forces_said() -> None:
    truth = hammer(2)
    records = [with_forces(r, truth) for r in random_records(truth, 4, 2)]
    online = OnlineIdentifier(OnlineIdentifier.new(truth.shape), window=2)
    masses = [online.add(record).posterior.total_mass for record in records]
    past = online.state.past
    assert past is not None and past.n_pushes == 2 and online.state.prior.force_offset_std > 0
    assert masses[-1].std < 0.7 * masses[0].std
    assert abs(masses[-1].value - truth.total_mass) < 3.0 * masses[-1].std
    # A push without forces goes on in the same unknowns.
    assert online.add(random_records(truth, 5, 2)[4]).posterior.unknowns.blocks["total_mass"].size == 1


def test_pushes_without_forces_are_fitted_as_before() -> None:
    records = random_records(hammer(2), 2, 2)
    assert identify(records).posterior.unknowns.blocks["total_mass"].size == 0
