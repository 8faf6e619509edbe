"""Why the simulation parts from what was seen: effects that are there are named with their size, those that are not are not."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from helpers.objects import hammer, random_records
from push_ident.diagnosis.diagnose import _borne_out, _doubts, _explains_more, _explanations, _is_more_there, diagnose
from push_ident.diagnosis.diagnosis_json import to_json
from push_ident.diagnosis.fits import EffectFit, fit_base, fit_effects, fit_effects_but, without_pushes
from push_ident.diagnosis.held_out import Gap, measure_gap
from push_ident.diagnosis.next_push import SeparatingPush, separating_push
from push_ident.diagnosis.report import write_report
from push_ident.diagnosis.residuals import Frames, Group, _noise_of, correlation_in_motion
from push_ident.diagnosis.scores import EffectScore, Information
from push_ident.diagnosis.seen import odd_pushes
from push_ident.diagnosis.selection import Candidate, Rival, Selection, Step, _needed, _worth_refitting, select_effects
from push_ident.diagnosis.settings import DiagnosisSettings, Thresholds
from push_ident.diagnosis.unknown import SmoothWrench, _best_parts
from push_ident.diagnosis.verdict import Diagnosis, FoundEffect, Verdict
from push_ident.diagnosis.wording import (
    sentence_of_effects,
    sentence_of_lone,
    sentence_of_nothing,
    sentence_of_odd,
    sentence_of_unknown,
)  # fmt: skip
from push_ident.errors import InputError
from push_ident.identification.budget import Meter
from push_ident.identification.observation import NoiseModel, noise_correlation, observe_push
from push_ident.identification.solvers.gauss_newton import minimise
from push_ident.physics.effects import EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, ObjectModel, PoseTrack, PushRecord, SolveStatus

TRUTH = hammer(1)
TRUTH = ObjectModel(TRUTH.shape, TRUTH.mass, TRUTH.friction, 0.3)
DEVIATION = np.array([1e-3, 1e-3, np.radians(0.5)])


def _pushes(n: int, seed: int, effects: dict[str, list[float]] | None = None) -> list[PushRecord]:
    rng = np.random.default_rng([seed, 7])
    records = []
    for order, record in enumerate(random_records(TRUTH, n, seed)):
        time = record.poses.time
        pose = simulate(TRUTH, PushScenario(record.pusher, record.poses.pose[0], time, order), effects=effects).pose
        seen = pose + rng.normal(size=pose.shape) * DEVIATION
        track = PoseTrack(time, seen, np.broadcast_to(np.diag(DEVIATION**2), (len(time), 3, 3)))
        records.append(replace(record, poses=track, order=order, source=f"push {order}"))
    return records


@pytest.fixture(scope="module")
def nothing() -> Diagnosis:
    return diagnose(_pushes(8, 1))


@pytest.fixture(scope="module")
def tilted() -> Diagnosis:
    return diagnose(_pushes(8, 1, {"table_tilt": [0.02, 0.0]}))


def test_no_effect_is_found_where_there_is_none(nothing: Diagnosis) -> None:
    assert nothing.verdict is Verdict.NO_GAP
    assert nothing.gap is not None and np.isnan(nothing.gap.shrink)
    assert "No gap beyond noise" in nothing.sentence
    # What was not seen, and would have been: one number an effect.
    smallest = {entry["name"]: entry["smallest"] for entry in to_json(nothing)["ranking"]}
    assert 1e-4 < smallest["outline_error"] < 2e-3
    assert smallest["pose_latency"] < 0.02


def test_tilted_table_is_named_with_its_size_and_closes_the_gap(tilted: Diagnosis) -> None:
    assert tilted.effects[0].name in ("table_tilt", "tether")
    assert "table_tilt" in (tilted.effects[0].name, *tilted.confusable)
    assert tilted.gap is not None
    assert tilted.gap.shrink > 0.7
    low, high = tilted.gap.shrink_interval
    assert low <= tilted.gap.shrink <= high


@pytest.mark.parametrize(("name", "size"), [("pose_latency", 0.03), ("outline_error", 0.002), ("pusher_friction", 0.3)])
def test_effect_is_named_with_its_size(name: str, size: float) -> None:
    found = diagnose(_pushes(8, 2, {name: [size]}))
    assert found.effects[0].name == name, found.sentence
    (value,), (std,) = found.effects[0].parameters.values(), found.effects[0].std.values()
    assert abs(value - size) < max(0.15 * size, 3 * std)


def test_effect_that_is_put_into_the_base_is_no_gap_any_more() -> None:
    found = diagnose(_pushes(8, 2, {"pose_latency": [0.03]}), DiagnosisSettings(base_effects=("pose_latency",)))
    assert found.verdict is Verdict.NO_GAP
    assert found.fit is not None and found.fit.names == ("pose_latency",)


def test_what_no_effect_explains_is_unknown_and_described(tmp_path: Path) -> None:
    """More friction in one half of all headings in the table, and a torque with it: no effect of the catalogue does that."""
    found = diagnose(_pushes(10, 3, {"unknown_wrench": _wrench(along_cos=0.06, along_sin2=0.06, torque_cos=0.04)}))
    assert found.verdict is Verdict.UNKNOWN, found.sentence
    assert found.unknown is not None and not found.effects
    assert "heading in the table" in found.unknown.description
    assert found.gap is not None and found.gap.shrink > 0.5
    content = to_json(found)
    assert content["verdict"] == "unknown" and content["unknown"]["evidence"] > 10.0
    write_report(tmp_path / "report.html", found, object_id="o1", sources=[])
    assert "mm with a smooth wrench" in (tmp_path / "report.html").read_text(encoding="utf-8")


def _wrench(**weights: float) -> list[float]:
    return [weights.get(p.name, 0.0) for p in EFFECTS["unknown_wrench"].parameters]


def test_small_error_of_an_outline_that_a_camera_traced_is_no_effect_and_a_large_one_no_data() -> None:
    def traced(offset: float) -> list[PushRecord]:
        return [replace(r, shape=replace(r.shape, traced_by_camera=True)) for r in _pushes(6, 1, {"outline_error": [offset]})]

    small = diagnose(traced(5e-4))
    assert small.verdict is Verdict.NO_GAP
    (gate,) = [gate for gate in small.gates if "outside the outline" in gate.found]
    assert 0.3e-3 < float(gate.found.split()[7]) * 1e-3 < 0.7e-3
    large = diagnose(traced(-5e-3))
    assert large.verdict is Verdict.NOT_TRUSTWORTHY
    assert "radius of the pusher" in large.sentence


def test_camera_that_is_off_within_its_accuracy_is_no_effect_and_one_that_is_off_by_more_is_named() -> None:
    def seen(angle: float) -> Diagnosis:
        return diagnose(_pushes(8, 1, {"camera_rotation": [angle]}), DiagnosisSettings(outline_is_seen=True))

    within = seen(2e-3)
    assert within.verdict is Verdict.NO_GAP, within.sentence
    assert within.fit is not None and "camera_rotation" in within.fit.names
    beyond = seen(0.03)
    assert beyond.effects[0].name == "camera_rotation", beyond.sentence
    assert beyond.effects[0].parameters["angle"] == pytest.approx(0.03, abs=5e-3)
    # Put into the base by hand, it stays there.
    asked = DiagnosisSettings(outline_is_seen=True, base_effects=("camera_rotation",))
    assert diagnose(_pushes(8, 1, {"camera_rotation": [0.03]}), asked).verdict is Verdict.NO_GAP


def test_twins_are_named_together() -> None:
    found = diagnose(_pushes(8, 3, {"tool_offset": [0.003, 0.0]}))
    assert found.verdict is Verdict.ONE_OF
    assert {found.effects[0].name, *found.confusable} >= {"tool_offset", "camera_translation"}
    assert "mark" in found.check


def test_poses_that_jump_and_come_back_are_not_trusted() -> None:
    rng = np.random.default_rng(0)
    turned = []
    for record in _pushes(8, 1):
        pose = record.poses.pose.copy()
        pose[rng.random(len(pose)) < 0.05, 2] += np.pi
        turned.append(replace(record, poses=replace(record.poses, pose=pose)))
    found = diagnose(turned)
    assert found.verdict is Verdict.NOT_TRUSTWORTHY
    assert "jump away" in found.sentence


def _with_lasting_noise(records: list[PushRecord], rho: float, seed: int) -> list[PushRecord]:
    """Noise of twice the deviation added, whose errors correlate from frame to frame."""
    rng = np.random.default_rng(seed)
    noisy = []
    for record in records:
        noise = rng.normal(size=record.poses.pose.shape)
        for k in range(1, len(noise)):
            noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * noise[k]
        track = PoseTrack(record.poses.time, record.poses.pose + 2.0 * DEVIATION * noise, 5.0 * record.poses.covariance)
        noisy.append(replace(record, poses=track))
    return noisy


@pytest.mark.parametrize(("rho", "effects", "names"), [(0.6, None, []), (0.0, {"table_tilt": [0.03, 0.0]}, ["table_tilt"])])
def test_noise_that_lasts_is_nothing_where_rests_are_too_short_to_tell_and_an_effect_is(
    rho: float, effects: dict[str, list[float]] | None, names: list[str]
) -> None:
    records = []
    for record in _with_lasting_noise(_pushes(8, 1, effects), rho, 1):
        poses, driven = record.poses, record.pusher.time[np.abs(np.gradient(record.pusher.position, axis=0)).sum(axis=1) > 1e-9]
        kept = (poses.time > driven[0] - 0.1) & (poses.time < driven[-1] + 0.25)
        records.append(replace(record, poses=PoseTrack(poses.time[kept], poses.pose[kept], poses.covariance[kept])))
    assert np.isnan(noise_correlation(records, enough_pairs=80))
    # A fifth of the noise is white: neighbours correlate by 0.8 rho.
    assert correlation_in_motion(fit_base(records, DiagnosisSettings())) == pytest.approx(0.8 * rho, abs=0.15)
    found = diagnose(records)
    assert [effect.name for effect in found.effects] == names and (names or found.verdict is Verdict.NO_GAP)


@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_correlation_of_noise_is_measured_at_rest_and_makes_means_worth_less(rho: float) -> None:
    records = _with_lasting_noise(_pushes(14, 1), rho, 2)
    measured = noise_correlation(records)
    assert measured == pytest.approx(rho, abs=0.2)
    told, naive = (observe_push(records[0], noise) for noise in (NoiseModel(correlation=max(measured, 0.0)), NoiseModel()))
    ratio = told.last_covariance[0, 0] / naive.last_covariance[0, 0]
    assert (2.0 < ratio < 5.0) if rho else ratio == pytest.approx(1.0, abs=0.35)


def test_one_wrong_pose_at_rest_does_not_move_the_rest_pose() -> None:
    record = _pushes(1, 1)[0]
    pose = record.poses.pose.copy()
    pose[2, 2] += np.pi
    spoilt = observe_push(replace(record, poses=replace(record.poses, pose=pose)))
    assert np.abs(spoilt.pose[0] - observe_push(record).pose[0]).max() < 3e-3


def test_evidence_of_an_effect_is_that_of_the_step_in_which_it_came() -> None:
    """Of three steps, the second found a cause beside which the first one's runner-up is the better one."""
    fit = _fit("wear", "tether")

    def step(**gains: float) -> Step:
        return Step(fit, None, (), tuple(Candidate(name, fit, gain) for name, gain in gains.items()))

    steps = (step(table_tilt=40.0, wear=35.0, tether=20.0), step(tether=15.0, wear=2.0), step(restitution=1.0))
    selection = Selection(_fit(), fit, steps)
    assert {name: (steps.index(s), c.gain) for name, (s, c) in selection.added.items()} == {"wear": (0, 35.0), "tether": (1, 15.0)}


