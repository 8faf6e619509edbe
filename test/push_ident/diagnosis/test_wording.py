"""Sentences of a diagnosis: what is missing, in everyday units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

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


def test_one_effect_comes_with_its_size_and_the_errors_before_and_after() -> None:
    one = sentence_of_effects([TILT], {}, NAMED)
    assert one.startswith("The simulation leaves out that the table slopes down")
    assert (
        "(table_tilt: x 1 ± 0.097°, y 0 ± 0.097°), which accounts for 2.5 mm of the mean error of 4.0 mm on held-out pushes (90 % "
        "interval 2.5 to 2.5 mm)." in one
    )
    assert (
        "Of the other 1.5 mm, noise of the poses accounts for 1.0 mm, maps that are not known yet for 0.20 mm and the model's own "
        "discrepancy for 0.10 mm; 0.20 mm remain unexplained" in one
    )
    worse = sentence_of_effects([TILT], {}, account_of_parts(gap_of([4e-3] * 4, [5e-3] * 4, 1e-3, names=("table_tilt",)), 1e-3, 2e-4, 1e-4))
    assert "accounts for 2" not in worse and "end no nearer to their prediction with it (5.0 mm, 4.0 mm without)" in worse


def test_every_confusion_set_has_its_sentence() -> None:
    assert "These pushes cannot distinguish table_tilt from tether or wear." in sentence_of_effects(
        [TILT], {"table_tilt": ("tether", "wear")}, NAMED
    )
    two = sentence_of_effects([TILT, LAG], {"pusher_lag": ("pose_latency",)}, TWO)
    assert "(table_tilt 2.0 mm, pusher_lag 0.50 mm)" in two
    assert "; and the pusher follows" in two and "tau 30 ± 2 ms" in two
    assert "cannot distinguish pusher_lag from pose_latency." in two and "which together account for 2.5 mm" in two


def test_nothing_beyond_noise_states_every_part() -> None:
    nothing = sentence_of_nothing(NONE, SOURCES)
    assert nothing.startswith(
        "No gap beyond noise: of the mean error of 1.4 mm on held-out pushes, noise of the poses accounts for 1.0 mm, maps that are not "
        "known yet for 0.20 mm and the model's own discrepancy for 0.10 mm; 0.05 mm remain unexplained, within chance"
    )
    gap = gap_of([1.05e-3] * 4, [0.9e-3, 1.2e-3] * 2, 1e-3)
    better = sentence_of_nothing(account_of_parts(gap, 1e-3, 2e-4, 1e-4), SOURCES)
    assert "the pushes were predicted 0.25 mm better than expected (90 % interval 0.10 to 0.40 mm)" in better


def test_too_few_pushes_state_how_many_more_and_which_one_first() -> None:
    few = account_of_parts(NONE.gap, 5e-4, 7e-4, 1e-4, more_pushes=5)
    plan = PushPlan2D(np.array([0.05, -0.02]), np.array([0.05, -0.035]), np.pi / 2, 0.08, 0.12)
    pusher = PusherPath(np.array([0.0, 1.0]), np.zeros((2, 2)), 0.015)
    sentence = sentence_of_nothing(few, SOURCES, PlannedPush(np.zeros(3), pusher, plan))
    assert sentence.startswith("Nothing is found, and the pushes are too few to know: 0.70 mm (90 % interval 0.70 to 0.70 mm) of ")
    assert (
        "5 more pushes like these would tell; this one first: touch at (50, -20) mm of the table, push 80 mm towards 90° at 0.12 m/s."
        in sentence
    )
    assert "1 more push like these would tell." in sentence_of_nothing(replace(few, more_pushes=1), SOURCES)
    assert "More than 100 pushes like these" in sentence_of_nothing(replace(few, more_pushes=None), SOURCES)


def test_unexplained_error_without_a_name_states_how_much_and_where_most() -> None:
    errors = [2.5e-3, 2.2e-3, 3.3e-3, 2.4e-3]
    sentence = sentence_of_nothing(account_of_parts(gap_of(errors, errors, 1e-3), 1e-3, 2e-4, 1e-4), SOURCES)
    assert sentence.startswith(
        "Nothing is named, but of the mean error of 2.6 mm on held-out pushes, 1.3 mm remain unexplained (90 % interval"
    )
    assert "most in push 2 (2.0 mm)" in sentence


def test_unknown_cause_says_what_acts_where_and_what_to_look_for() -> None:
    where = {"push": [ResidualGroup("3", 20, (1.0, 2.5, 1.0), 1e-3, (0.5, 0.0, 0.5))]}
    residuals = frame_residuals(1.5 * np.random.default_rng(0).normal(size=(4, 25, 3)))
    words = PatternWords("a force", "from push 7 on", "what changed before that push")
    sentence = sentence_of_unknown(NONE, words, 0.93, residuals, where)
    assert sentence.startswith(
        "The simulation leaves out something outside the catalogue of effects (probability 0.93), most probably a force, from push 7 on. "
        "Look for what changed before that push."
    )
    large = sentence_of_unknown(NONE, None, 0.93, residuals, where)
    assert "1.5 times as large as those of a correct model, and largest for push 4." in large
    doubt = sentence_of_doubt(words, 0.3)
    assert "may act in its place or beside it (probability 0.30): a force, from push 7 on; look for what changed" in doubt


def test_suspicion_names_the_most_probable_causes() -> None:
    probabilities = Probabilities(
        0.08, 0.01, {"restitution": 0.38, "wear": 0.01, "stribeck_friction": 0.25, "speed_dependent_friction": 0.29}
    )
    sentence = sentence_of_suspicion(probabilities)
    assert sentence.endswith("0.08 only: look at restitution (0.38), speed_dependent_friction (0.29), stribeck_friction (0.25).")


def test_additions_name_pushes_and_effects() -> None:
    assert sentence_of_unsupported("wear", ["push 3"]) == " Only push 3 supports wear, so that it is not reported: repeat that push."
    assert "Only push 3 and push 13 support wear" in sentence_of_unsupported("wear", ["push 3", "push 13"])
    assert sentence_of_outliers(["push 3"]).startswith(" Push 3 disagrees with all others and was set aside")
    assert sentence_of_outliers(["push 3", "push 4"]).startswith(" Push 3 and push 4 disagree with all others and were set aside")
    assert "negligible" in sentence_of_negligible([LAG]) and "(pusher_lag: tau 30 ± 2 ms)" in sentence_of_negligible([LAG])
