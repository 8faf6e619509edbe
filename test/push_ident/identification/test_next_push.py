"""The next push is the one with the most information; one without information is never chosen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, hammer_shape, random_records, record_of
from push_ident.errors import InputError
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.identify import identify
from push_ident.identification.predicting.next_push import (
    PlannedPush,
    PoseSensor,
    RankedPushes,
    RankingOptions,
    UnwantedError,
    candidate_pushes,
    imagine_push,
    rank_pushes,
    reference_pushes,
)
from push_ident.identification.results.posterior import ModelPosterior, prior_posterior
from push_ident.identification.unknowns.mechanics import mechanics_at, uniform_model
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.pushing.push import PushSettings
from push_ident.pushing.sampling import check_push
from push_ident.types import PoseTrack, PusherPath, PushRecord, SolveStatus

SHAPE = hammer_shape()
SETTINGS = PushSettings()
REFERENCE = reference_pushes(SHAPE, np.random.default_rng(0), 12)


def _candidates(n: int, seed: int) -> list[PlannedPush]:
    return candidate_pushes(SHAPE, np.zeros(3), np.random.default_rng(seed), n, SETTINGS)


def _rank(posterior: ModelPosterior, candidates: list[PlannedPush], n_draws: int = 2, **given: object) -> RankedPushes:
    options = RankingOptions(n_draws=n_draws, **given)  # type: ignore[arg-type]
    return rank_pushes(posterior, candidates, reference=REFERENCE, rng=np.random.default_rng(0), options=options)


@pytest.mark.parametrize("seed", range(4))
def test_repeated_push_gives_less_information_than_others(seed: int) -> None:
    first, *others = _candidates(12, seed)
    seen = record_of(hammer(seed), first.pusher, np.zeros(3), np.random.default_rng(seed))
    before = _rank(prior_posterior(SHAPE), [first], n_draws=0).values[0]
    values = {id(v.push): v for v in _rank(identify([seen]).posterior, [first, *others], n_draws=0).values}
    again, new = values[id(first)], [values[id(push)] for push in others]
    assert again.information < 0.5 * before.information
    assert again.information < np.median([v.information for v in new])
    assert again.error_after > np.median([v.error_after for v in new])


def test_sensor_slower_than_a_push_sees_both_its_ends() -> None:
    push = _candidates(1, 0)[0]
    mechanics = mechanics_at(prior_posterior(SHAPE).unknowns, prior_posterior(SHAPE).z)
    record, status = imagine_push(mechanics, push, sensor=PoseSensor(rate=0.1))
    assert status is SolveStatus.CONVERGED and record is not None
    np.testing.assert_array_equal(record.poses.time, push.pusher.time[[0, -1]])


def test_planned_pusher_keeps_its_acceleration_and_goes_as_far() -> None:
    at_once, ramped = (
        candidate_pushes(SHAPE, np.zeros(3), np.random.default_rng(0), 5, SETTINGS, acceleration=acceleration)
        for acceleration in (np.inf, 2.0)
    )
    for one, other in zip(at_once, ramped, strict=True):
        np.testing.assert_allclose(other.pusher.position[[0, -1]], one.pusher.position[[0, -1]], atol=1e-12)
        assert other.plan is not None
        velocity = np.linalg.norm(np.diff(other.pusher.position, axis=0), axis=1) / np.diff(other.pusher.time)
        assert velocity.max() == pytest.approx(other.plan.speed)
        assert np.abs(np.diff(velocity) / np.diff(other.pusher.time)[1:]).max() < 2.0 + 1e-9
        # As long at full speed as if it had that at once, less a ramp.
        assert np.sum(velocity > 0.999 * other.plan.speed) * 0.01 == pytest.approx(
            (SETTINGS.clearance + other.plan.distance) / other.plan.speed - other.plan.speed / 2.0, abs=0.021
        )


def test_no_push_takes_knowledge_away() -> None:
    for posterior in (prior_posterior(SHAPE), identify(random_records(hammer(1), 2, 1)).posterior):
        ranked = _rank(posterior, _candidates(10, 1))
        for value in ranked.values:
            assert value.information >= 0
            assert value.error_after <= ranked.error_before * (1 + 1e-9)
            assert np.linalg.eigvalsh(posterior.covariance - value.covariance)[0] > -1e-9


def test_covariance_expected_is_that_of_the_fit() -> None:
    posterior, push, settings = prior_posterior(SHAPE), _candidates(1, 2)[0], SimulationSettings(step=1 / 240)
    sensor = PoseSensor()
    time = np.arange(push.pusher.time[0], push.pusher.time[-1], 1 / sensor.rate)
    motion = simulate(uniform_model(SHAPE), PushScenario(push.pusher, push.pose_object_in_table, time), settings=settings)
    record = PushRecord("o1", SHAPE, PoseTrack(time, motion.pose, np.broadcast_to(sensor.covariance, (len(time), 3, 3))), push.pusher)
    problem = FitProblem([record], posterior.unknowns, settings=settings)
    n = posterior.unknowns.size
    prior = np.diag(problem.unit_prior)
    # The fit weighs frames by how well they agree; on average over the noise the weight is one.
    weight = problem.weigh(np.zeros((1, 3)))[1][0]
    fitted = np.linalg.inv(prior + (problem.evaluate(np.zeros(problem.size)).hessian - prior) / weight)[:n, :n]
    value = _rank(posterior, [push], numerics=settings).values[0]
    assert value.covariance == pytest.approx(fitted, abs=1e-8)


def test_noisier_sensor_gives_less_information() -> None:
    candidates = _candidates(3, 3)
    posterior = prior_posterior(SHAPE)
    sharp = PoseSensor()
    blurred = replace(sharp, covariance=25 * sharp.covariance)
    for push in candidates:
        clear, dim = (_rank(posterior, [push], sensor=sensor).values[0] for sensor in (sharp, blurred))
        assert dim.information < clear.information
        assert dim.error_after > clear.error_after


def test_pushes_that_miss_or_fail_come_last_with_no_information() -> None:
    good = _candidates(2, 4)
    path = good[0].pusher
    miss = replace(good[0], pusher=PusherPath(path.time, path.position + 1.0, path.radius))
    broken = replace(good[0], pusher=PusherPath(path.time, path.position * 1e200, path.radius))
    ranked = _rank(prior_posterior(SHAPE), [miss, broken, *good])
    assert [v.status for v in ranked.values[:2]] == [SolveStatus.CONVERGED] * 2
    assert any(ranked.best is push for push in good)
    for value in ranked.values[2:]:
        assert value.status in (SolveStatus.NO_CONTACT, SolveStatus.SIMULATION_FAILED)
        assert value.information == 0
        assert value.error_after == pytest.approx(ranked.error_before)
    assert _rank(prior_posterior(SHAPE), [miss]).best is None


def test_order_follows_the_expected_error_and_the_seed() -> None:
    candidates, posterior = _candidates(8, 5), prior_posterior(SHAPE)
    by_error = _rank(posterior, candidates)
    assert np.all(np.diff([v.error_after for v in by_error.values]) >= 0)
    assert [v.error_after for v in _rank(posterior, candidates).values] == [v.error_after for v in by_error.values]


def test_candidates_are_safe_and_touch_the_object() -> None:
    outline = SHAPE.outline
    for push in _candidates(20, 6):
        assert push.plan is not None
        check_push(push.plan, outline, SETTINGS)
        motion = simulate(uniform_model(SHAPE), PushScenario(push.pusher, push.pose_object_in_table, push.pusher.time[-1:]))
        assert motion.status is SolveStatus.CONVERGED


def test_nothing_to_choose_from_or_to_predict_is_refused() -> None:
    with pytest.raises(InputError, match="no candidate"):
        _rank(prior_posterior(SHAPE), [])
    with pytest.raises(InputError, match="reference"):
        rank_pushes(prior_posterior(SHAPE), _candidates(1, 7), reference=[], rng=np.random.default_rng(0))


def test_ranking_stops_as_soon_as_it_is_unwanted() -> None:
    answers = iter([True] * len(REFERENCE) + [True, True, False])
    with pytest.raises(UnwantedError):
        rank_pushes(
            prior_posterior(SHAPE), _candidates(6, 3), reference=REFERENCE, rng=np.random.default_rng(0), options=RankingOptions(n_draws=0),
            is_wanted=lambda: next(answers),
        )  # fmt: skip
    assert next(answers, None) is None
