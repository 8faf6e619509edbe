"""Stages on synthetic states: gates, what held-out pushes confirm, when the cause is unknown, and the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import account_of_parts, frame_residuals, simulated_pushes, step_of, stub_fit
from push_ident.diagnosis.decide import confusion_sets, decide, verdict_of
from push_ident.diagnosis.explain import explain
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.odds import Probabilities
from push_ident.diagnosis.policy import SelectionPolicy, UnknownPolicy, ValidationPolicy
from push_ident.diagnosis.select import select
from push_ident.diagnosis.selection import RivalFit, Selection, Step
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.state import DiagnosisState, UnsupportedEffect, Validation
from push_ident.diagnosis.validate import failed_tests, supported_selection, validate
from push_ident.diagnosis.verdict import FoundEffect, Gate, Verdict

SETTINGS = DiagnosisSettings()


@pytest.fixture(scope="module")
def state() -> DiagnosisState:
    return DiagnosisState(tuple(simulated_pushes(4, 1)), SETTINGS, SETTINGS)


def test_nothing_follows_a_gate_that_was_not_passed(state: DiagnosisState) -> None:
    gate = Gate(False, "the pushes are too few", "Push more.")
    failed = replace(state, data_gates=(gate,), base=stub_fit(), selection=Selection(stub_fit(), stub_fit()))
    assert failed.abstains
    assert select(failed, print) is failed and validate(failed, print) is failed and decide(failed) is failed
    outcome = explain(failed, None, print)
    assert outcome.verdict is Verdict.NOT_TRUSTWORTHY and outcome.gates == (gate,) and outcome.gap is None
    assert "the pushes are too few" in outcome.sentence and outcome.check == "Push more."


def test_outcome_names_pushes_that_were_set_aside_and_that_alone_support_an_effect(state: DiagnosisState) -> None:
    residuals = frame_residuals(1.5 * np.random.default_rng(0).normal(size=(4, 25, 3)))
    gap = Gap(np.full(4, 4e-3), np.full(4, 4e-3), np.full(4, 1e-3), np.zeros(4), np.zeros((4, 0)))
    account, probabilities = account_of_parts(gap, 1e-3, 2e-4, 1e-4), Probabilities(0.1, 0.8, {"wear": 0.1})
    validation = Validation(Selection(stub_fit(), stub_fit()), gap, account, residuals, residuals, probabilities, cause_is_unknown=True)
    validation = replace(validation, unsupported=UnsupportedEffect("wear", (2,)))
    decided = decide(replace(state, validation=validation, outliers=("push 7",)))
    assert state.decision is None, "a stage leaves its state as it is"
    outcome = explain(decided, None, print)
    assert outcome.verdict is Verdict.UNKNOWN and "1.5 times" in outcome.sentence
    assert "push 2 supports wear" in outcome.sentence and "Push 7" in outcome.sentence
    assert outcome.next_push is None and outcome.where["push"] and outcome.residual_ratio == pytest.approx(2.25, rel=0.1)


@pytest.mark.parametrize(
    ("log_bayes_factors", "kept", "unsupported"),
    [
        ([[5.0, 9.0, 4.0], [3.0, 7.0, 2.0]], ("pusher_lag", "wear"), None),
        ([[5.0, 9.0, 4.0], [3.0, -1.5, 2.0]], ("pusher_lag",), UnsupportedEffect("wear", (1, 4))),
        ([[5.0, 9.0, -2.0], [3.0, -1.5, 2.0]], (), UnsupportedEffect("pusher_lag", (2,))),
    ],
)
def test_effect_that_one_push_supports_is_rejected_with_all_after_it(
    log_bayes_factors: list[list[float]], kept: tuple[str, ...], unsupported: UnsupportedEffect | None
) -> None:
    base, lag, both = stub_fit(), stub_fit("pusher_lag"), stub_fit("pusher_lag", "wear")
    selection = Selection(base, both, tuple(Step(fit, None, (), ()) for fit in (base, lag, both)))
    zero, policy = np.zeros(5), ValidationPolicy()
    folds = ((0, 3), (1, 4), (2,))
    gap = Gap(zero, zero, zero, np.ones(3), np.zeros((3, 2)), folds, np.array(log_bayes_factors))
    supported, found = supported_selection(selection, gap, policy)
    assert supported.selected == kept and found == unsupported
    assert unsupported is None or len(supported.steps) == len(kept) + 1
    # What predicts held-out pushes worse is rejected, whatever its evidence.
    worse = replace(gap, log_density_gain=-np.ones(3))
    assert supported_selection(selection, worse, policy)[0].selected == ()
    neither = Selection(base, base, selection.steps[:1])
    assert supported_selection(neither, replace(worse, log_bayes_factor_without=np.zeros((0, 3))), policy) == (neither, None)


def test_residuals_that_are_larger_or_smoother_than_noise_show_something_unknown() -> None:
    rng = np.random.default_rng(2)
    noise, slow = rng.normal(size=(14, 30, 3)), np.sin(np.linspace(0.0, 9.0, 30))[:, None] * np.ones((14, 1, 3))
    right, smooth, large = frame_residuals(noise), frame_residuals(0.8 * noise + 0.6 * slow), frame_residuals(1.2 * noise)
    policy = UnknownPolicy()
    assert not failed_tests(right, right, policy, correlation_std=0.01)
    assert failed_tests(right, smooth, policy, correlation_std=0.01)
    assert failed_tests(right, large, policy, correlation_std=0.01)
    # What a few frames at rest cannot exclude may be correlated noise.
    assert not failed_tests(right, smooth, policy, correlation_std=0.2)
    # Errors of a camera depend on the pose, so that they are as smooth; beside a strong effect its law may leave as much.
    assert not failed_tests(right, smooth, policy, correlation_std=np.inf)
    assert not failed_tests(frame_residuals(5.0 * noise), smooth, policy, correlation_std=0.01)


def selection_of(*found: str, swaps: tuple[RivalFit, ...] = ()) -> Selection:
    return Selection(stub_fit(), stub_fit(*found), tuple(step_of(**{name: 50.0}) for name in found), swaps)


def test_exact_twins_and_tied_rivals_are_confused() -> None:
    policy = SelectionPolicy()
    assert confusion_sets(selection_of("tool_offset"), policy) == {"tool_offset": ("camera_translation",)}
    assert confusion_sets(selection_of("tool_offset", "camera_translation"), policy) == {} == confusion_sets(selection_of("wear"), policy)
    swaps = (RivalFit("pose_latency", "pusher_lag", stub_fit(), 2.0), RivalFit("outline_error", "pusher_lag", stub_fit(), 30.0))
    assert confusion_sets(selection_of("pusher_lag", "wear", swaps=swaps), policy) == {"pusher_lag": ("pose_latency",)}


@pytest.mark.parametrize(
    ("names", "sets", "verdict"),
    [
        ((), {}, Verdict.NO_GAP),
        (("wear",), {}, Verdict.NAMED),
        (("wear",), {"wear": ("tether",)}, Verdict.ONE_OF),
        (("wear", "pusher_lag"), {"wear": ("tether",)}, Verdict.SEVERAL),
    ],
)
def test_verdict_follows_from_the_number_of_effects_and_of_rivals(
    names: tuple[str, ...], sets: dict[str, tuple[str, ...]], verdict: Verdict
) -> None:
    assert verdict_of([FoundEffect(name, {}, {}, 30.0) for name in names], sets) is verdict
