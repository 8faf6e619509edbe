"""The next push is the one after which others are predicted best; one without information is never chosen."""

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
)  # fmt: skip
from push_ident.identification.results.posterior import ModelPosterior, prior_posterior
from push_ident.identification.unknowns.mechanics import uniform_model
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.pushing.push import PushSettings
from push_ident.pushing.sampling import check_push
from push_ident.types import PoseTrack, PusherPath, PushRecord, SolveStatus

SHAPE = hammer_shape()
SETTINGS = PushSettings()
REFERENCE = reference_pushes(SHAPE, np.random.default_rng(0), 12)
PRIOR = prior_posterior(SHAPE)


def candidates_of(n: int, seed: int, acceleration: float = np.inf) -> list[PlannedPush]:
    return candidate_pushes(SHAPE, np.zeros(3), np.random.default_rng(seed), n, SETTINGS, acceleration=acceleration)


def rank(posterior: ModelPosterior, candidates: list[PlannedPush], n_draws: int = 2, **given: object) -> RankedPushes:
    options = RankingOptions(n_draws=n_draws, **given)  # type: ignore[arg-type]
    return rank_pushes(posterior, candidates, reference=REFERENCE, rng=np.random.default_rng(0), options=options)


def test_chosen_pushes_make_predictions_certain_sooner_than_random_ones() -> None:
    """By the expected cell error after three pushes."""
    left = {}
    for chooses in (True, False):
        records, posterior = [], PRIOR
        for k in range(3):
            candidates = candidates_of(12, 10 + k)
            push = rank(posterior, candidates, n_draws=0).best if chooses else candidates[0]
            assert push is not None
            records.append(record_of(hammer(1), push.pusher, np.zeros(3), np.random.default_rng(k)))
            posterior = identify(records).posterior
        left[chooses] = rank(posterior, candidates[:1], n_draws=0).error_before
    assert left[True] < 0.7 * left[False], left


def test_planned_pusher_keeps_its_acceleration_and_goes_as_far() -> None:
    for one, other in zip(candidates_of(3, 0), candidates_of(3, 0, acceleration=2.0), strict=True):
        np.testing.assert_allclose(other.pusher.position[[0, -1]], one.pusher.position[[0, -1]], atol=1e-12)
        assert other.plan is not None
        velocity = np.linalg.norm(np.diff(other.pusher.position, axis=0), axis=1) / np.diff(other.pusher.time)
        assert velocity.max() == pytest.approx(other.plan.speed)
        assert np.abs(np.diff(velocity) / np.diff(other.pusher.time)[1:]).max() < 2.0 + 1e-9


def test_no_push_takes_knowledge_away_and_the_order_is_that_of_the_expected_errors() -> None:
    posterior, candidates = identify(random_records(hammer(1), 2, 1)).posterior, candidates_of(8, 1)
    ranked, again = (rank(posterior, candidates) for _ in range(2))
    errors = [value.error_after for value in ranked.values]
    assert errors == sorted(errors) and errors[-1] <= ranked.error_before * (1 + 1e-9)
    assert all(np.linalg.eigvalsh(posterior.covariance - value.covariance)[0] > -1e-9 for value in ranked.values)
    assert errors == [value.error_after for value in again.values]


def test_covariance_expected_is_that_of_the_fit() -> None:
    push, settings, sensor = candidates_of(1, 2)[0], SimulationSettings(step=1 / 240), PoseSensor()
    time = np.arange(push.pusher.time[0], push.pusher.time[-1], 1 / sensor.rate)
    motion = simulate(uniform_model(SHAPE), PushScenario(push.pusher, push.pose_object_in_table, time), settings=settings)
    record = PushRecord("o1", SHAPE, PoseTrack(time, motion.pose, np.broadcast_to(sensor.covariance, (len(time), 3, 3))), push.pusher)
    problem, n = FitProblem([record], PRIOR.unknowns, settings=settings), PRIOR.unknowns.size
    prior = np.diag(problem.unit_prior)
    # The fit weighs frames by how well they agree; on average over the noise the weight is one.
    weight = problem.weigh(np.zeros((1, 3)))[1][0]
    fitted = np.linalg.inv(prior + (problem.evaluate(np.zeros(problem.size)).hessian - prior) / weight)[:n, :n]
    assert rank(PRIOR, [push], numerics=settings).values[0].covariance == pytest.approx(fitted, abs=1e-8)


def test_pushes_that_miss_or_fail_come_last_with_no_information() -> None:
    good = candidates_of(2, 4)
    path = good[0].pusher
    miss = replace(good[0], pusher=PusherPath(path.time, path.position + 1.0, path.radius))
    broken = replace(good[0], pusher=PusherPath(path.time, path.position * 1e200, path.radius))
    ranked = rank(PRIOR, [miss, broken, *good])
    assert [v.status for v in ranked.values[:2]] == [SolveStatus.CONVERGED] * 2
    assert any(ranked.best is push for push in good)
    assert {v.status for v in ranked.values[2:]} <= {SolveStatus.NO_CONTACT, SolveStatus.SIMULATION_FAILED}
    for value in ranked.values[2:]:
        np.testing.assert_allclose(value.covariance, PRIOR.covariance, atol=1e-9)
        assert value.error_after == pytest.approx(ranked.error_before)
    assert rank(PRIOR, [miss]).best is None


def test_candidates_are_safe_and_touch_the_object() -> None:
    for push in candidates_of(12, 6):
        assert push.plan is not None
        check_push(push.plan, SHAPE.outline, SETTINGS)
        assert imagine_push(PRIOR.mechanics, push, sensor=PoseSensor())[1] is SolveStatus.CONVERGED


def test_nothing_to_choose_from_is_refused_and_an_unwanted_ranking_stops() -> None:
    rng, answers = np.random.default_rng(0), iter([True] * len(REFERENCE) + [True, True, False])
    for candidates, reference, what in (([], REFERENCE, "no candidate"), (candidates_of(1, 7), [], "reference")):
        with pytest.raises(InputError, match=what):
            rank_pushes(PRIOR, candidates, reference=reference, rng=rng)
    with pytest.raises(UnwantedError):
        options = RankingOptions(n_draws=0)
        rank_pushes(PRIOR, candidates_of(6, 3), reference=REFERENCE, rng=rng, options=options, is_wanted=lambda: next(answers))
    assert next(answers, None) is None
