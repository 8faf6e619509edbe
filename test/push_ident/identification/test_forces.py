"""Measured forces in a fit: what they add, and what a wrong sensor must not do to the maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, random_records, with_forces
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import observe_forces
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.types import PusherPath, WrenchTrack

TRUTH = hammer(2)
RECORDS = random_records(TRUTH, 5, 2)
MEASURED = [with_forces(record, TRUTH) for record in RECORDS[:4]]


def test_forces_become_means_over_windows_with_their_noise() -> None:
    time = np.linspace(0.01, 2.0, 200)
    force = np.tile([3.0, -1.0], (200, 1)) + 0.3 * np.random.default_rng(0).normal(size=(200, 2))
    seen = observe_forces(replace(RECORDS[0], wrench=WrenchTrack(time, force)))
    assert seen is not None and len(seen.force) == 20
    assert seen.edges[0] == pytest.approx(0.0) and seen.edges[-1] == 2.0
    assert np.abs(seen.force - [3.0, -1.0]).max() < 0.4
    # 0.3 N over 10 samples, and 10 % of 3.2 N in twice as many windows as share it.
    expected = np.hypot(0.3 / np.sqrt(10), np.sqrt(2) * 0.1 * np.hypot(3, 1))
    assert np.median(seen.std[np.isfinite(seen.std)]) == pytest.approx(expected, rel=0.1)
    # A window without a sample says nothing.
    time = np.r_[np.linspace(0.01, 0.5, 50), np.linspace(1.51, 2.0, 50)]
    seen = observe_forces(replace(RECORDS[0], wrench=WrenchTrack(time, np.ones((100, 2)))))
    assert seen is not None and np.isinf(seen.std).sum() >= 8
    assert np.all(seen.residual(np.zeros_like(seen.force))[np.isinf(seen.std)] == 0.0)
    assert observe_forces(RECORDS[0]) is None


def test_a_pusher_that_stands_still_against_the_object_says_nothing_of_it() -> None:
    """Friction holds a body at rest against any force below its limit: what presses it after the stop is that of springs in the arm."""
    record, rest = MEASURED[0], np.arange(0.01, 0.5, 0.01)
    pusher, wrench, end = record.pusher, record.wrench, record.pusher.time[-1]
    assert wrench is not None
    stop = pusher.time[np.flatnonzero(np.any(np.diff(pusher.position, axis=0) != 0.0, axis=1))[-1]]
    forces = WrenchTrack(np.r_[wrench.time, end + rest], np.vstack([wrench.force, np.full((len(rest), 2), 0.4)]))
    position = np.vstack([pusher.position, np.tile(pusher.position[-1], (len(rest), 1))])
    seen = observe_forces(replace(record, pusher=PusherPath(np.r_[pusher.time, end + rest], position, pusher.radius), wrench=forces))
    assert seen is not None
    # The window in which it stops says nothing either: a force that lasts as long as the pusher leans would be taken for a late stop.
    assert np.all(np.isinf(seen.std[seen.edges[1:] > stop]))
    assert np.all(np.isfinite(seen.std[seen.edges[1:] < stop])) and np.count_nonzero(seen.edges[1:] < stop) > 5


@pytest.fixture(scope="module")
def measured() -> ModelPosterior:
    return identify(MEASURED).posterior


def test_total_mass_and_friction_of_the_object_are_known_together_better_than_each(measured: ModelPosterior) -> None:
    unknowns, names = measured.unknowns, ("friction_scale", "total_mass")
    at, std = [unknowns.slices[name].start for name in names], np.array([unknowns.blocks[name].std[0] for name in names])
    both = measured.covariance[np.ix_(at, at)] * np.outer(std, std)
    product = np.sqrt(both.sum())
    assert product < 0.06 and product < 0.5 * np.sqrt(np.diag(both)).min()
    assert measured.model.mass @ measured.model.friction == pytest.approx(TRUTH.mass @ TRUTH.friction, rel=0.08)


@pytest.mark.parametrize(
    ("effect", "value", "accuracy"), [("force_offset", [0.6, -0.4], 0.1), ("force_delay", [0.03], 0.004)], ids=["offset", "delay"]
)
def test_errors_of_the_sensor_are_found_and_leave_the_maps_alone(
    measured: ModelPosterior, effect: str, value: list[float], accuracy: float
) -> None:
    wrong = identify([with_forces(r, TRUTH, {effect: value}) for r in RECORDS[:4]]).posterior
    assert wrong.effects.values[wrong.effects.slice_of(effect)] == pytest.approx(value, abs=accuracy)
    change = wrong.model.mass * wrong.model.friction - measured.model.mass * measured.model.friction
    assert np.abs(change).max() < np.max(measured.mass_friction_std)


def test_pushes_that_are_summed_up_keep_what_their_forces_said() -> None:
    online = OnlineIdentifier(OnlineIdentifier.new(TRUTH.shape), window=2)
    masses = [online.add(record).posterior.total_mass for record in MEASURED]
    past = online.state.past
    assert past is not None and past.n_pushes == 2 and online.state.prior.force_offset_std > 0
    assert masses[-1].std < 0.7 * masses[0].std
    assert abs(masses[-1].value - TRUTH.total_mass) < 3.0 * masses[-1].std
    # A push without forces goes on in the same unknowns.
    assert online.add(RECORDS[4]).posterior.unknowns.blocks["total_mass"].size == 1