def _fit(*names: str, log_evidence: float = 0.0) -> EffectFit:
    return cast(Any, SimpleNamespace(names=names, log_evidence=log_evidence))


@pytest.mark.parametrize(
    ("rival", "gain", "its_gain", "is_open"),
    [
        ("wear", 200.0, 185.0, True),
        ("wear", 200.0, 175.0, False),
        ("pose_latency", 200.0, 195.0, True),
        ("pose_latency", 200.0, 185.0, False),
        ("pose_latency", 20.0, 15.0, True),
        ("pose_latency", 20.0, 13.0, False),
        ("pose_latency", 10.0, 2.0, True),
    ],
)
def test_rivals_stay_open_within_a_few_units_and_those_whose_law_is_a_guess_within_a_tenth(
    rival: str, gain: float, its_gain: float, is_open: bool
) -> None:
    base, fit = _fit(), _fit("pusher_lag")
    step = Step(base, None, (), (Candidate("pusher_lag", fit, gain), Candidate(rival, fit, its_gain)))
    assert _doubts(Selection(base, fit, (step,)), Thresholds()) == ({"pusher_lag": (rival,)} if is_open else {})


def test_doubts_of_an_earlier_effect_come_from_fits_beside_all_that_was_found() -> None:
    """Of the first step alone, latency would be far off; beside the second effect it is near, and outline_error is not."""
    base, fit = _fit(), _fit("pusher_lag", "camera_rotation")
    lag = Candidate("pusher_lag", _fit("pusher_lag"), 100.0)
    steps = (
        Step(base, None, (), (lag, Candidate("pose_latency", fit, 80.0), Candidate("outline_error", fit, 70.0))),
        Step(lag.fit, None, (), (Candidate("camera_rotation", fit, 50.0), Candidate("camera_scale", fit, 20.0))),
    )
    swaps = (Rival("pose_latency", "pusher_lag", fit, 2.0), Rival("outline_error", "pusher_lag", fit, 30.0))
    selection = Selection(base, fit, steps, swaps)
    assert _doubts(selection, Thresholds()) == {"pusher_lag": ("pose_latency",)}
    assert list(_explanations(selection, Thresholds())) == ["pusher_lag", "pose_latency"]


