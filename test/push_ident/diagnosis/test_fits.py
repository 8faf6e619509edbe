"""Maps fitted together with effects, the start from the fits of fewer pushes, and the errors on held-out pushes."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from helpers.diagnosis import account_of_parts, gap_of, simulated_pushes
from push_ident.diagnosis.earlier import EarlierFits
from push_ident.diagnosis.fits import fit_base, fit_effects, without_pushes
from push_ident.diagnosis.held_out import HeldOutFits, folds_of, measure_gap, noise_errors
from push_ident.diagnosis.policy import ValidationPolicy
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.fitting.budget import Meter
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.levenberg_marquardt import minimise
from push_ident.physics.scenario import PushScenario
from push_ident.types import PushRecord, SolveStatus

SETTINGS, N = DiagnosisSettings(), 5


@pytest.fixture(scope="module")
def records() -> list[PushRecord]:
    return simulated_pushes(N + 1, 1)


@pytest.fixture(scope="module")
def base(records: list[PushRecord]) -> Fit:
    """Of all pushes but the last one."""
    return fit_base(records[:N], SETTINGS)


@pytest.fixture(scope="module")
def held_out(base: Fit) -> HeldOutFits:
    fits = HeldOutFits()
    fits.of([base], folds_of(N, N))
    return fits


def test_no_clock_decides_how_far_a_diagnosis_is_fitted(records: list[PushRecord], base: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine, or one that compiles its kernels first, takes longer and reports the same."""
    monkeypatch.setattr(Meter, "seconds", property(lambda meter: 1e6))
    after = fit_base(records[:N], SETTINGS)
    assert after.status is base.status and np.array_equal(after.x, base.x)
    assert not base.problem.meter.spent and not base.problem.without([0]).meter.spent


def test_pushes_simulated_in_parallel_give_the_same_fit_to_the_last_bit(base: Fit) -> None:
    parallel, serial = base.problem, copy(base.problem)
    serial.run_all = map
    x = 0.1 * np.random.default_rng(0).normal(size=parallel.size)
    for result in (lambda problem: problem.evaluate(x).hessian, lambda problem: problem.step_errors(x), lambda problem: problem.cost(x)):
        np.testing.assert_array_equal(result(parallel), result(serial))


def test_fit_that_cannot_reach_the_target_ends_early(base: Fit) -> None:
    problem = base.problem
    _, full, status = minimise(problem.of(problem.unknowns), np.zeros(problem.size))
    (_, early, given_up), (_, near, _) = (
        minimise(problem.of(problem.unknowns), np.zeros(problem.size), needed_cost=full.cost + more) for more in (-1e3, 1.0)
    )
    assert (status, given_up) == (SolveStatus.CONVERGED, SolveStatus.OUT_OF_REACH)
    assert early.cost > full.cost == near.cost


def test_push_held_out_is_not_part_of_the_fit(base: Fit) -> None:
    rest = without_pushes(base, [2])
    assert [record.source for record in rest.problem.records] == ["push 0", "push 1", "push 3", "push 4"]
    # As good as a fit that starts from nothing.
    assert rest.end.cost < minimise(rest.problem, np.zeros(rest.problem.size))[1].cost + 0.5


def test_fits_with_one_more_push_start_from_those_before_take_less_and_end_as_well(
    records: list[PushRecord], base: Fit, held_out: HeldOutFits
) -> None:
    earlier = EarlierFits.of(records, [base], held_out.fits)
    cold, warm = fit_base(records, SETTINGS), fit_base(records, SETTINGS, earlier)
    assert warm.log_evidence == pytest.approx(cold.log_evidence, abs=1.0)
    fits = [HeldOutFits(), HeldOutFits(earlier)]
    first, again = (each.of([cold], folds_of(N + 1, N + 1))[0] for each in fits)
    n_first, n_again = (sum(fit.problem.meter.n_simulations for fit, _ in each.fits) for each in fits)
    assert n_again < 0.8 * n_first
    np.testing.assert_allclose([each.log_density for each in again], [each.log_density for each in first], atol=1.0)
    scale, n_z = base.unknowns.amplitude_unit(base.amplitude / warm.amplitude), warm.unknowns.size
    without = {fold: fit for fit, fold in held_out.fits}
    started = np.r_[without[2,].z * scale, without[2,].x[n_z:], np.zeros(warm.problem.unknowns_of_push)]
    np.testing.assert_array_equal(earlier.start(warm, [2]), started)
    # All earlier pushes are outside the fold of the new one.
    np.testing.assert_array_equal(earlier.start(warm, [N]), np.r_[base.z * scale, base.x[n_z:]])
    assert earlier.start(warm, [2, 3]) is None
    moved = replace(records[0], pusher=replace(records[0].pusher, position=records[0].pusher.position + 1e-4))
    for others in ([moved, *records[1:]], records[1:], records[: N - 1]):
        assert EarlierFits.of(others, [base], held_out.fits).n_pushes == 0


