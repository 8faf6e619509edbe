"""Known objects and effects in twins of recorded pushes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import QUICK, TRUTH, simulated_pushes
from helpers.objects import with_forces
from push_ident.diagnosis.fits import fit_base, fit_effects, polished
from push_ident.identification.fitting.discrepancy import LinearPushes
from push_ident.identification.fitting.fit import Fit, FitOptions
from push_ident.identification.observing.observation import NoiseModel, noise_correlation, observe_forces, scatter_at_rest
from push_ident.identification.results.identifiability import Knowledge
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.mechanics import mechanics_at, unknowns_of_maps
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.recovery.effects import VisibleEffect, prove, visible_effects, worth_proving
from push_ident.recovery.maps import recoveries_of, try_maps
from push_ident.recovery.run import SelfTestOptions, selftest
from push_ident.recovery.twins import twins_of
from push_ident.recovery.wording import can_tell, cannot_tell, would_help
from push_ident.types import PushRecord

EXACT = NoiseModel(model_discrepancy_position=0.0, model_discrepancy_yaw=0.0)


@pytest.fixture(scope="module")
def pushes() -> list[PushRecord]:
    return simulated_pushes(6, 3)


@pytest.fixture(scope="module")
def base(pushes: list[PushRecord]) -> Fit:
    return fit_base(pushes, QUICK)


def test_twin_of_the_true_object_is_the_recording_but_for_noise_of_its_size(pushes: list[PushRecord]) -> None:
    prior = replace(Prior(), total_mass=TRUTH.total_mass, pressure_map_std=0.0)
    spec = UnknownsSpec.of(TRUTH.shape, prior).cell_by_cell()
    mechanics = mechanics_at(spec, unknowns_of_maps(spec, TRUTH.mass, TRUTH.friction, TRUTH.pusher_friction))
    forced = [with_forces(record, TRUTH) for record in pushes]
    twins = twins_of(forced, mechanics, EXACT, np.random.default_rng(1))
    for record, twin in zip(forced, twins, strict=True):
        std = np.sqrt(np.diagonal(record.poses.covariance, axis1=1, axis2=2))
        error = (twin.poses.pose - record.poses.pose) / std
        assert 0.9 < np.sqrt(np.mean(error**2)) < 2.2  # that of two recordings is 1.4, with another first pose
        measured, simulated = observe_forces(record), observe_forces(twin)
        assert measured is not None and simulated is not None
        moving = np.isfinite(measured.std)
        assert np.median(np.linalg.norm(simulated.force - measured.force, axis=1)[moving] / measured.std[moving]) < 1.5
    same = twins_of(forced, mechanics, EXACT, np.random.default_rng(1))
    assert all(np.array_equal(a.poses.pose, b.poses.pose) for a, b in zip(same, twins, strict=True))
    wide = twins_of(pushes, mechanics, replace(EXACT, model_discrepancy_position=0.2), np.random.default_rng(1))
    moved = [np.linalg.norm(a.poses.pose[-1, :2] - b.poses.pose[-1, :2]) for a, b in zip(wide, twins, strict=True)]
    assert np.median(moved) > 3e-3


def test_noise_of_a_twin_is_as_large_and_as_correlated_as_that_of_the_recording(pushes: list[PushRecord]) -> None:
    rng, n = np.random.default_rng(0), 120
    record = pushes[0]
    still = record.poses.time[0] + np.arange(n) / 30.0 - n / 30.0
    error = np.zeros((n, 3))
    for frame in range(n):
        error[frame] = 0.8 * error[frame - 1] + 0.6 * rng.normal(size=3)
    std = np.sqrt(np.diag(record.poses.covariance[0]))
    poses = replace(
        record.poses,
        time=np.r_[still, record.poses.time],
        pose=np.vstack([record.poses.pose[0] + 0.5 * std * error, record.poses.pose]),
        covariance=np.concatenate([np.repeat(record.poses.covariance[:1], n, axis=0), record.poses.covariance]),
    )
    longer = replace(record, poses=poses)
    noise = replace(EXACT, correlation=noise_correlation([longer]))
    spec = UnknownsSpec.of(record.shape, Prior())
    twin = twins_of([longer], mechanics_at(spec, np.zeros(spec.size)), noise, rng)[0]
    assert noise.correlation > 0.4 and noise_correlation([twin]) == pytest.approx(noise.correlation, abs=0.2)
    assert scatter_at_rest(twin, 0.8) == pytest.approx(scatter_at_rest(longer, 0.8), rel=0.6) and scatter_at_rest(longer, 0.8) < 0.6


def test_objects_that_are_drawn_are_recovered_as_far_as_pushes_tell(pushes: list[PushRecord]) -> None:
    tests = [try_maps(pushes, Prior(), (), EXACT, np.random.default_rng(k), FitOptions()) for k in range(2)]
    found = {q.name: q for q in recoveries_of(tests, prior_posterior(pushes[0].shape))}
    friction = found["centre of friction x"]
    assert friction.knowledge is Knowledge.PINNED and friction.error < 0.25 * friction.prior_std
    assert found["total mass"].knowledge is Knowledge.OPEN and found["total mass"].std == pytest.approx(0.7)
    assert all(test.end_error < 0.5 * test.end_error_before for test in tests)
    assert sum(q.n_within for q in found.values()) >= len(found)  # half of the intervals, at least


def test_expected_gain_is_that_of_the_linear_range_about_other_unknowns(base: Fit) -> None:
    fit = polished(fit_effects(base, (*base.names, "table_tilt")))
    index = np.arange(*fit.unknowns.slice_of_effect("table_tilt").indices(fit.unknowns.size))
    x = np.array(fit.x)
    x[index] = [2.0, -1.0]
    about = LinearPushes.of(fit.problem, x, fit.end.hessian, fit.problem.prior_at(x)[1])
    without = about.of_unknowns(np.setdiff1d(np.arange(fit.unknowns.size), index)).least_cost()
    linear = LinearPushes.of(fit.problem, fit.x, fit.end.hessian, fit.end.gradient)
    gain = linear.expected_gain(x[: fit.unknowns.size], index)
    assert gain == pytest.approx(without - about.least_cost(), rel=1e-3) and gain > 5.0
    x[index] = 0.0
    assert linear.expected_gain(x[: fit.unknowns.size], index) < 0.0


def test_smallest_visible_size_is_that_of_the_pushes_and_never_negligible(base: Fit) -> None:
    policy = QUICK.policy.selection
    effects = {e.name: e for e in visible_effects(base, policy)}
    tilt = effects["table_tilt"]
    assert 0.002 < tilt.smallest < 0.05
    assert effects["restitution"].smallest == np.inf and not effects["restitution"].is_visible
    assert effects["pose_latency"].smallest >= policy.negligible["s"]


@pytest.mark.long
def test_effect_that_is_larger_than_visible_is_found_in_twins(pushes: list[PushRecord], base: Fit) -> None:
    tilt = next(e for e in visible_effects(base, QUICK.policy.selection) if e.name == "table_tilt")
    proof = prove(pushes, base, replace(tilt, smallest=2.0 * tilt.smallest), EXACT, QUICK, np.random.default_rng(3))
    assert proof.size == pytest.approx(4.0 * tilt.smallest) and proof.outcome in ("named", "left open")


def test_extremes_among_visible_effects_are_worth_a_proof() -> None:
    effects = [VisibleEffect(name, size, 1.0) for name, size in (("a", 0.1), ("b", 0.2), ("c", 0.3), ("d", 0.9), ("e", 2.0))]
    assert [e.name for e in worth_proving(effects)] == ["a", "d", "c"]
    assert worth_proving(effects[-1:]) == [] and [e.name for e in worth_proving(effects[:1])] == ["a"]


def test_self_test_says_what_it_left_out_when_time_is_up(pushes: list[PushRecord]) -> None:
    test = selftest(pushes, QUICK, options=SelfTestOptions(seconds=1.0, maps=3, seed=5))
    assert len(test.tests) == 1 and not test.proofs and len(test.effects) > 15
    assert test.left_out[0] == "2 of 3 objects: no time" and test.left_out[1].startswith("proof of ")
    assert any(text.startswith("Centre of friction x: to ") for text in can_tell(test))
    assert any(text.startswith("Total mass: hardly") for text in cannot_tell(test))
    assert would_help(test)[0].startswith("Weigh the object") and any("restitution" in text for text in would_help(test))
    few = selftest(pushes[:2], QUICK, options=SelfTestOptions(seconds=1.0, maps=1))
    assert not few.effects and few.quantities and "2 of 2 pushes touch" in few.left_out[0]