def test_twins_that_no_push_tells_apart_are_doubts_of_each_other_unless_both_are_there() -> None:
    def doubts(*found: str) -> dict[str, tuple[str, ...]]:
        steps = tuple(Step(_fit(), None, (), (Candidate(name, _fit(name), 50.0),)) for name in found)
        return _doubts(Selection(_fit(), _fit(*found), steps), Thresholds())

    assert doubts("tool_offset") == {"tool_offset": ("camera_translation",)}
    assert doubts("tool_offset", "camera_translation") == {} == doubts("wear")


def test_stages_are_the_fits_on_the_way_to_all_that_was_found() -> None:
    base, lag, both = _fit("outline_error"), _fit("outline_error", "pusher_lag"), _fit("outline_error", "pusher_lag", "wear")
    steps = tuple(Step(fit, None, (), ()) for fit in (base, lag, both))
    assert Selection(base, both, steps).stages == {"pusher_lag": lag}
    assert Selection(base, lag, steps[:2]).stages == {} and Selection(base, base, steps).stages == {}


@pytest.mark.parametrize(
    ("gains", "kept", "lone"),
    [
        ([[5.0, 9.0, 4.0], [3.0, 7.0, 2.0]], ("pusher_lag", "wear"), None),
        ([[5.0, 9.0, 4.0], [3.0, -1.5, 2.0]], ("pusher_lag",), ("wear", (1, 4))),
        ([[5.0, 9.0, -2.0], [3.0, -1.5, 2.0]], (), ("pusher_lag", (2,))),
    ],
)
def test_effect_that_one_push_alone_speaks_for_is_not_believed(
    gains: list[list[float]], kept: tuple[str, ...], lone: tuple[str, tuple[int, ...]] | None
) -> None:
    base, lag, both = _fit(), _fit("pusher_lag"), _fit("pusher_lag", "wear")
    selection = Selection(base, both, tuple(Step(fit, None, (), ()) for fit in (base, lag, both)))
    nothing = np.zeros(5)
    gap = Gap(nothing, nothing, nothing, np.ones(3), np.zeros((3, 2)), ((0, 3), (1, 4), (2,)), np.array(gains))
    believed, found = _borne_out(selection, gap, Thresholds())
    assert believed.found == kept and (lone is None or len(believed.steps) == len(kept) + 1)
    assert (found and (found.name, found.pushes)) == lone
    # What makes pushes held out worse is not believed, whatever it gained.
    worse = replace(gap, log_density_gain=-np.ones(3))
    assert _borne_out(selection, worse, Thresholds())[0].found == ()
    neither = Selection(base, base, selection.steps[:1])
    assert _borne_out(neither, replace(worse, gain_without=np.zeros((0, 3))), Thresholds()) == (neither, None)


