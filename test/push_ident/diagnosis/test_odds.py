"""From evidence to probabilities: prior odds, costs and discrepancies decide as they are stated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import step_of, stub_fit
from push_ident.diagnosis.odds import SOMETHING_ELSE, OutsideEvidence, Probabilities, explanations_of, is_outside, probabilities_of
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.scores import EffectScore
from push_ident.diagnosis.selection import Selection, Step
from push_ident.diagnosis.something_else.evidence import Pattern, SomethingElse
from push_ident.diagnosis.something_else.family import Acts, Family, Member, VariesWith

POLICY = SelectionPolicy()


def something_else(in_place: float, in_addition: float) -> OutsideEvidence:
    return OutsideEvidence({SOMETHING_ELSE: in_place}, {SOMETHING_ELSE: in_addition})


NO_TRACE = something_else(-math.inf, -math.inf)


def selection_of(*rounds: dict[str, float], n_found: int) -> Selection:
    """Rounds of candidates with their log Bayes factors, the first of each found in `n_found` of them."""
    names = [next(iter(candidates)) for candidates in rounds[:n_found]]
    fits = [stub_fit(*names[:n]) for n in range(n_found + 1)]
    return Selection(fits[0], fits[-1], tuple(step_of(fits[min(number, n_found)], **each) for number, each in enumerate(rounds)))


def probabilities(selection: Selection, outside: OutsideEvidence = NO_TRACE) -> Probabilities:
    return probabilities_of(explanations_of(selection, outside, POLICY), ())


def test_without_evidence_probabilities_are_the_prior() -> None:
    scores = tuple(EffectScore(name, 0.0, np.zeros(1), np.eye(1), np.inf) for name in probabilities(selection_of(n_found=0)).effects)
    base = stub_fit()
    found = probabilities(Selection(base, base, (Step(base, None, scores, ()),)), something_else(0.0, 0.0))
    assert found.nothing == pytest.approx(POLICY.prior_nothing)
    assert found.something_else == pytest.approx(POLICY.prior_something_else)
    assert sum(found.effects.values()) == pytest.approx(POLICY.prior_effects)
    assert not is_outside(found, POLICY)


def test_a_score_counts_for_no_more_than_what_refits_kept_of_theirs() -> None:
    """Stribeck friction promised 88 nat on real pushes, where the refit that was promised most brought -4."""
    base = stub_fit()
    promised = EffectScore("stribeck_friction", 88.0, np.zeros(1), np.eye(1), np.inf)
    refitted = step_of(base, speed_dependent_friction=-4.0)
    step = replace(refitted, scores=(promised,))
    assert probabilities(Selection(base, base, (step,)), something_else(0.0, 20.0)).effects["stribeck_friction"] < 0.1


def test_effect_is_detected_where_silence_would_cost_as_much_as_a_false_alarm() -> None:
    found = probabilities(selection_of({"wear": POLICY.min_log_bayes_factor}, n_found=1))
    assert (1.0 - found.nothing) / found.nothing == pytest.approx(POLICY.cost_false_alarm, rel=1e-6)
    beside = selection_of({"camera_scale": 500.0}, {"wear": POLICY.min_log_bayes_factor_next}, n_found=2)
    told = POLICY.cost_false_alarm / (1 + POLICY.cost_false_alarm)
    assert probabilities(beside).effects["wear"] == pytest.approx((1.0 - POLICY.imitated_wholly) * told)


def test_rival_at_the_margin_of_a_tie_is_as_improbable_as_a_wrong_name_is_expensive_and_a_twin_as_probable() -> None:
    found = probabilities(selection_of({"pusher_lag": 500.0, "pose_latency": 500.0 - POLICY.tie_margin}, n_found=1)).effects
    assert found["pusher_lag"] / found["pose_latency"] == pytest.approx(POLICY.cost_wrong_name)
    twins = probabilities(selection_of({"camera_translation": 100.0}, n_found=1)).effects
    assert twins["tool_offset"] == pytest.approx(twins["camera_translation"]) == pytest.approx((1.0 - POLICY.imitated_wholly) / 2)


def test_something_else_in_place_of_effects_or_beside_them() -> None:
    named = selection_of({"wear": 30.0}, n_found=1)
    instead = probabilities(named, something_else(in_place=60.0, in_addition=-2.0))
    assert instead.something_else > 0.99 and instead.effects["wear"] < 0.01 and is_outside(instead, POLICY)
    beside = probabilities(named, something_else(in_place=10.0, in_addition=8.0))
    assert beside.something_else > 0.99 and not is_outside(beside, POLICY), "real pushes hold a remainder: the effect is named beside it"
    # What the effect explains may be part of the same trace.
    assert beside.effects["wear"] == pytest.approx(1.0 - POLICY.imitated_in_part, abs=0.01)
    assert beside.outside_alone == pytest.approx(POLICY.imitated_in_part, abs=0.01)
    # Not where held-out pushes are certainly nearer to their prediction with it.
    closing = probabilities_of(explanations_of(named, something_else(in_place=10.0, in_addition=8.0), POLICY, closes_error=True), ())
    assert closing.effects["wear"] > 0.94 and closing.outside_alone < POLICY.max_probability_of_error and closing.something_else > 0.99
    neither = probabilities(named, something_else(in_place=10.0, in_addition=-2.0))
    assert neither.something_else < POLICY.max_probability_of_error and neither.effects["wear"] > 0.9


def test_effect_that_pushes_do_not_support_counts_with_their_evidence() -> None:
    nothing_kept = selection_of({"wear": 40.0, "restitution": 39.0}, n_found=0)
    believed = probabilities_of(explanations_of(nothing_kept, NO_TRACE, POLICY), ())
    rejected = probabilities_of(explanations_of(nothing_kept, NO_TRACE, POLICY, rejected={"wear": -1.0}), ())
    assert believed.effects["wear"] + believed.effects["restitution"] > 0.99
    assert max(rejected.effects.values()) < 0.05 and rejected.nothing > 0.9


def test_free_law_of_the_mechanism_of_an_effect_is_another_law_of_it_and_one_of_another_mechanism_a_rival() -> None:
    named = selection_of({"speed_dependent_friction": 30.0}, n_found=1)
    nothing = {SOMETHING_ELSE: -2.0}
    of_speed = {"friction_by_speed": 30.0}
    same = probabilities(named, OutsideEvidence({"friction_by_speed": 40.0, **nothing}, {**of_speed, **nothing}, of_speed))
    assert same.mechanisms["friction_by_speed"] > 0.94 and same.effects["speed_dependent_friction"] > 0.94
    assert same.acts_freely("friction_by_speed") and same.beyond_effects < 0.06 and not is_outside(same, POLICY)
    other = probabilities(named, OutsideEvidence({"friction_by_place": 60.0, **nothing}, {"friction_by_place": -2.0, **nothing}))
    assert (
        other.in_place_of_effects["friction_by_place"] > 0.99 and other.mechanisms["friction_by_speed"] < 0.01 and is_outside(other, POLICY)
    )
    beside = probabilities(named, OutsideEvidence({"friction_by_place": 10.0, **nothing}, {"friction_by_place": 10.0, **nothing}))
    assert beside.beyond_effects > 0.99 and beside.something_else < 0.5 and not is_outside(beside, POLICY)


def families(
    *acting: tuple[Acts, VariesWith, float], without: Sequence[Sequence[float]] = (), of_discrepancy: float = -math.inf
) -> SomethingElse:
    """What was found of some families, each with its log Bayes factor, and without each fold."""
    nothing = np.zeros(1)
    patterns = tuple(
        Pattern(Family(acts, varies, np.zeros((1, 1)), (Member(None, None),), (1.0,)), Member(None, None), 1.0, value, 0.0, nothing, 0.0)
        for acts, varies, value in acting
    )
    return SomethingElse(0.0, 0.002, patterns, of_discrepancy, np.array(without).reshape(-1, len(patterns)))


def test_families_of_a_mechanism_are_its_free_laws_and_each_has_the_same_prior() -> None:
    by_speed, by_push = (Acts.FORCE_ON_MOTION, VariesWith.SPEED, 20.0), (Acts.FORCE, VariesWith.TIME, 12.0)
    found = families(by_speed, (Acts.FRICTION, VariesWith.SPEED, 20.0), by_push, (Acts.PUSHER, VariesWith.TIME, -3.0))
    evidence = OutsideEvidence.of(found, None, [], POLICY)
    assert evidence.in_place.keys() == {"friction_by_speed", SOMETHING_ELSE}
    assert evidence.in_place["friction_by_speed"] == pytest.approx(20.0 + math.log(2 / 8))
    assert evidence.in_place[SOMETHING_ELSE] == pytest.approx(12.0 - math.log(8), abs=1e-3)


def test_failed_tests_of_residuals_are_worth_what_their_p_value_allows() -> None:
    failed = OutsideEvidence.of(None, None, [0.001], POLICY)
    assert OutsideEvidence.of(None, None, [], POLICY) == something_else(0.0, 0.0)
    worth = math.log(1.0 / (math.e * 0.001 * math.log(1000.0)))
    assert failed.in_place[SOMETHING_ELSE] == failed.in_addition[SOMETHING_ELSE] == pytest.approx(worth)


def test_discrepancy_larger_than_usual_is_as_probable_beforehand_as_all_patterns() -> None:
    for value in (9.0, -3.0):
        found = families((Acts.FORCE, VariesWith.TIME, -5.0), of_discrepancy=value)
        expected = float(np.logaddexp(-5.0, value)) - math.log(2)
        assert OutsideEvidence.of(found, found, [], POLICY).in_place[SOMETHING_ELSE] == pytest.approx(expected, abs=1e-9)


EACH_PUSH = (Acts.FORCE, VariesWith.TIME)


def test_structure_that_goes_with_a_fold_is_no_alarm_and_still_leaves_a_name_open() -> None:
    found, carried = (families((*EACH_PUSH, 22.7), without=[[22.5], [least], [24.0]]) for least in (0.3, 12.0))
    evidence = OutsideEvidence.of(found, found, [], POLICY)
    assert found.log_bayes_factors(None)[1] == 0.3
    assert evidence.in_place[SOMETHING_ELSE] < 1.0 and evidence.in_addition[SOMETHING_ELSE] > 20.0
    assert OutsideEvidence.of(carried, carried, [], POLICY).in_place[SOMETHING_ELSE] > 10.0


def test_structure_beside_a_strong_effect_is_worth_less_since_no_law_is_exact() -> None:
    found = families((*EACH_PUSH, 4.0))
    weak, strong = (OutsideEvidence.of(found, found, [], POLICY, named=value) for value in (30.0, 700.0))
    assert weak.in_addition[SOMETHING_ELSE] > 3.2 and weak.in_place == strong.in_place == weak.in_addition
    selection = selection_of({"outline_error": 700.0}, n_found=1)
    beside_weak, beside_strong = (probabilities(selection, evidence).something_else for evidence in (weak, strong))
    assert beside_weak > beside_strong > POLICY.max_probability_of_error
    nothing = OutsideEvidence.of(None, families(*[(*EACH_PUSH, -2.0)] * 18), [], POLICY, named=700.0)
    assert probabilities(selection, nothing).something_else < POLICY.imitated_wholly + 0.05
