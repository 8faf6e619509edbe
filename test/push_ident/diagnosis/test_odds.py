"""From evidence to probabilities: prior odds, costs and discrepancies decide as they are stated."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import pytest

from helpers.diagnosis import step_of, stub_fit
from push_ident.diagnosis.odds import OutsideEvidence, Probabilities, explanations_of, is_outside, probabilities_of
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.scores import EffectScore
from push_ident.diagnosis.selection import Selection, Step
from push_ident.diagnosis.something_else.evidence import SomethingElse

POLICY = SelectionPolicy()
NO_TRACE = OutsideEvidence(-math.inf, -math.inf)


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
    found = probabilities(Selection(base, base, (Step(base, None, scores, ()),)), OutsideEvidence(0.0, 0.0))
    assert found.nothing == pytest.approx(POLICY.prior_nothing)
    assert found.something_else == pytest.approx(POLICY.prior_something_else)
    assert sum(found.effects.values()) == pytest.approx(POLICY.prior_effects)
    assert not is_outside(found, POLICY)


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
    instead = probabilities(named, OutsideEvidence(in_place=60.0, in_addition=-2.0))
    assert instead.something_else > 0.99 and instead.effects["wear"] < 0.01 and is_outside(instead, POLICY)
    beside = probabilities(named, OutsideEvidence(in_place=10.0, in_addition=8.0))
    assert beside.something_else > 0.99 and not is_outside(beside, POLICY), "real pushes hold a remainder: the effect is named beside it"
    # What the effect explains may be part of the same trace.
    assert beside.effects["wear"] == pytest.approx(1.0 - POLICY.imitated_in_part, abs=0.01)
    assert beside.outside_alone == pytest.approx(POLICY.imitated_in_part, abs=0.01)
    # The less so, the more of the gap on held-out pushes it closes.
    closing = probabilities_of(explanations_of(named, OutsideEvidence(in_place=10.0, in_addition=8.0), POLICY, closed=0.9), ())
    assert closing.effects["wear"] > 0.94 and closing.outside_alone < POLICY.max_probability_of_error and closing.something_else > 0.99
    neither = probabilities(named, OutsideEvidence(in_place=10.0, in_addition=-2.0))
    assert neither.something_else < POLICY.max_probability_of_error and neither.effects["wear"] > 0.9


def test_effect_that_pushes_do_not_support_counts_with_their_evidence() -> None:
    nothing_kept = selection_of({"wear": 40.0, "restitution": 39.0}, n_found=0)
    believed = probabilities_of(explanations_of(nothing_kept, NO_TRACE, POLICY), ())
    rejected = probabilities_of(explanations_of(nothing_kept, NO_TRACE, POLICY, rejected={"wear": -1.0}), ())
    assert believed.effects["wear"] + believed.effects["restitution"] > 0.99
    assert max(rejected.effects.values()) < 0.05 and rejected.nothing > 0.9


def test_failed_tests_of_residuals_are_worth_what_their_p_value_allows() -> None:
    failed = OutsideEvidence.of(None, None, [0.001], POLICY)
    assert OutsideEvidence.of(None, None, [], POLICY) == OutsideEvidence(0.0, 0.0)
    assert failed.in_place == failed.in_addition == pytest.approx(math.log(1.0 / (math.e * 0.001 * math.log(1000.0))))


def test_structure_that_goes_with_a_fold_is_no_alarm_and_still_leaves_a_name_open() -> None:
    found = SomethingElse(22.7, 0.002, (cast(Any, None),) * 18, np.array([22.5, 0.3, 24.0]))
    evidence = OutsideEvidence.of(found, found, [], POLICY)
    assert found.least == 0.3 and evidence.in_place < 1.0 and evidence.in_addition > 20.0
    carried = SomethingElse(22.7, 0.002, found.patterns, np.array([22.5, 12.0, 24.0]))
    assert OutsideEvidence.of(carried, carried, [], POLICY).in_place > 10.0


def test_structure_beside_a_strong_effect_is_worth_less_since_no_law_is_exact() -> None:
    found = SomethingElse(4.0, 0.001, (cast(Any, None),) * 18, np.array([4.0, 9.0]))
    weak, strong = (OutsideEvidence.of(found, found, [], POLICY, named=value) for value in (30.0, 700.0))
    assert weak.in_addition > 3.9 and weak.in_place == strong.in_place == weak.in_addition
    selection = selection_of({"outline_error": 700.0}, n_found=1)
    beside_weak, beside_strong = (probabilities(selection, evidence).something_else for evidence in (weak, strong))
    assert beside_weak > beside_strong > POLICY.max_probability_of_error
    nothing = OutsideEvidence.of(None, SomethingElse(-2.0, 0.5, found.patterns, np.array([])), [], POLICY, named=700.0)
    assert probabilities(selection, nothing).something_else < POLICY.imitated_wholly + 0.05