def test_gap_is_measured_at_every_stage() -> None:
    base = fit_base(_pushes(3, 1), DiagnosisSettings())
    fit = fit_effects(base, ("table_tilt",))
    gap = measure_gap(base, fit, between={"itself": fit})
    np.testing.assert_array_equal(gap.stages["itself"], gap.after)
    assert gap.before.shape == gap.after.shape == (3,) and measure_gap(base, base, between={"itself": fit}).stages == {}
    gained = fit.log_evidence - base.log_evidence
    np.testing.assert_allclose(gap.gain_without, [gained - gap.log_density_gain, np.zeros(3)], atol=1e-9)
    assert gap.folds == ((0,), (1,), (2,)) and measure_gap(base, base).gain_without.shape == (0, 3)


def test_what_is_smaller_than_cells_are_known_is_not_told_however_well_it_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "DEVIATION", 0.03 * DEVIATION)
    found = diagnose(_pushes(5, 3, {"pose_latency": [0.0015]}))
    assert found.verdict == Verdict.NO_GAP and found.effects == ()
    assert "(pose_latency: delta 1.48 ± " in found.sentence and found.sentence.endswith("but by too little to matter.")
    (latency,) = found.selection.base.effects.values if found.selection else ()
    assert latency == pytest.approx(0.0015, abs=3e-4)
    told = diagnose(_pushes(5, 3, {"pose_latency": [0.0035]}))
    assert "pose_latency" in {*(effect.name for effect in told.effects), *(name for names in told.doubts.values() for name in names)}


