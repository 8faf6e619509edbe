"""Sentences of a diagnosis: the facts that each has to state, in everyday units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import account_of_parts, frame_residuals, gap_of
from push_ident.diagnosis import wording
from push_ident.diagnosis.account import Account
from push_ident.diagnosis.odds import Probabilities
from push_ident.diagnosis.residuals import ResidualGroup
from push_ident.diagnosis.something_else.words import PatternWords
from push_ident.diagnosis.verdict import FoundEffect, FreeLaw
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.physics.effect import Mechanism
from push_ident.pushing.push import PushPlan2D
from push_ident.types import PusherPath


def account(before: list[float], after: list[float], *names: str, maps: float = 2e-4, noise: float = 1e-3, more: int | None = 0) -> Account:
    """Of errors [mm] of four pushes."""
    gap = gap_of([1e-3 * error for error in before], [1e-3 * error for error in after], 1e-3, names=names)
    return account_of_parts(gap, noise, maps, 1e-4, more)


NONE, OPEN = account([1.5, 1.2, 1.3, 1.4], [1.5, 1.2, 1.3, 1.4]), account([2.5, 2.2, 3.3, 2.4], [2.5, 2.2, 3.3, 2.4])
NAMED = account([4.0] * 4, [1.5] * 4, "table_tilt")
TWO = replace(NAMED, gap=replace(NAMED.gap, names=("table_tilt", "pusher_lag"), stages={"table_tilt": np.full(4, 2e-3)}))
SOURCES = [f"push {number}" for number in range(4)]
TILT = FoundEffect("table_tilt", {"x": 0.0175, "y": 0.0}, {"x": 0.0017, "y": 0.0017}, 30.0)
LAG = FoundEffect("pusher_lag", {"tau": 0.03}, {"tau": 0.002}, 20.0)
WORDS = PatternWords("a force", "from push 7 on", "what changed before that push")
PLAN = PushPlan2D(np.array([0.05, -0.02]), np.array([0.05, -0.035]), np.pi / 2, 0.08, 0.12)
FIRST = PlannedPush(np.zeros(3), PusherPath(np.array([0.0, 1.0]), np.zeros((2, 2)), 0.015), PLAN)
RESIDUALS = frame_residuals(1.5 * np.random.default_rng(0).normal(size=(4, 25, 3)))
WHERE = {"push": [ResidualGroup("3", 20, (1.0, 2.5, 1.0), 1e-3, (0.5, 0.0, 0.5))]}
CAUSES = {"restitution": 0.38, "wear": 0.01, "stribeck_friction": 0.25, "speed_dependent_friction": 0.29}


def few(more: int | None) -> str:
    return wording.sentence_of_nothing(account([1.4] * 4, [1.4] * 4, maps=7e-4, noise=5e-4, more=more), SOURCES, FIRST)


@pytest.mark.parametrize(
    ("sentence", "facts"),
    [
        (
            wording.sentence_of_effects([TILT], {"table_tilt": ("tether", "wear")}, NAMED),
            "table_tilt: x 1 ± 0.097°, y 0 ± 0.097°|2.5 mm|4.0 mm|2.5 to 2.5 mm|tether or wear|1.5 mm|1.0 mm|0.20 mm|0.10 mm",
        ),
        (
            wording.sentence_of_effects([TILT, LAG], {"pusher_lag": ("pose_latency",)}, TWO),
            "table_tilt 2.0 mm, pusher_lag 0.50 mm|tau 30 ± 2 ms|pusher_lag from pose_latency|2.5 mm",
        ),
        (wording.sentence_of_nothing(NONE, SOURCES), "1.4 mm|1.0 mm|0.20 mm|0.10 mm|0.05 mm|within chance"),
        (wording.sentence_of_nothing(account([1.05] * 4, [0.9, 1.2] * 2), SOURCES), "0.25 mm better|90 % interval 0.12 to 0.38 mm"),
        (wording.sentence_of_nothing(OPEN, SOURCES), "2.6 mm|1.3 mm|push 2 (2.0 mm)"),
        (few(5), "0.70 mm (90 % interval 0.70 to 0.70 mm)|5 more pushes|(50, -20) mm|80 mm towards 90°"),
        (few(None), "More than 100 pushes"),
        (wording.sentence_of_unknown(NONE, WORDS, 0.93, RESIDUALS, WHERE), f"0.93|{WORDS.what}|{WORDS.where}|{WORDS.look_for}"),
        (wording.sentence_of_unknown(NONE, None, 0.93, RESIDUALS, WHERE), "1.5 times|push 4"),  # people count pushes from 1
        (wording.sentence_of_doubt(WORDS, 0.3), f"0.30|{WORDS.what}|{WORDS.where}|{WORDS.look_for}"),
        (
            wording.sentence_of_suspicion(Probabilities(0.08, 0.01, CAUSES)),
            "0.08|restitution (0.38), speed_dependent_friction (0.29), stribeck_friction (0.25)",
        ),
        (wording.sentence_of_unsupported("wear", ["push 3", "push 13"]), "push 3 and push 13 support wear"),
        (wording.sentence_of_negligible([LAG]), "pusher_lag: tau 30 ± 2 ms"),
    ],
)
def test_sentence_states_its_facts(sentence: str, facts: str) -> None:
    assert [fact for fact in facts.split("|") if fact not in sentence] == [], sentence


@pytest.mark.parametrize("mechanism", Mechanism)
def test_free_law_is_named_by_its_mechanism_with_what_it_closes_and_what_else_it_may_be(mechanism: Mechanism) -> None:
    closes = account([4.0] * 4, [1.5] * 4, mechanism.value)
    sentence = wording.sentence_of_free_law(FreeLaw(mechanism, 0.45, 0.05, 20.0, ""), WORDS, {mechanism.value: ("tool_moved",)}, closes)
    for fact in (mechanism.value, "a force, from push 7 on", "2.5 mm", "what changed before that push", "from tool moved"):
        assert fact in sentence
    assert wording.amplitude_of(FreeLaw(mechanism, -2e-3, 1e-4, 20.0, "m")) == "up to -2 ± 0.1 mm"
