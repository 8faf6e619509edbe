"""Score tests of absent effects, their selection, the rivals in a tie and the push that would resolve it, and the verdict."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from helpers.diagnosis import account_of_parts, frame_residuals, simulated_pushes, step_of, stub_fit
from push_ident.diagnosis.decide import confusion_sets, decide, verdict_of
from push_ident.diagnosis.explain import explain
from push_ident.diagnosis.fits import fit_base
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.odds import Probabilities
from push_ident.diagnosis.policy import SelectionPolicy, UnknownPolicy, ValidationPolicy
from push_ident.diagnosis.scores import EffectInformation, EffectScore, score_effects
from push_ident.diagnosis.select import choose_refits, required_log_bayes_factor, select, select_effects
from push_ident.diagnosis.selection import RivalFit, Selection, Step
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.state import DiagnosisState, UnsupportedEffect, Validation
from push_ident.diagnosis.validate import failed_tests, supported_selection, validate
from push_ident.diagnosis.verdict import Gate, Verdict
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effect_values import effect_values
from push_ident.physics.effects import EFFECTS
from push_ident.types import SolveStatus

POLICY = SelectionPolicy()


def test_evidence_of_an_effect_is_that_of_the_step_in_which_it_was_added() -> None:
    """Of three steps, the second found a cause beside which the first one's runner-up is the better one."""
    steps = (step_of(table_tilt=40.0, wear=35.0, tether=20.0), step_of(tether=15.0, wear=2.0), step_of(restitution=1.0))
    selection = Selection(stub_fit(), stub_fit("wear", "tether"), steps)
    added = {name: (steps.index(step), c.log_bayes_factor) for name, (step, c) in selection.added.items()}
    assert added == {"wear": (0, 35.0), "tether": (1, 15.0)}


def test_an_effect_that_was_replaced_and_added_again_has_the_step_in_which_it_came_back() -> None:
    steps = (step_of(table_tilt=40.0, wear=35.0), step_of(tether=15.0), step_of(table_tilt=12.0))
    selection = Selection(stub_fit(), stub_fit("wear", "tether", "table_tilt"), steps)
    added = {name: (steps.index(step), c.log_bayes_factor) for name, (step, c) in selection.added.items()}
    assert added == {"wear": (0, 35.0), "tether": (1, 15.0), "table_tilt": (2, 12.0)}


@pytest.mark.parametrize(
    ("rival", "found", "tied", "excluded"),
    [
        ("wear", 200.0, 185.0, 175.0),
        ("pose_latency", 200.0, 195.0, 185.0),
        ("pose_latency", 20.0, 15.0, 13.0),
    ],
)
def test_rivals_are_tied_within_a_margin_that_is_a_share_for_approximate_laws(
    rival: str, found: float, tied: float, excluded: float
) -> None:
    for its, names in ((tied, [rival]), (excluded, [])):
        selection = Selection(stub_fit(), stub_fit("pusher_lag"), (step_of(pusher_lag=found, **{rival: its}),))
        assert [each.name for each in selection.tied_rivals(POLICY)] == names


def test_rival_is_tied_while_its_deficit_differs_as_much_from_push_to_push() -> None:
    """Of 9 pushes, all but one prefer the effect by 1 nat each, and one by 32: its standard error is 31 nat."""
    found, rival = stub_fit("pusher_lag"), stub_fit("pose_latency")
    found.push_log_densities = np.array([*[1.0] * 8, 32.0])
    rival.push_log_densities = np.zeros(9)
    one = RivalFit.of("pose_latency", "pusher_lag", rival, found, 40.0)
    assert one.deficit_std == pytest.approx(3.0 * np.std([*[1.0] * 8, 32.0], ddof=1))
    steps = (step_of(pusher_lag=100.0, pose_latency=60.0),)
    for pushes, tied in ((one.deficit_std, True), (0.0, False)):
        swaps = (replace(one, deficit_std=pushes, name="outline_error"),)
        selection = Selection(stub_fit(), stub_fit("pusher_lag"), steps, swaps)
        assert ("outline_error" in [each.name for each in selection.tied_rivals(replace(POLICY, cost_wrong_name=20.0))]) is tied


