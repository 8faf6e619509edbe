"""Maps fitted together with effects: start, end, what is left out, and the start from the fits of fewer pushes."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.earlier import EarlierFits
from push_ident.diagnosis.fits import fit_base, without_pushes
from push_ident.diagnosis.held_out import HeldOutFits, folds_of
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.fitting.budget import Meter
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.levenberg_marquardt import minimise
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
    assert warm.log_evidence == pytest.approx(cold.log_evidence, abs=0.5)
    fits = [HeldOutFits(), HeldOutFits(earlier)]
    first, again = (each.of([cold], folds_of(N + 1, N + 1))[0] for each in fits)
    n_first, n_again = (sum(fit.problem.meter.n_simulations for fit, _ in each.fits) for each in fits)
    assert n_again < 0.8 * n_first
    np.testing.assert_allclose([each.log_density for each in again], [each.log_density for each in first], atol=0.7)
    scale = base.unknowns.amplitude_unit(base.amplitude / warm.amplitude)
    without = {fold: fit for fit, fold in held_out.fits}
    n_z = warm.unknowns.size
    np.testing.assert_array_equal(earlier.start(warm, [2]), np.r_[without[2,].z * scale, without[2,].x[n_z:], np.zeros(3)])
    # All earlier pushes are outside the fold of the new one.
    np.testing.assert_array_equal(earlier.start(warm, [N]), np.r_[base.z * scale, base.x[n_z:]])
    assert earlier.start(warm, [2, 3]) is None
    moved = replace(records[0], pusher=replace(records[0].pusher, position=records[0].pusher.position + 1e-4))
    for others in ([moved, *records[1:]], records[1:], records[: N - 1]):
        assert EarlierFits.of(others, [base], held_out.fits).n_pushes == 0
