"""Sentences of a diagnosis: what is missing, in everyday units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import account_of_parts, frame_residuals, gap_of
from push_ident.diagnosis.odds import Probabilities
from push_ident.diagnosis.residual_groups import ResidualGroup
from push_ident.diagnosis.something_else.words import PatternWords
from push_ident.diagnosis.verdict import FoundEffect
from push_ident.diagnosis.wording import (
    sentence_of_doubt,
    sentence_of_effects,
    sentence_of_negligible,
    sentence_of_nothing,
    sentence_of_outliers,
    sentence_of_suspicion,
    sentence_of_unknown,
    sentence_of_unsupported,
)  # fmt: skip
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.pushing.push import PushPlan2D
from push_ident.types import PusherPath

NONE = account_of_parts(gap_of([1.5e-3, 1.2e-3, 1.3e-3, 1.4e-3], [1.5e-3, 1.2e-3, 1.3e-3, 1.4e-3], 1e-3), 1e-3, 2e-4, 1e-4)
NAMED = account_of_parts(gap_of([4e-3] * 4, [1.5e-3] * 4, 1e-3, names=("table_tilt",)), 1e-3, 2e-4, 1e-4)
TWO = replace(NAMED, gap=replace(NAMED.gap, names=("table_tilt", "pusher_lag"), stages={"table_tilt": np.full(4, 2e-3)}))
SOURCES = [f"push {number}" for number in range(4)]
TILT = FoundEffect("table_tilt", {"x": 0.0175, "y": 0.0}, {"x": 0.0017, "y": 0.0017}, 30.0)
LAG = FoundEffect("pusher_lag", {"tau": 0.03}, {"tau": 0.002}, 20.0)


def has_all(sentence: str, *facts: str) -> None:
    assert [fact for fact in facts if fact not in sentence] == [], sentence


def test_effects_come_with_their_sizes_the_errors_before_and_after_and_their_rivals() -> None:
    one = sentence_of_effects([TILT], {"table_tilt": ("tether", "wear")}, NAMED)
    has_all(one, "table_tilt: x 1 ± 0.097°, y 0 ± 0.097°", "2.5 mm of the mean error of 4.0 mm", "2.5 to 2.5 mm", "tether or wear")
    has_all(one, "other 1.5 mm", "1.0 mm", "0.20 mm and the model", "0.10 mm", "0.20 mm remain unexplained")
    two = sentence_of_effects([TILT, LAG], {"pusher_lag": ("pose_latency",)}, TWO)
    has_all(two, "(table_tilt 2.0 mm, pusher_lag 0.50 mm)", "tau 30 ± 2 ms", "pusher_lag from pose_latency", "2.5 mm")
    worse = sentence_of_effects([TILT], {}, account_of_parts(gap_of([4e-3] * 4, [5e-3] * 4, 1e-3, names=("table_tilt",)), 1e-3, 2e-4, 1e-4))
    has_all(worse, "(5.0 mm, 4.0 mm without)")


def test_nothing_beyond_noise_states_every_part() -> None:
    has_all(sentence_of_nothing(NONE, SOURCES), "mean error of 1.4 mm", "for 1.0 mm", "0.20 mm", "0.10 mm; 0.05 mm", "within chance")
    gap = gap_of([1.05e-3] * 4, [0.9e-3, 1.2e-3] * 2, 1e-3)
    better = sentence_of_nothing(account_of_parts(gap, 1e-3, 2e-4, 1e-4), SOURCES)
    has_all(better, "0.25 mm better than expected (90 % interval 0.10 to 0.40 mm)")


@pytest.mark.parametrize(("n", "fact"), [(5, "5 more pushes"), (1, "1 more push "), (None, "More than 100 pushes")])
def test_too_few_pushes_state_how_many_more_and_which_one_first(n: int | None, fact: str) -> None:
    few = account_of_parts(NONE.gap, 5e-4, 7e-4, 1e-4, more_pushes=n)
    plan = PushPlan2D(np.array([0.05, -0.02]), np.array([0.05, -0.035]), np.pi / 2, 0.08, 0.12)
    first = PlannedPush(np.zeros(3), PusherPath(np.array([0.0, 1.0]), np.zeros((2, 2)), 0.015), plan)
    has_all(sentence_of_nothing(few, SOURCES, first), "0.70 mm (90 % interval 0.70 to 0.70 mm)", fact, "(50, -20) mm", "80 mm towards 90°")


def test_unexplained_error_without_a_name_states_how_much_and_where_most() -> None:
    errors = [2.5e-3, 2.2e-3, 3.3e-3, 2.4e-3]
    sentence = sentence_of_nothing(account_of_parts(gap_of(errors, errors, 1e-3), 1e-3, 2e-4, 1e-4), SOURCES)
    has_all(sentence, "mean error of 2.6 mm", "1.3 mm remain unexplained", "push 2 (2.0 mm)")


def test_unknown_cause_states_its_probability_pattern_and_where_residuals_are_largest() -> None:
    where = {"push": [ResidualGroup("3", 20, (1.0, 2.5, 1.0), 1e-3, (0.5, 0.0, 0.5))]}
    residuals = frame_residuals(1.5 * np.random.default_rng(0).normal(size=(4, 25, 3)))
    words = PatternWords("a force", "from push 7 on", "what changed before that push")
    has_all(sentence_of_unknown(NONE, words, 0.93, residuals, where), "0.93", words.what, words.where, words.look_for)
    # People count pushes from 1.
    has_all(sentence_of_unknown(NONE, None, 0.93, residuals, where), "1.5 times", "push 4")
    has_all(sentence_of_doubt(words, 0.3), "0.30", words.what, words.where, words.look_for)


def test_additions_name_causes_pushes_and_effects() -> None:
    causes = {"restitution": 0.38, "wear": 0.01, "stribeck_friction": 0.25, "speed_dependent_friction": 0.29}
    suspicion = sentence_of_suspicion(Probabilities(0.08, 0.01, causes))
    has_all(suspicion, "0.08", "restitution (0.38), speed_dependent_friction (0.29), stribeck_friction (0.25)")
    assert "wear" not in suspicion
    for sentence, facts in (
        (sentence_of_unsupported("wear", ["push 3"]), ("push 3 supports wear",)),
        (sentence_of_unsupported("wear", ["push 3", "push 13"]), ("push 3 and push 13 support wear",)),
        (sentence_of_outliers(["push 3", "push 4"]), ("Push 3 and push 4 disagree",)),
        (sentence_of_negligible([LAG]), ("pusher_lag: tau 30 ± 2 ms",)),
    ):
        has_all(sentence, *facts)