def test_object_that_moves_before_the_pusher_seems_to_be_there_is_not_taken_for_a_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "DEVIATION", 0.03 * DEVIATION)
    found = diagnose(_pushes(6, 3, {"tool_offset": [0.006, 0.0]}))
    assert all(gate.passed for gate in found.gates)
    assert {found.effects[0].name, *found.doubts[found.effects[0].name]} == {"tool_offset", "camera_translation"}


def test_push_that_goes_its_own_way_is_set_aside_where_a_camera_traced_the_outline() -> None:
    noise = np.random.default_rng(2).normal(size=(8, 30, 3))
    assert odd_pushes(_frames(noise)) == ()
    few, many = noise.copy(), noise.copy()
    few[[2, 5]] *= 3.0
    many[[2, 5, 6]] *= 3.0
    assert odd_pushes(_frames(few)) == (2, 5)
    # What so many pushes have in common is not the edge that each of them met.
    assert odd_pushes(_frames(many)) == ()
    assert sentence_of_odd(["push 3"]).startswith(" Push 3 goes its own way and was set aside")
    assert sentence_of_odd(["push 3", "push 4"]).startswith(" Push 3 and push 4 go their own way and were set aside")


def test_diagnosis_through_a_camera_does_without_the_push_that_goes_its_own_way() -> None:
    records = [replace(record, shape=replace(record.shape, traced_by_camera=True)) for record in _pushes(8, 1)]
    poses = records[3].poses
    way = np.linalg.norm(poses.pose[:, :2] - poses.pose[0, :2], axis=1)
    turned = poses.pose + np.outer(way, [0.0, 0.15, 3.0])
    found = diagnose([*records[:3], replace(records[3], poses=replace(poses, pose=turned)), *records[4:]])
    assert found.verdict == Verdict.NO_GAP and " Push 3 goes its own way and was set aside" in found.sentence


def test_sentence_points_at_the_push_that_alone_speaks_for_something() -> None:
    assert sentence_of_lone("wear", ["push 3"]) == (
        " Only push 3 speaks for wear, which is not believed until another push does: repeat that push."
    )
    assert "Only push 3 and push 13 speak for wear" in sentence_of_lone("wear", ["push 3", "push 13"])


def test_a_law_that_holds_as_it_stands_asks_no_more_of_the_next_effect_and_one_that_is_a_guess_does() -> None:
    def needed(*found: tuple[str, float]) -> float:
        steps = tuple(Step(_fit(), None, (), (Candidate(name, _fit(name), gain),)) for name, gain in found)
        return _needed(Selection(_fit(), _fit(*(name for name, _ in found)), steps), Thresholds(seen=5.0, also=12.0, also_share=0.15))

    assert needed() == 5.0
    assert needed(("camera_scale", 900.0)) == 12.0
    assert needed(("table_tilt", 900.0)) == pytest.approx(135.0)
    assert needed(("camera_scale", 900.0), ("table_tilt", 200.0)) == pytest.approx(30.0)


def test_several_effects_have_to_beat_the_wrench_that_they_may_imitate_and_one_must_only_not_be_beaten() -> None:
    def named(*names: str) -> Selection:
        return Selection(_fit(), _fit(*names, log_evidence=40.0))

    def explains_more(gain: float, *names: str) -> bool:
        return _explains_more(SmoothWrench(cast(Any, None), gain, {}, {}), named(*names), Thresholds(apart=6.0, most=0.8))

    assert [explains_more(gain, "tether", "wear") for gain in (33.0, 35.0)] == [False, True]
    assert [explains_more(gain, "tether") for gain in (45.0, 49.0, 51.0)] == [False, False, True]


