"""Score tests of absent effects; their selection, what counts, and which rivals remain in a tie; the push that would resolve it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes, step_of, stub_fit
from push_ident.diagnosis.fits import fit_base, fit_effects
from push_ident.diagnosis.next_push import NO_EFFECT, competing_explanations, separating_push
from push_ident.diagnosis.policy import NextPushPolicy, SelectionPolicy
from push_ident.diagnosis.scores import EffectInformation, EffectScore, score_effects
from push_ident.diagnosis.select import choose_refits, required_log_bayes_factor, select_effects
from push_ident.diagnosis.selection import RivalFit, Selection, Step
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effects import EFFECTS
from push_ident.pushing.push import PushSettings
from push_ident.types import SolveStatus

POLICY = SelectionPolicy()


def test_evidence_of_an_effect_is_that_of_the_step_in_which_it_was_added() -> None:
    """Of three steps, the second found a cause beside which the first one's runner-up is the better one."""
    steps = (step_of(table_tilt=40.0, wear=35.0, tether=20.0), step_of(tether=15.0, wear=2.0), step_of(restitution=1.0))
    selection = Selection(stub_fit(), stub_fit("wear", "tether"), steps)
    added = {name: (steps.index(step), c.log_bayes_factor) for name, (step, c) in selection.added.items()}
    assert added == {"wear": (0, 35.0), "tether": (1, 15.0)}


@pytest.mark.parametrize(
    ("rival", "found", "its", "is_tied"),
    [
        ("wear", 200.0, 185.0, True),
        ("wear", 200.0, 175.0, False),
        ("pose_latency", 200.0, 195.0, True),
        ("pose_latency", 200.0, 185.0, False),
        ("pose_latency", 20.0, 15.0, True),
        ("pose_latency", 20.0, 13.0, False),
        ("pose_latency", 10.0, 2.0, True),
        ("pose_latency", 10.0, 0.5, False),
    ],
)
def test_rivals_are_tied_within_a_margin_that_is_a_share_for_approximate_laws_and_everything_for_weak_effects(
    rival: str, found: float, its: float, is_tied: bool
) -> None:
    selection = Selection(stub_fit(), stub_fit("pusher_lag"), (step_of(pusher_lag=found, **{rival: its}),))
    assert [tied.name for tied in selection.tied_rivals(POLICY)] == ([rival] if is_tied else [])


def test_rivals_of_an_earlier_effect_come_from_fits_beside_all_others() -> None:
    """In the first step latency is far behind; beside the second effect it is near, and outline_error is not."""
    base, fit = stub_fit(), stub_fit("pusher_lag", "camera_rotation")
    steps = (step_of(pusher_lag=100.0, pose_latency=80.0, outline_error=70.0), step_of(camera_rotation=50.0, camera_scale=20.0))
    swaps = (RivalFit("pose_latency", "pusher_lag", fit, 2.0), RivalFit("outline_error", "pusher_lag", fit, 30.0))
    selection = Selection(base, fit, steps, swaps)
    assert [(rival.replaces, rival.name) for rival in selection.tied_rivals(POLICY)] == [("pusher_lag", "pose_latency")]
    assert list(competing_explanations(selection, POLICY)) == ["pusher_lag", "pose_latency"]


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
    assert first == pytest.approx(5.0, abs=0.02)

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

    assert chosen(True, wear=3.0, restitution=-1.0) == ["wear", "restitution"]
    assert chosen(False, wear=3.0, restitution=-1.0) == ["wear"]
    assert chosen(True, outline_error=100.0, wear=5.0) == ["outline_error"]  # no rival of so much more
    assert chosen(True) == []
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
    assert not selection.selected
    assert selection.base is selection.fit
    assert selection.base.log_evidence > good.log_evidence - 2.0


def information_of(**slopes: tuple[float, float]) -> EffectInformation:
    """Of effects with one parameter: precision of its unknown and slope of the cost."""
    places = {name: np.array([k]) for k, name in enumerate(slopes)}
    return EffectInformation(places, np.diag([p for p, _ in slopes.values()]), np.array([g for _, g in slopes.values()]))


def test_effects_are_ranked_by_the_log_bayes_factor_that_they_promise() -> None:
    scores = score_effects(information_of(wear=(2.0, 1.0), pose_latency=(101.0, -60.0)), POLICY)
    assert [score.name for score in scores] == ["pose_latency", "wear"]
    best = scores[0]
    assert best.expected_log_bayes_factor == pytest.approx(0.5 * 60.0**2 / 101.0 - 0.5 * np.log(101.0))
    np.testing.assert_allclose(best.start, [60.0 / 101.0])
    np.testing.assert_allclose(best.information, [[100.0]])
    assert score_effects(None, POLICY) == []


def test_smallest_detectable_size_brings_the_threshold_on_average() -> None:
    (score,) = score_effects(information_of(pose_latency=(101.0, 0.0)), POLICY)
    true = score.smallest_detectable / EFFECTS["pose_latency"].parameters[0].scale
    # A true value e makes a mean slope of -S e.
    (found,) = score_effects(information_of(pose_latency=(101.0, -100.0 * true)), POLICY)
    assert found.expected_log_bayes_factor == pytest.approx(POLICY.min_log_bayes_factor)
    (nothing,) = score_effects(information_of(pose_latency=(1.0, 0.0)), POLICY)
    assert nothing.smallest_detectable == np.inf


def test_no_push_distinguishes_an_error_of_the_tool_from_one_of_the_camera() -> None:
    """The object lies where it is reported, and with an error of the camera elsewhere: exact twins then predict the same of every push."""
    base = fit_base(simulated_pushes(3, 1, {"tool_offset": [0.003, 0.001]}), DiagnosisSettings())
    fits = {name: fit_effects(base, (name,)) for name in ("tool_offset", "camera_translation")}
    limits, policy = PushSettings(workspace=(-1.0, 1.0, -1.0, 1.0)), NextPushPolicy()
    twins = separating_push(fits, np.zeros(3), limits, policy)
    other = separating_push({"nothing": base, "tool_offset": fits["tool_offset"]}, np.zeros(3), limits, policy)
    assert twins is None and other is not None and other.mahalanobis2 > 9.0 and other.resolves
    three = separating_push({"nothing": base, **fits}, np.zeros(3), limits, policy)
    assert three is not None and "nothing" in three.between and three.mahalanobis2 > 9.0 and not three.resolves


def test_explanations_compete_with_no_effect_with_rivals_or_with_absence() -> None:
    def names(found: tuple[str, ...], **log_bayes_factors: float) -> list[str]:
        return list(competing_explanations(Selection(stub_fit(), stub_fit(*found), (step_of(**log_bayes_factors),)), POLICY))

    assert names((), wear=2.0, tether=1.0, restitution=0.5) == [NO_EFFECT, "wear", "tether"]
    assert names(("wear",), wear=50.0, tether=48.0) == ["wear", "tether"]
    assert names(("wear",), wear=50.0, tether=10.0) == ["without wear", "wear"]
    # No push distinguishes exact twins.
    assert names(("tool_offset",), tool_offset=50.0, camera_translation=50.0) == ["without tool_offset", "tool_offset"]