def test_rivals_of_an_earlier_effect_come_from_fits_beside_all_others() -> None:
    """In the first step latency is far behind; beside the second effect it is near, and outline_error is not."""
    base, fit = stub_fit(), stub_fit("pusher_lag", "camera_rotation")
    steps = (step_of(pusher_lag=100.0, pose_latency=80.0, outline_error=70.0), step_of(camera_rotation=50.0, camera_scale=20.0))
    swaps = (RivalFit("pose_latency", "pusher_lag", fit, 2.0, 0.0), RivalFit("outline_error", "pusher_lag", fit, 30.0, 0.0))
    selection = Selection(base, fit, steps, swaps)
    assert [(rival.replaces, rival.name) for rival in selection.tied_rivals(POLICY)] == [("pusher_lag", "pose_latency")]
    assert confusion_sets(selection, POLICY) == {"pusher_lag": ("pose_latency",)}


def test_effect_that_contains_the_found_one_is_its_general_case_and_no_rival() -> None:
    """That something acts is known from the strongest effect, whichever is named."""
    selection = Selection(stub_fit(), stub_fit("table_tilt"), (step_of(table_tilt=50.0, tether=49.0, wear=48.0),))
    assert [rival.name for rival in selection.rivals] == ["wear"]
    assert selection.special_cases(POLICY.tie_margin) == {"table_tilt": "tether"}
    step = step_of(table_tilt=14.2, tether=19.5)
    assert step.best is step.candidates[0] and step.log_bayes_factor == 19.5
    assert step_of().log_bayes_factor == -np.inf


def test_stages_are_the_fits_between_the_base_model_and_all_that_was_found() -> None:
    base, lag, both = stub_fit("outline_error"), stub_fit("outline_error", "pusher_lag"), stub_fit("outline_error", "pusher_lag", "wear")
    steps = tuple(Step(fit, None, (), ()) for fit in (base, lag, both))
    assert Selection(base, both, steps).stages == {"pusher_lag": lag}
    assert Selection(base, lag, steps[:2]).stages == {} and Selection(base, base, steps).stages == {}


def test_approximate_laws_raise_what_the_next_effect_needs_and_exact_ones_do_not() -> None:
    policy = replace(POLICY, discrepancy_next=2.0, discrepancy_next_share=0.03)
    first = policy.detection_log_bayes_factor
    assert first == pytest.approx(5.06, abs=0.02)

    def required(**found: float) -> float:
        steps = tuple(step_of(**{name: value}) for name, value in found.items())
        return required_log_bayes_factor(Selection(stub_fit(), stub_fit(*found), steps), policy)

    assert required() == first
    assert required(camera_scale=900.0) == pytest.approx(2.0 * first)
    assert required(table_tilt=900.0) == pytest.approx(27.0 * first)
    assert required(camera_scale=900.0, table_tilt=200.0) == pytest.approx(6.0 * first)


def test_effect_beside_another_is_refitted_only_where_it_promises_something() -> None:
    def chosen(is_first: bool, **expected: float) -> list[str]:
        scores = [EffectScore(name, value, np.zeros(1), np.eye(1), np.inf) for name, value in expected.items()]
        return [score.name for score in choose_refits(scores, POLICY, required=5.0 if is_first else 12.0, is_first=is_first)]

    assert chosen(True, wear=3.0, restitution=-0.1) == ["wear", "restitution"]
    assert chosen(False, wear=3.0, restitution=-1.0) == ["wear"]
    # Its score says nothing of a bounce that is there.
    assert chosen(True, wear=3.0, restitution=-9.0) == ["wear", "restitution"] and chosen(True, restitution=-9.0) == []
    assert chosen(True, outline_error=100.0, wear=5.0) == ["outline_error"]  # no rival of so much more
    # Effects whose scores mislead about one another are refitted together.
    assert chosen(True, pose_latency=90.0, wear=5.0, pusher_lag=-5.0) == ["pose_latency", "pusher_lag"]
    # Refits bring up to five times what scores promise.
    assert chosen(True, wear=0.9) == [] and chosen(True, wear=1.1) == ["wear"] and chosen(False, wear=2.3) == []


