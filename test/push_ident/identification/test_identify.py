"""Known maps are recovered from simulated pushes; what the pushes do not determine stays uncertain and is reported as such."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from helpers.diagnosis import NOISE, simulated_pushes, with_correlated_noise
from helpers.objects import hammer, random_records, with_forces, with_frames
from push_ident.errors import InputError
from push_ident.identification.fitting.budget import Budget, Sample
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import NoiseModel, noise_correlation, observe_push, variance_of_mean
from push_ident.identification.predicting.prediction import held_out_errors, predict
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.results.result import Identification
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.scenario import PushScenario
from push_ident.types import PushRecord, SolveStatus

RECORDS = random_records(hammer(0), 12, 0)


def with_late_poses(record: PushRecord, seconds: float) -> PushRecord:
    return replace(record, poses=replace(record.poses, time=record.poses.time + seconds))


@pytest.fixture(scope="module")
def result() -> Identification:
    """Of four noisy pushes."""
    return identify(RECORDS[:4])


def test_four_noisy_pushes_predict_others_within_three_millimetres(result: Identification) -> None:
    assert result.status is SolveStatus.CONVERGED
    uniform, identified = (float(np.mean(held_out_errors(m, RECORDS[4:]))) for m in (result.uniform, result.model))
    assert identified < 3e-3 and identified < 0.5 * uniform


def test_a_fit_that_leaves_more_than_noise_says_so(result: Identification) -> None:
    assert not [note for note in result.notes if "squared residuals" in note]
    late = identify([with_late_poses(record, 0.04) for record in RECORDS[:4]])
    assert late.reduced_chi2 > 1.5
    assert [note for note in late.notes if f"{late.reduced_chi2:.2g} times those of noise" in note]


def test_threads_change_no_bit_of_a_result_and_report_progress_in_order() -> None:
    seen: list[Sample] = []
    one, two = (
        identify(RECORDS[:2], budget=Budget(max_seconds=None), options=FitOptions(threads=n), on_progress=seen.append) for n in (1, 2)
    )
    np.testing.assert_array_equal(one.posterior.covariance, two.posterior.covariance)
    assert [c.log_evidence for c in one.candidates] == [c.log_evidence for c in two.candidates]
    assert [(h.n_simulations, h.cost) for h in one.history] == [(h.n_simulations, h.cost) for h in two.history]
    of_two = seen[len(seen) // 2 :]
    assert [h.cost for h in two.history[-2:]] == [sample.cost for sample in of_two[-2:]]
    assert all(a.cost > b.cost and a.n_simulations <= b.n_simulations for a, b in pairwise(of_two))


def test_end_poses_suffice() -> None:
    ends = identify([with_frames(record, [0, -1]) for record in RECORDS[:6]])
    uniform, identified = (float(np.mean(held_out_errors(m, RECORDS[6:]))) for m in (ends.uniform, ends.model))
    assert identified < 0.6 * uniform


def test_total_mass_is_open_without_a_wrench_and_pinned_with_one_and_a_given_weight_is_kept(result: Identification) -> None:
    truth, without = hammer(0), result.posterior
    assert not without.total_mass_identifiable and without.unknowns.blocks["total_mass"].size == 0
    assert without.total_mass.std > 0.3 * without.total_mass.value
    known_friction = Prior(friction=float(truth.mass @ truth.friction / truth.mass.sum()), friction_std=0.05)
    measured = identify([with_forces(r, truth) for r in RECORDS[:3]], known_friction).posterior
    assert measured.total_mass_identifiable and measured.total_mass.value == pytest.approx(truth.total_mass, rel=0.15)
    weighed = identify(RECORDS[:1], Prior(total_mass=0.6, total_mass_std=0.0)).posterior
    assert weighed.total_mass_identifiable and weighed.model.total_mass == pytest.approx(0.6)


def test_pushes_narrow_predictions_and_leave_single_cells_uncertain(result: Identification) -> None:
    before, after = prior_posterior(RECORDS[0].shape), result.posterior
    relative, relative_before = (p.mass_friction_std / (p.model.mass * p.model.friction) for p in (after, before))
    assert np.median(relative) < 0.9 * np.median(relative_before)
    # The motion of a body determines sums over its cells, no single one, and few combinations of cells.
    assert np.all(relative > 0.5 * relative_before)
    variance = np.linalg.eigvalsh(after.covariance)
    assert np.sum(variance < 0.1 * np.median(variance)) < 0.2 * len(variance)
    scenario = PushScenario(RECORDS[0].pusher, RECORDS[0].poses.pose[0], RECORDS[0].poses.time)
    assert predict(after, scenario).cell_error_std < 0.5 * predict(before, scenario).cell_error_std


def test_pushes_that_never_touch_give_a_status_and_the_prior() -> None:
    poses = RECORDS[0].poses
    away = identify([replace(RECORDS[0], poses=replace(poses, pose=poses.pose * 0 + [1.0, 1.0, 0.0]))])
    assert away.status is SolveStatus.NO_CONTACT
    assert away.model.mass == pytest.approx(away.uniform.mass, rel=1e-3)


def test_no_push_and_an_unknown_method_are_refused() -> None:
    with pytest.raises(InputError, match="no push"):
        identify([])
    with pytest.raises(InputError, match="gauss_newton"):
        identify(RECORDS[:1], method="magic")


# --- what is observed of a push


def test_errors_of_poses_are_as_correlated_as_frames_at_rest_show() -> None:
    records = with_correlated_noise(simulated_pushes(3, 1, noise=0.01 * NOISE), 0.9, 1)
    records = [replace(r, poses=replace(r.poses, covariance=4e4 * r.poses.covariance / 5.0)) for r in records]
    correlation = noise_correlation(records)
    assert correlation == pytest.approx(0.9, abs=0.08)
    found = identify(records).posterior
    told = identify(records, options=FitOptions(noise=NoiseModel(correlation=correlation))).posterior
    np.testing.assert_array_equal(found.covariance, told.covariance)


def test_correlation_of_short_rests_is_not_estimated_too_large() -> None:
    """Four fifths of the variance correlate; of 40 pushes the correlation is known to 0.02."""
    records = [r for seed in range(4) for r in with_correlated_noise(simulated_pushes(10, seed), 0.5, seed)]
    assert noise_correlation(records) == pytest.approx(0.4, abs=0.03)


@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_correlation_of_noise_is_measured_at_rest_and_makes_means_less_precise(rho: float) -> None:
    records = with_correlated_noise(simulated_pushes(14, 1), rho, 2)
    measured = noise_correlation(records)
    assert measured == pytest.approx(rho, abs=0.2)
    correlated, white = (observe_push(records[0], noise) for noise in (NoiseModel(correlation=max(measured, 0.0)), NoiseModel()))
    ratio = correlated.last_covariance[0, 0] / white.last_covariance[0, 0]
    assert (1.5 < ratio < 3.0) if rho else ratio == pytest.approx(1.0, abs=0.35)


def test_frames_at_rest_are_one_pose_that_a_single_wrong_one_does_not_move() -> None:
    record = simulated_pushes(1, 1)[0]
    observed, pose = observe_push(record), record.poses.pose.copy()
    assert len(observed.time) <= 12 and np.linalg.inv(observed.whitening[0])[0, 0] < 0.6e-3
    pose[2, 2] += np.pi
    spoilt = observe_push(replace(record, poses=replace(record.poses, pose=pose)))
    assert np.abs(spoilt.pose[0] - observed.pose[0]).max() < 3e-3


@pytest.mark.parametrize(("n", "correlation"), [(1, 0.7), (6, 0.5), (40, 0.9), (8, 0.0)])
def test_variance_of_a_mean_is_that_of_all_pairs(n: int, correlation: float) -> None:
    pairs = correlation ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    assert variance_of_mean(n, correlation) == pytest.approx(pairs.mean())
