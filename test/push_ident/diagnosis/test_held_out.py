"""Errors on held-out pushes, before and after effects are added, and the account of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from helpers.diagnosis import account_of_parts, gap_of, simulated_pushes
from push_ident.diagnosis.fits import fit_base, fit_effects
from push_ident.diagnosis.held_out import HeldOutFits, measure_gap, noise_errors
from push_ident.diagnosis.policy import ValidationPolicy
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.physics.scenario import PushScenario


def test_gap_is_measured_at_every_stage() -> None:
    policy = ValidationPolicy()
    base = fit_base(simulated_pushes(3, 1), DiagnosisSettings())
    fit = fit_effects(base, ("table_tilt",))
    gap = measure_gap(base, fit, policy, between={"itself": fit})
    np.testing.assert_array_equal(gap.stages["itself"], gap.after)
    nothing = measure_gap(base, base, policy, between={"itself": fit})
    assert gap.before.shape == gap.after.shape == (3,) and nothing.stages == {}
    log_bayes_factor = fit.log_evidence - base.log_evidence
    np.testing.assert_allclose(gap.log_bayes_factor_without, [log_bayes_factor - gap.log_density_gain, np.zeros(3)], atol=1e-9)
    assert gap.folds == ((0,), (1,), (2,)) and nothing.log_bayes_factor_without.shape == (0, 3)
    # A fit without some pushes is made once.
    known = HeldOutFits()
    first, again = (measure_gap(base, fit, policy, held_out=known) for _ in range(2))
    assert all(one is other for one, other in zip(first.fits, again.fits, strict=True))
    assert all(one is not other for one, other in zip(first.fits, gap.fits, strict=True))
    np.testing.assert_array_equal(again.before, gap.before)
    pairs = measure_gap(base, base, ValidationPolicy(max_folds=2))
    assert pairs.folds == ((0, 2), (1,)) and pairs.before.shape == (3,)


def test_noise_of_a_push_is_no_more_than_its_object_may_move_by_errors_of_the_first_pose() -> None:
    """A pusher that just touches a corner, or does not: the end of the push jumps by 20 mm over a hair's breadth of the first pose."""
    base = fit_base(simulated_pushes(2, 1), DiagnosisSettings())
    usual = noise_errors(base, 64)

    class Grazing:
        def simulate(self, scenario: PushScenario, **_: object) -> SimpleNamespace:
            jump = 0.01 * np.tanh(1e5 * (scenario.pose_object_in_table[0] - first[0]))
            return SimpleNamespace(pose=scenario.pose_object_in_table[None] + [jump, 0.0, 0.0])

    first = base.problem.first_pose(base.x, 0)
    grazing = SimpleNamespace(problem=base.problem, mechanics=Grazing(), x=base.x, z=base.z)
    assert usual.max() < 0.003
    assert 0.003 < noise_errors(cast(Any, grazing), 64)[0] < 0.012


def test_shrink_is_the_share_of_the_gap_above_noise_that_is_closed_and_not_a_number_without_one() -> None:
    gap = gap_of([5e-3, 4.5e-3, 5.5e-3, 5e-3], [2e-3] * 4, 1e-3)
    assert gap.is_above_noise and gap.shrink == pytest.approx(0.75)
    low, high = gap.shrink_interval
    assert low < 0.75 < high
    scattered = gap_of([1e-3, 6e-3, 0.2e-3, 0.4e-3], [1e-3] * 4, 1e-3)
    assert not scattered.is_above_noise and np.isnan(scattered.shrink) and np.isnan(scattered.shrink_interval).all()
    # Effects are worse only where neither error nor density improves.
    better = gap_of([3e-3, 3e-3], [2e-3, 2e-3], 1e-3, log_density_gain=-1.0)
    assert not better.is_worse
    worse = replace(better, after=np.array([4e-3, 4e-3]))
    assert worse.is_worse and not replace(worse, log_density_gain=np.ones(2)).is_worse


def test_effects_added_in_stages_have_a_part_each() -> None:
    gap = replace(gap_of([5e-3] * 4, [1e-3] * 4, 1e-3, names=("wear", "tether", "pusher_lag")), stages={"wear": np.full(4, 3e-3)})
    account = account_of_parts(gap, 1e-3, 0.0, 0.0)
    assert {part.name: part.mean for part in account.effects} == pytest.approx({"wear": 2e-3, "tether and pusher_lag": 2e-3})
    assert account["unexplained"].mean == pytest.approx(0.0)


def test_error_that_all_pushes_share_widens_the_interval_of_the_unexplained_part() -> None:
    account = account_of_parts(gap_of([2e-3, 2.1e-3] * 3, [2e-3, 2.1e-3] * 3, 1e-3), 1e-3, 5e-4, 1e-4)
    shared = replace(account, expected=replace(account.expected, shared_std=1e-3))
    assert account.is_unexplained and not shared.is_unexplained and shared.is_within_chance
    assert shared["noise"] == account["noise"]