def test_base_model_at_a_poor_optimum_is_freed_before_an_effect_counts() -> None:
    """A base fit that has not found its optimum is easily beaten by anything that begins at another place."""
    good = fit_base(simulated_pushes(6, 1), DiagnosisSettings())
    displaced = good.x.copy()
    displaced[: good.unknowns.size] += np.random.default_rng(0).normal(size=good.unknowns.size)
    stuck = Fit(good.problem, displaced, good.problem.evaluate(displaced), SolveStatus.STALLED)
    assert stuck.log_evidence < good.log_evidence - 20.0
    selection = select_effects(stuck, POLICY)
    assert not selection.selected and selection.base is selection.fit
    assert selection.base.log_evidence > good.log_evidence - 2.0


def information_of(**slopes: tuple[float, float]) -> EffectInformation:
    """Of effects with one parameter: precision of its unknown and slope of the cost."""
    places = {name: np.array([k]) for k, name in enumerate(slopes)}
    return EffectInformation(places, np.diag([p for p, _ in slopes.values()]), np.array([g for _, g in slopes.values()]))


def test_effects_are_ranked_by_the_log_bayes_factor_that_they_promise() -> None:
    scores = score_effects(information_of(wear=(2.0, 1.0), pose_latency=(101.0, -60.0)), POLICY)
    assert [score.name for score in scores] == ["pose_latency", "wear"]
    assert scores[0].expected_log_bayes_factor == pytest.approx(0.5 * 60.0**2 / 101.0 - 0.5 * np.log(101.0))
    assert (*scores[0].start, *scores[0].information) == pytest.approx((60.0 / 101.0, 100.0))
    assert score_effects(None, POLICY) == []


def test_smallest_detectable_size_brings_the_threshold_on_average() -> None:
    (score,) = score_effects(information_of(pose_latency=(101.0, 0.0)), POLICY)
    true = score.smallest_detectable / EFFECTS["pose_latency"].parameters[0].scale
    # A true value e makes a mean slope of -S e.
    (found,) = score_effects(information_of(pose_latency=(101.0, -100.0 * true)), POLICY)
    assert found.expected_log_bayes_factor == pytest.approx(POLICY.min_log_bayes_factor)
    (nothing,) = score_effects(information_of(pose_latency=(1.0, 0.0)), POLICY)
    assert nothing.smallest_detectable == np.inf


# --- stages: gates, what held-out pushes confirm, when the cause is unknown, and the verdict


@pytest.fixture(scope="module")
def state() -> DiagnosisState:
    return DiagnosisState(tuple(simulated_pushes(4, 1)), DiagnosisSettings(), DiagnosisSettings())


def test_nothing_follows_a_gate_that_was_not_passed(state: DiagnosisState) -> None:
    gate = Gate(False, "the pushes are too few", "Push more.")
    failed = replace(state, data_gates=(gate,), base=stub_fit(), selection=Selection(stub_fit(), stub_fit()))
    assert failed.abstains
    assert select(failed, print) is failed and validate(failed, print) is failed and decide(failed) is failed
    outcome = explain(failed, None, print)
    assert outcome.verdict is Verdict.NOT_TRUSTWORTHY and outcome.gates == (gate,) and outcome.gap is None
    assert "the pushes are too few" in outcome.sentence and outcome.check == "Push more."


def test_outcome_names_pushes_that_depart_and_that_alone_support_an_effect(state: DiagnosisState) -> None:
    residuals = frame_residuals(1.5 * np.random.default_rng(0).normal(size=(4, 25, 3)))
    gap = Gap(np.full(4, 4e-3), np.full(4, 4e-3), np.full(4, 1e-3), np.zeros(4), np.zeros((4, 0)))
    account, probabilities = account_of_parts(gap, 1e-3, 2e-4, 1e-4), Probabilities(0.1, 0.8, {"wear": 0.1})
    validation = Validation(Selection(stub_fit(), stub_fit()), gap, account, residuals, residuals, probabilities, names_no_effect=True)
    validation = replace(validation, unsupported=UnsupportedEffect("wear", (2,)), departing={1: 7.3})
    decided = decide(replace(state, validation=validation))
    assert state.decision is None, "a stage leaves its state as it is"
    outcome = explain(decided, None, print)
    assert outcome.verdict is Verdict.UNKNOWN and "1.5 times" in outcome.sentence
    assert "push 2 supports wear" in outcome.sentence
    assert "Push 1 (7 times) departs from the model" in outcome.sentence
    assert outcome.next_push is None and outcome.where["push"] and outcome.residual_ratio == pytest.approx(2.25, rel=0.1)