def test_base_that_is_stuck_is_freed_before_an_effect_counts() -> None:
    """A base that has not found its optimum is easily beaten by anything that begins at another place."""
    good = fit_base(_pushes(6, 1), DiagnosisSettings())
    off = good.x.copy()
    off[: good.parameters.size] += np.random.default_rng(0).normal(size=good.parameters.size)
    stuck = EffectFit(good.problem, off, good.problem.evaluate(off), SolveStatus.STALLED)
    assert stuck.log_evidence < good.log_evidence - 20.0
    selection = select_effects(stuck, Thresholds())
    assert not selection.found
    assert selection.base is selection.fit
    assert selection.base.log_evidence > good.log_evidence - 2.0


def test_effect_beside_another_is_refitted_only_where_it_promises_something() -> None:
    def chosen(is_first: bool, **gains: float) -> list[str]:
        scores = tuple(EffectScore(name, gain, np.zeros(1), np.eye(1), np.inf) for name, gain in gains.items())
        return [score.name for score in _worth_refitting(scores, Thresholds(), is_first=is_first)]

    assert chosen(True, wear=3.0, restitution=-1.0) == ["wear", "restitution"]
    assert chosen(False, wear=3.0, restitution=-1.0) == ["wear"]
    assert chosen(True, outline_error=100.0, wear=5.0) == ["outline_error"]  # no rival of so much more
    assert chosen(True) == []


def test_wrench_of_many_parts_is_told_by_the_best_of_them() -> None:
    """The linear guess may ask for all 24 parts."""
    n = len(EFFECTS["unknown_wrench"].parameters)
    told = Information({"unknown_wrench": np.arange(n)}, 1e4 * np.eye(n), -1e4 * np.linspace(0.5, 1.5, n))
    parts, promise = _best_parts(told)
    assert len(parts) == 8 and promise > 0
    assert ("turning", "heading in the object") in parts and ("along", "even") not in parts