# --- errors on held-out pushes, before and after effects are added, and the account of them


def test_gap_is_measured_at_every_stage() -> None:
    policy = ValidationPolicy()
    base = fit_base(simulated_pushes(3, 1), SETTINGS)
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


def test_noise_of_a_push_is_no_more_than_its_object_may_move_by_errors_of_the_first_pose(base: Fit) -> None:
    """A pusher that just touches a corner, or does not: the end of the push jumps by 20 mm over a hair's breadth of the first pose."""

    class Grazing:
        def simulate(self, scenario: PushScenario, **_: object) -> SimpleNamespace:
            jump = 0.01 * np.tanh(1e5 * (scenario.pose_object_in_table[0] - first[0]))
            return SimpleNamespace(pose=scenario.pose_object_in_table + np.outer(np.ones(len(scenario.time)), [jump, 0.0, 0.0]))

    first = base.problem.first_pose(base.x, 0)
    grazing = SimpleNamespace(problem=base.problem, mechanics=Grazing(), x=base.x, z=base.z)
    assert noise_errors(base, 64)[0].max() < 0.003
    assert 0.003 < noise_errors(cast(Any, grazing), 64)[0][0] < 0.012


def test_shrink_is_the_share_of_the_gap_above_noise_that_is_closed_and_not_a_number_without_one() -> None:
    gap = gap_of([5e-3, 4.5e-3, 5.5e-3, 5e-3], [2e-3] * 4, 1e-3)
    assert gap.is_above_noise and gap.shrink == pytest.approx(0.75) and gap.shrink_interval[0] < 0.75 < gap.shrink_interval[1]
    scattered = gap_of([1e-3, 6e-3, 0.2e-3, 0.4e-3], [1e-3] * 4, 1e-3)
    assert not scattered.is_above_noise and np.isnan(scattered.shrink) and np.isnan(scattered.shrink_interval).all()
    # Effects are worse only where no error shrinks and the density does not certainly grow.
    better = gap_of([3e-3, 3e-3], [2e-3, 2e-3], 1e-3, log_density_gain=-1.0)
    assert not better.is_worse
    worse = replace(better, after=np.array([4e-3, 4e-3]))
    assert worse.is_worse and not replace(worse, log_density_gain=np.ones(2)).is_worse
    assert replace(worse, log_density_gain=np.array([5.0, -4.0])).is_worse


def test_effects_added_in_stages_have_a_part_each() -> None:
    gap = replace(gap_of([5e-3] * 4, [1e-3] * 4, 1e-3, names=("wear", "tether", "pusher_lag")), stages={"wear": np.full(4, 3e-3)})
    account = account_of_parts(gap, 1e-3, 0.0, 0.0)
    assert {part.name: part.mean for part in account.effects} == pytest.approx({"wear": 2e-3, "tether and pusher_lag": 2e-3})
    assert account["unexplained"].mean == pytest.approx(0.0)


def test_unexplained_is_what_exceeds_the_errors_that_the_model_makes_expect() -> None:
    account = account_of_parts(gap_of([2e-3, 2.1e-3] * 3, [2e-3, 2.1e-3] * 3, 1e-3), 1e-3, 5e-4, 1e-4)
    assert account["unexplained"].interval == pytest.approx((2.05e-3 - 1.1 * 1.6e-3, 2.05e-3 - 0.9 * 1.6e-3))
    shared = replace(account, expected=replace(account.expected, mean_interval=(1e-3, 3e-3)))
    assert account.is_unexplained and not shared.is_unexplained and shared.is_within_chance
    assert shared["noise"] == account["noise"]
