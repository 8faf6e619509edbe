"""Known maps are recovered from simulated pushes; what the pushes do not determine stays uncertain and is reported as such."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from helpers.diagnosis import NOISE, simulated_pushes, with_correlated_noise
from helpers.objects import hammer, random_records
from push_ident.errors import InputError
from push_ident.identification.fitting.budget import Budget, Sample
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import NoiseModel, noise_correlation, observe_push
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.predicting.prediction import held_out_errors, predict
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import PoseTrack, PushRecord, SolveStatus, WrenchTrack


@pytest.mark.parametrize("seed", [0, 1, pytest.param(2, marks=pytest.mark.long)])
def test_four_noisy_pushes_predict_others_within_three_millimetres(seed: int) -> None:
    truth = hammer(seed)
    records = random_records(truth, 12, seed)
    result = identify(records[:4])
    assert result.status is SolveStatus.CONVERGED
    uniform, identified = (float(np.mean(held_out_errors(m, records[4:]))) for m in (result.uniform, result.model))
    assert identified < 3e-3
    assert identified < 0.5 * uniform


def test_threads_change_no_bit_of_a_result() -> None:
    records = random_records(hammer(0), 2, 0)
    budget = Budget(max_seconds=None)
    one, two = (identify(records, budget=budget, options=FitOptions(threads=n)) for n in (1, 2))
    for attribute in ("z", "covariance"):
        np.testing.assert_array_equal(getattr(one.posterior, attribute), getattr(two.posterior, attribute))
    assert [c.log_evidence for c in one.candidates] == [c.log_evidence for c in two.candidates]
    assert one.n_simulations == two.n_simulations and one.status is two.status
    assert [(h.n_simulations, h.cost) for h in one.history] == [(h.n_simulations, h.cost) for h in two.history]


def test_progress_of_threads_is_reported_in_order() -> None:
    seen: list[Sample] = []
    result = identify(random_records(hammer(0), 1, 0), options=FitOptions(threads=2), on_progress=seen.append)
    assert [h.cost for h in result.history[-2:]] == [sample.cost for sample in seen[-2:]]
    assert all(a.cost > b.cost and a.n_simulations <= b.n_simulations for a, b in pairwise(seen))


def test_errors_of_measured_forces_do_not_change_the_errors_of_pushes() -> None:
    records = random_records(hammer(1), 2, 1)
    plain = held_out_errors(hammer(1), records)
    np.testing.assert_array_equal(held_out_errors(hammer(1), records, effects={"force_offset": [0.5, 0.2]}), plain)
    observed = [observe_push(record) for record in records[::-1]]
    assert not np.array_equal(held_out_errors(hammer(1), records, observed=observed), plain)


def test_end_poses_suffice() -> None:
    truth = hammer(4)
    records = [_ends_only(r) for r in random_records(truth, 14, 4)]
    result = identify(records[:8])
    uniform, identified = (float(np.mean(held_out_errors(m, records[8:]))) for m in (result.uniform, result.model))
    assert identified < 0.6 * uniform


def test_jacobian_of_the_fit_equals_central_differences() -> None:
    records = random_records(hammer(1), 2, 1)
    problem = FitProblem(records, UnknownsSpec.of(records[0].shape, Prior()))
    x = 0.3 * np.random.default_rng(0).normal(size=problem.size)
    gradient = problem.evaluate(x).gradient
    for i in [0, 5, 41, 60, *range(problem.unknowns.size - 2, problem.size)]:
        step = np.zeros(problem.size)
        step[i] = 1e-5
        difference = (problem.evaluate(x + step).cost - problem.evaluate(x - step).cost) / 2e-5
        assert gradient[i] == pytest.approx(difference, rel=1e-3, abs=1e-2)


def test_total_mass_is_open_without_a_wrench_and_pinned_with_one() -> None:
    truth = hammer(2)
    records = random_records(truth, 4, 2)
    without = identify(records).posterior
    assert not without.total_mass_identifiable
    assert without.total_mass.std > 0.3 * without.total_mass.value
    measured = [_with_wrench(r, truth) for r in records]
    known_friction = Prior(friction=float(truth.mass @ truth.friction / truth.mass.sum()), friction_std=0.05)
    posterior = identify(measured, known_friction).posterior
    assert posterior.total_mass_identifiable
    assert posterior.total_mass.value == pytest.approx(truth.total_mass, rel=0.15)


def test_given_weight_is_kept() -> None:
    posterior = identify(random_records(hammer(2), 2, 2), Prior(total_mass=0.6, total_mass_std=0.0)).posterior
    assert posterior.total_mass_identifiable
    assert posterior.model.total_mass == pytest.approx(0.6)


def test_pushes_narrow_predictions_and_leave_single_cells_uncertain() -> None:
    records = random_records(hammer(6), 6, 6)
    before = prior_posterior(records[0].shape)
    after = identify(records).posterior
    relative = after.mass_friction_std / (after.model.mass * after.model.friction)
    relative_before = before.mass_friction_std / (before.model.mass * before.model.friction)
    assert np.median(relative) < 0.9 * np.median(relative_before)
    # The motion of a body determines sums over its cells, no single one, and few combinations of cells.
    assert np.all(relative > 0.5 * relative_before)
    variance = np.linalg.eigvalsh(after.covariance)
    assert np.sum(variance < 0.1 * np.median(variance)) < 0.2 * len(variance)
    scenario = PushScenario(records[0].pusher, records[0].poses.pose[0], records[0].poses.time)
    spread = predict(after, scenario)
    wide = predict(before, scenario)
    assert spread.cell_error_std < 0.5 * wide.cell_error_std


def test_pushes_that_never_touch_give_a_status_and_the_prior() -> None:
    record = random_records(hammer(), 1, 0)[0]
    away = PushRecord(
        "1", record.shape, PoseTrack(record.poses.time, record.poses.pose * 0 + [1.0, 1.0, 0.0], record.poses.covariance), record.pusher
    )
    result = identify([away])
    assert result.status is SolveStatus.NO_CONTACT
    assert result.model.mass == pytest.approx(result.uniform.mass, rel=1e-3)


def test_no_push_is_refused() -> None:
    with pytest.raises(InputError, match="no push"):
        identify([])


def test_unknown_method_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(InputError, match="gauss_newton"):
        identify(random_records(hammer(), 1, 0), method="magic")


def test_observation_condenses_rest_frames() -> None:
    record = random_records(hammer(1), 1, 7)[0]
    observation = observe_push(record)
    assert len(observation.time) <= 12
    assert np.linalg.inv(observation.whitening[0])[0, 0] < 0.6e-3


def _ends_only(record: PushRecord) -> PushRecord:
    poses = record.poses
    return PushRecord("1", record.shape, PoseTrack(poses.time[[0, -1]], poses.pose[[0, -1]], poses.covariance[[0, -1]]), record.pusher)


def _with_wrench(record: PushRecord, truth) -> PushRecord:  # type: ignore[no-untyped-def]
    motion = simulate(truth, PushScenario(record.pusher, record.poses.pose[0], record.pusher.time[-1:]))
    force = np.column_stack([np.interp(record.pusher.time, motion.force_time, motion.force[:, a]) for a in (0, 1)])
    return PushRecord("1", record.shape, record.poses, record.pusher, WrenchTrack(record.pusher.time, force))


def test_errors_of_poses_are_as_correlated_as_frames_at_rest_show() -> None:
    records = with_correlated_noise(simulated_pushes(3, 1, noise=0.01 * NOISE), 0.9, 1)
    records = [replace(r, poses=replace(r.poses, covariance=4e4 * r.poses.covariance / 5.0)) for r in records]
    correlation = noise_correlation(records)
    assert correlation == pytest.approx(0.9, abs=0.08)
    found = identify(records).posterior
    told = identify(records, options=FitOptions(noise=NoiseModel(correlation=correlation))).posterior
    np.testing.assert_array_equal(found.covariance, told.covariance)
    online = OnlineIdentifier(OnlineIdentifier.new(records[0].shape))
    for record in records:
        online.add(record)
    assert np.median(online.posterior.mass_friction_std / found.mass_friction_std) == pytest.approx(1.0, abs=0.05)