def test_no_clock_decides_how_far_a_diagnosis_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine, or one that compiles its kernels first, takes longer and says the same."""
    before = fit_base(_pushes(4, 1), DiagnosisSettings())
    monkeypatch.setattr(Meter, "seconds", property(lambda meter: 1e6))
    after = fit_base(_pushes(4, 1), DiagnosisSettings())
    assert after.status is before.status and np.array_equal(after.x, before.x)
    assert not before.problem.meter.spent and not before.problem.without([0]).meter.spent


def test_fit_without_hope_ends_early() -> None:
    problem = fit_base(_pushes(4, 1), DiagnosisSettings()).problem
    _, full, status = minimise(problem.of(problem.parameters), np.zeros(problem.size))
    hopeless = problem.of(problem.parameters)
    _, early, given_up = minimise(hopeless, np.zeros(problem.size), worth=full.cost - 1e3)
    assert (status, given_up) == (SolveStatus.CONVERGED, SolveStatus.BUDGET_SPENT)
    assert early.cost > full.cost
    # What the full solve reaches is within hope at every step.
    assert minimise(problem.of(problem.parameters), np.zeros(problem.size), worth=full.cost + 1.0)[1].cost == full.cost


def test_sentences_say_what_is_missing_in_units_of_everyday() -> None:
    gap = Gap(np.full(4, 4e-3), np.full(4, 1e-3), np.full(4, 7e-4), np.ones(4), np.ones((4, 2)))
    tilt = FoundEffect("table_tilt", {"x": 0.0175, "y": 0.0}, {"x": 0.0017, "y": 0.0017}, 30.0)
    lag = FoundEffect("pusher_lag", {"tau": 0.03}, {"tau": 0.002}, 20.0)
    one = sentence_of_effects([tilt], {}, gap)
    assert one.startswith(
        "The simulation leaves out that the table slopes down along (x, y) (table_tilt: x 1 ± 0.097 deg, y 0 ± 0.097 deg)."
    )
    assert "falls from 4.0 to 1.0 mm; 0.7 mm is" in one
    assert "predicted no better (5.0 mm, 4.0 without)" in sentence_of_effects([tilt], {}, replace(gap, after=np.full(4, 5e-3)))
    assert "(or it is tether instead: these pushes cannot tell)" in sentence_of_effects([tilt], {"table_tilt": ("tether",)}, gap)
    two = sentence_of_effects([tilt, lag], {"pusher_lag": ("pose_latency",)}, gap)
    assert "; and the pusher follows" in two and "30 ± 2 ms" in two and "(or in place of pusher_lag it is pose_latency: these" in two
    assert "predicted to 4.0 mm, and 0.7 mm of that" in sentence_of_nothing(gap)
    where = {"push": [Group("3", 20, (1.0, 2.5, 1.0), 1e-3, (0.5, 0.0, 0.5))]}
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(4, 25, 3))
    assert "1.5 times those of a model that is right, most by push at 3" in sentence_of_unknown(gap, None, _frames(1.5 * noise), where)
    lasting = np.sqrt(0.5) * (noise + rng.normal(size=(4, 1, 3)))
    assert re.search(
        r"either: [3-6]\d % of the residuals go on from frame to frame", sentence_of_unknown(gap, None, _frames(lasting), where)
    )


def _frames(residual: Float64Array) -> Frames:
    """Residuals of some pushes, shape (n_pushes, n_frames, 3), of which nothing else is known; without a gap they would be white."""
    n_pushes, n_frames, _ = residual.shape
    n = n_pushes * n_frames
    none, white = np.zeros(n), np.random.default_rng(1).normal(size=(400, n, 3))
    return Frames(residual.reshape(n, 3), np.zeros((n, 3)), np.repeat(np.arange(n_pushes), n_frames), none, none, none, none, none, white)


def test_noise_that_lasts_is_drawn_as_large_as_its_whitening_leaves_it() -> None:
    rho, n = 0.6, 40
    seen = SimpleNamespace(time=np.zeros(n), correlation=rho, whitening=np.tile(np.eye(3), (n, 1, 1)), discrepancy=np.zeros((n, 3)))
    drawn = _noise_of(cast(Any, seen), np.random.default_rng(5))[:, 1:-1]
    # Frames are smaller by (1 - rho) / (1 + rho), and their mean is as uncertain as that of independent frames of unit variance.
    assert float(np.var(drawn)) == pytest.approx((1 - rho) / (1 + rho), rel=0.03)
    assert float(np.mean(drawn[:, 1:] * drawn[:, :-1]) / np.var(drawn)) == pytest.approx(rho, abs=0.02)
    assert float(np.var(drawn.mean(axis=1))) * drawn.shape[1] == pytest.approx(1.0, rel=0.15)


def test_what_a_model_of_pushing_is_off_by_is_drawn_once_a_push_and_grows_with_the_way() -> None:
    (record,) = _pushes(1, 1)
    seen = observe_push(record, NoiseModel(discrepancy_position=0.5, discrepancy_yaw=0.0))
    deviation, _, of_yaw = seen.discrepancy[-1]
    assert deviation == pytest.approx(0.5 * np.linalg.norm(seen.pose[-1, :2] - seen.pose[0, :2]), rel=0.3)
    assert of_yaw == 0.0 and not seen.discrepancy[0].any()
    drawn = np.einsum("fij,dfj->dfi", np.linalg.inv(seen.whitening), _noise_of(seen, np.random.default_rng(5)))
    np.testing.assert_allclose(drawn[:, -1, :2].std(axis=0), deviation, rtol=0.15)
    assert np.corrcoef(drawn[:, -1, 0], drawn[:, -2, 0])[0, 1] > 0.95 > 0.2 > abs(np.corrcoef(drawn[:, -1, 2], drawn[:, -2, 2])[0, 1])


def test_noise_does_not_last_from_frame_to_frame_and_what_is_unexplained_does() -> None:
    rng = np.random.default_rng(2)
    noise, slow = rng.normal(size=(14, 30, 3)), np.sin(np.linspace(0.0, 9.0, 30))[:, None] * np.ones((14, 1, 3))
    lasting, by_chance = _frames(noise).persistence
    assert abs(lasting) < 0.1 and by_chance > 0.01
    lasting, by_chance = _frames(noise + 0.8 * slow).persistence
    assert lasting == pytest.approx(0.8**2 * float(np.mean(slow**2)), abs=0.1) and by_chance == 0.0
    right, lasts, off = _frames(noise), _frames(0.8 * noise + 0.6 * slow), _frames(1.2 * noise)
    assert not _is_more_there(right, right, Thresholds(), noise_is_known=True)
    assert _is_more_there(right, lasts, Thresholds(), noise_is_known=True) and _is_more_there(right, off, Thresholds(), noise_is_known=True)
    # What a camera is off by depends on the pose and lasts; what stays of a strong effect may be in its law.
    assert not _is_more_there(right, lasts, Thresholds(), noise_is_known=False)
    assert not _is_more_there(_frames(5.0 * noise), lasts, Thresholds(), noise_is_known=True)
    # Of two frames a push the second is the rest that ends it.
    assert _frames(noise[:, :2]).persistence == (0.0, 1.0)


def test_effect_held_at_zero_is_as_if_it_had_never_been_there() -> None:
    base = fit_base(_pushes(4, 1), DiagnosisSettings())
    names = ("table_tilt", "pose_latency")
    held = fit_effects_but(base, names, np.zeros(3), [0, 1, 2])
    assert np.abs(held.effects.values).max() < 1e-6
    assert held.log_evidence == pytest.approx(base.log_evidence, abs=0.1)
    assert fit_effects(base, names).log_evidence != pytest.approx(base.log_evidence, abs=0.1)


def test_push_held_out_is_fitted_without_it() -> None:
    base = fit_base(_pushes(5, 1), DiagnosisSettings())
    rest = without_pushes(base, [2])
    assert [record.source for record in rest.problem.records] == ["push 0", "push 1", "push 3", "push 4"]
    # As good as a fit that starts from nothing.
    assert rest.end.cost < minimise(rest.problem, np.zeros(rest.problem.size))[1].cost + 0.5


def test_too_few_pushes_are_not_trusted() -> None:
    found = diagnose(_pushes(2, 1))
    assert found.verdict is Verdict.NOT_TRUSTWORTHY
    assert "at least 3 pushes" in found.sentence
    assert to_json(found)["gap"]["before_m"] != to_json(found)["gap"]["before_m"]  # NaN, not a plausible number


def test_no_push_is_expected_to_tell_a_tool_from_a_camera_that_is_off() -> None:
    """The object lies where it is reported, and with a camera that is off elsewhere: the twins then say the same of every push."""
    base = fit_base(_pushes(3, 1, {"tool_offset": [0.003, 0.001]}), DiagnosisSettings())
    fits = {name: fit_effects(base, (name,)) for name in ("tool_offset", "camera_translation")}
    limits = PushSettings(workspace=(-1.0, 1.0, -1.0, 1.0))
    twins = separating_push(fits, np.zeros(3), limits)
    other = separating_push({"nothing": base, "tool_offset": fits["tool_offset"]}, np.zeros(3), limits)
    assert twins is None and other is not None and other.distance2 > 9.0 and other.settles
    three = separating_push({"nothing": base, **fits}, np.zeros(3), limits)
    assert three is not None and "nothing" in three.between and three.distance2 > 9.0 and not three.settles


@pytest.mark.parametrize(
    ("between", "aim"),
    [
        (("wear", "tether"), "tells wear from tether best"),
        (("without wear", "wear"), "confirms wear best"),
        (("no effect", "wear"), "would show wear best"),
    ],
)
def test_what_a_push_is_for_is_said_in_words(between: tuple[str, str], aim: str) -> None:
    assert SeparatingPush(cast(Any, None), between, 10.0, True).aim == aim


def test_unknown_effect_and_no_push_are_refused() -> None:
    with pytest.raises(InputError, match="table_tilt"):
        diagnose(_pushes(3, 1), DiagnosisSettings(base_effects=("tilt",)))
    with pytest.raises(InputError, match="no push"):
        diagnose([])


def test_page_tells_the_engineer_what_to_do_next(tilted: Diagnosis, tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", tilted, object_id="o1", sources=["bag, push 0"])
    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg") >= 4
    assert not re.findall(r"(?:src|href)=\"(?!#|data:)", page)
    for text in ("Where it lies", "What causes it", "How far it goes", "Do next", "spirit level"):
        assert text in page
    untrusted = diagnose(_pushes(2, 1))
    write_report(tmp_path / "untrusted.html", untrusted, object_id="o1", sources=[])
    assert "cannot be diagnosed" in (tmp_path / "untrusted.html").read_text()
