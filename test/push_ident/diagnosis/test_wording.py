"""Sentences of a diagnosis: what is missing, in everyday units."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from helpers.diagnosis import frame_residuals
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.policy import UnknownPolicy
from push_ident.diagnosis.residual_groups import ResidualGroup
from push_ident.diagnosis.result import FoundEffect
from push_ident.diagnosis.wording import (
    sentence_of_effects,
    sentence_of_negligible,
    sentence_of_nothing,
    sentence_of_outliers,
    sentence_of_unknown,
    sentence_of_unsupported,
)  # fmt: skip

GAP = Gap(np.full(4, 4e-3), np.full(4, 1e-3), np.full(4, 7e-4), np.ones(4), np.ones((4, 2)))
TILT = FoundEffect("table_tilt", {"x": 0.0175, "y": 0.0}, {"x": 0.0017, "y": 0.0017}, 30.0)
LAG = FoundEffect("pusher_lag", {"tau": 0.03}, {"tau": 0.002}, 20.0)


def test_one_effect_comes_with_its_size_and_the_errors_before_and_after() -> None:
    one = sentence_of_effects([TILT], {}, GAP)
    assert one.startswith("The simulation leaves out that the table slopes down")
    assert "(table_tilt: x 1 ± 0.097 deg, y 0 ± 0.097 deg)." in one
    assert (
        "With this effect added, the mean error on held-out pushes falls from 4.0 to 1.0 mm; noise of the poses accounts for 0.7 mm." in one
    )
    worse = sentence_of_effects([TILT], {}, replace(GAP, after=np.full(4, 5e-3)))
    assert "held-out pushes are predicted no better (5.0 mm, 4.0 mm without)" in worse


def test_every_confusion_set_has_its_sentence() -> None:
    assert "These pushes cannot distinguish table_tilt from tether or wear." in sentence_of_effects(
        [TILT], {"table_tilt": ("tether", "wear")}, GAP
    )
    two = sentence_of_effects([TILT, LAG], {"pusher_lag": ("pose_latency",)}, GAP)
    assert "; and the pusher follows" in two and "tau 30 ± 2 ms" in two
    assert "cannot distinguish pusher_lag from pose_latency." in two and "With these effects added" in two


def test_no_gap_states_error_and_noise() -> None:
    assert "error on held-out pushes is 4.0 mm, and noise of the poses accounts for 0.7 mm" in sentence_of_nothing(GAP)
    assert "noise of the poses can cause 9.0 mm" in sentence_of_nothing(replace(GAP, noise=np.full(4, 9e-3)))


def test_unknown_cause_without_a_wrench_states_what_is_unusual_about_the_residuals() -> None:
    where = {"push": [ResidualGroup("3", 20, (1.0, 2.5, 1.0), 1e-3, (0.5, 0.0, 0.5))]}
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(4, 25, 3))
    large = sentence_of_unknown(GAP, None, frame_residuals(1.5 * noise), where, UnknownPolicy())
    assert "1.5 times as large as those of a correct model. Residuals are largest for push 3." in large
    smooth = np.sqrt(0.5) * (noise + rng.normal(size=(4, 1, 3)))
    sentence = sentence_of_unknown(GAP, None, frame_residuals(smooth), where, UnknownPolicy())
    assert re.search(r"[3-6]\d % of the squared residuals continue from frame to frame", sentence)


def test_additions_name_pushes_and_effects() -> None:
    assert sentence_of_unsupported("wear", ["push 3"]) == " Only push 3 supports wear, so that it is not reported: repeat that push."
    assert "Only push 3 and push 13 support wear" in sentence_of_unsupported("wear", ["push 3", "push 13"])
    assert sentence_of_outliers(["push 3"]).startswith(" Push 3 disagrees with all others and was set aside")
    assert sentence_of_outliers(["push 3", "push 4"]).startswith(" Push 3 and push 4 disagree with all others and were set aside")
    assert "negligible" in sentence_of_negligible([LAG]) and "(pusher_lag: tau 30 ± 2 ms)" in sentence_of_negligible([LAG])