def with_effects(*names: str) -> Any:
    """A fit of which only the effects are known."""
    return SimpleNamespace(fitted_effects=effect_values(names))


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
    # Lag and wear, without each of the folds.
    estimates, held_out = np.array([[0.050, 0.020], [0.051, 0.021], [0.049, 0.019]]), (with_effects("pusher_lag", "wear"),)
    gap = Gap(zero, zero, zero, np.ones(3), estimates, folds, np.array(log_bayes_factors), {"pusher_lag": zero}, fits=held_out)
    supported, found = supported_selection(selection, gap, policy)
    assert supported.selected == kept and found == unsupported
    assert unsupported is None or len(supported.steps) == len(kept) + 1
    # One that certainly brings the others nearer to their prediction came not from that push.
    closer = replace(gap, before=2.0 + zero, stages={"pusher_lag": 1.0 + zero})
    assert supported_selection(selection, closer, policy) == (selection, None)
    # What predicts held-out pushes worse is rejected, whatever its evidence.
    worse = replace(gap, log_density_gain=-np.ones(3))
    assert supported_selection(selection, worse, policy)[0].selected == ()
    alone = Selection(base, lag, selection.steps[:1])
    disagreeing = replace(gap, estimates=np.array([[0.05], [-0.05], [0.01]]), stages={}, fits=(with_effects("pusher_lag"),))
    disagreeing = replace(disagreeing, log_bayes_factor_without=np.ones((1, 3)))
    assert not disagreeing.determines("pusher_lag")
    assert supported_selection(alone, disagreeing, policy) == (alone.without_effects(), UnsupportedEffect("pusher_lag", ()))
    neither = Selection(base, base, selection.steps[:1])
    assert supported_selection(neither, replace(worse, log_bayes_factor_without=np.zeros((0, 3))), policy) == (neither, None)


def test_residuals_that_are_larger_or_smoother_than_noise_show_something_unknown() -> None:
    rng = np.random.default_rng(2)
    noise, slow = rng.normal(size=(14, 30, 3)), np.sin(np.linspace(0.0, 9.0, 30))[:, None] * np.ones((14, 1, 3))
    right, smooth, large = frame_residuals(noise), frame_residuals(0.8 * noise + 0.6 * slow), frame_residuals(1.2 * noise)
    policy = UnknownPolicy()
    assert not failed_tests(right, right, policy, correlation_std=0.01)
    assert all(failed_tests(right, wrong, policy, correlation_std=0.01) for wrong in (smooth, large))
    # The size of correlated errors is known no better than their correlation.
    assert not failed_tests(right, large, policy, correlation_std=0.1, correlation=0.5)
    # Correlated noise that few frames at rest cannot exclude, or errors of a camera, which depend on the pose, are as smooth.
    assert not any(failed_tests(right, smooth, policy, correlation_std=std) for std in (0.2, np.inf))
    # Beside a strong effect its law may leave as much.
    assert not failed_tests(frame_residuals(5.0 * noise), smooth, policy, correlation_std=0.01)


@pytest.mark.parametrize(
    ("found", "sets", "verdict"),
    [
        ((), {}, Verdict.NO_GAP),
        (("wear",), {}, Verdict.NAMED),
        (("tool_offset",), {"tool_offset": ("camera_translation",)}, Verdict.ONE_OF),
        (("tool_offset", "camera_translation"), {}, Verdict.SEVERAL),
        (("tool_offset", "wear"), {"tool_offset": ("camera_translation",)}, Verdict.SEVERAL),
    ],
)
def test_exact_twins_are_confused_and_the_verdict_counts_effects_and_rivals(
    found: tuple[str, ...], sets: dict[str, tuple[str, ...]], verdict: Verdict
) -> None:
    selection = Selection(stub_fit(), stub_fit(*found), tuple(step_of(**{name: 50.0}) for name in found))
    assert confusion_sets(selection, POLICY) == sets
    assert verdict_of(found, sets) is verdict


def test_laws_of_one_mechanism_are_one_cause() -> None:
    assert verdict_of(["speed_dependent_friction"], {"speed_dependent_friction": ("stribeck_friction",)}) is Verdict.NAMED
    assert verdict_of(["speed_dependent_friction"], {"speed_dependent_friction": ("friction_by_place",)}) is Verdict.ONE_OF
