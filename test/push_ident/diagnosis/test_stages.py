"""Stages on synthetic states: each returns a new state, and none goes on behind a gate that was not passed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import account_of_parts, frame_residuals, simulated_pushes, stub_fit
from push_ident.diagnosis.decide import decide
from push_ident.diagnosis.explain import explain
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.odds import Probabilities
from push_ident.diagnosis.select import select
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.state import DiagnosisState, UnsupportedEffect, Validation
from push_ident.diagnosis.validate import validate
from push_ident.diagnosis.verdict import Gate, Verdict

SETTINGS = DiagnosisSettings()
ZERO = np.zeros(4)


@pytest.fixture(scope="module")
def state() -> DiagnosisState:
    return DiagnosisState(tuple(simulated_pushes(4, 1)), SETTINGS, SETTINGS)


def validation_of(*, cause_is_unknown: bool) -> Validation:
    residuals = frame_residuals(1.5 * np.random.default_rng(0).normal(size=(4, 25, 3)))
    gap = Gap(np.full(4, 4e-3), np.full(4, 4e-3), np.full(4, 1e-3), ZERO, np.zeros((4, 0)))
    return Validation(
        Selection(stub_fit(), stub_fit()),
        gap,
        account_of_parts(gap, 1e-3, 2e-4, 1e-4),
        residuals,
        residuals,
        Probabilities(0.1, 0.8, {"wear": 0.1}),
        cause_is_unknown=cause_is_unknown,
    )


def test_nothing_follows_a_gate_that_was_not_passed(state: DiagnosisState) -> None:
    gate = Gate(False, "the pushes are too few", "Push more.")
    failed = replace(state, data_gates=(gate,), base=stub_fit(), selection=Selection(stub_fit(), stub_fit()))
    assert failed.abstains
    assert select(failed, print) is failed and validate(failed, print) is failed and decide(failed) is failed
    outcome = explain(failed, None, print)
    assert outcome.verdict is Verdict.NOT_TRUSTWORTHY and outcome.gates == (gate,) and outcome.gap is None
    assert outcome.sentence == "These data cannot be diagnosed: the pushes are too few. Push more." and outcome.check == "Push more."


@pytest.mark.parametrize(("is_unknown", "verdict"), [(True, Verdict.UNKNOWN), (False, Verdict.NO_GAP)])
def test_verdict_follows_from_what_held_out_pushes_confirmed(state: DiagnosisState, is_unknown: bool, verdict: Verdict) -> None:
    decided = decide(replace(state, validation=validation_of(cause_is_unknown=is_unknown)))
    assert decided.decision is not None and decided.decision.verdict is verdict
    assert state.decision is None, "a stage leaves its state as it is"


def test_outcome_names_pushes_that_were_set_aside_and_that_alone_support_an_effect(state: DiagnosisState) -> None:
    validation = replace(validation_of(cause_is_unknown=True), unsupported=UnsupportedEffect("wear", (2,)))
    outcome = explain(decide(replace(state, validation=validation, outliers=("push 7",))), None, print)
    assert outcome.verdict is Verdict.UNKNOWN and "residuals are 1.5 times as large as those of a correct model" in outcome.sentence
    assert "Only push 2 supports wear" in outcome.sentence and "Push 7 disagrees with all others" in outcome.sentence
    assert outcome.next_push is None and outcome.where["push"] and outcome.residual_ratio == pytest.approx(2.25, rel=0.1)
