"""Gates: data and numerics that cannot be trusted, each with a small case of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes
from helpers.objects import with_frames
from push_ident.diagnosis.base_fit import noise_above_steps
from push_ident.diagnosis.gates import check_data, check_pushes
from push_ident.diagnosis.policy import GatePolicy
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.state import DiagnosisState
from push_ident.identification.observing.observation import NoiseModel, observe_push
from push_ident.types import PushRecord


def failed(records: Sequence[PushRecord], policy: GatePolicy | None = None) -> list[str]:
    return [gate.finding for gate in check_data(records, NoiseModel(), policy or GatePolicy()) if not gate.passed]


def checked(*records: PushRecord) -> DiagnosisState:
    return check_pushes(DiagnosisState(records, DiagnosisSettings(), DiagnosisSettings()))


@pytest.fixture(scope="module")
def records() -> list[PushRecord]:
    return simulated_pushes(4, 1)


def test_good_pushes_pass_all_gates_and_too_few_do_not(records: list[PushRecord]) -> None:
    assert failed(records) == []
    assert failed(records, GatePolicy(min_pushes=5)) == ["4 of 4 pushes touch the object"]


def test_object_that_moves_far_from_the_pusher_is_a_matter_of_calibration_not_of_more_pushes(records: list[PushRecord]) -> None:
    scaled = [replace(r, poses=replace(r.poses, pose=r.poses.pose + np.array([0.0, 0.03, 0.0]))) for r in records]
    scaled = [r for r in scaled if not observe_push(r).touched]
    (gate,) = [gate for gate in check_data(scaled, NoiseModel(), GatePolicy()) if not gate.passed]
    assert "the object moves while the pusher is reported at least" in gate.finding and "calibration" in gate.remedy


def test_object_that_moves_by_a_few_millimetres_from_the_pusher_is_pushed(records: list[PushRecord]) -> None:
    displaced = [replace(r, pusher=replace(r.pusher, radius=r.pusher.radius - 0.006)) for r in records]
    assert not any(observe_push(r).touched for r in displaced)
    assert failed(displaced) == [] and len(checked(*displaced).records) == len(displaced)


def test_pushes_with_many_missing_frames_count_by_their_poses_at_rest(records: list[PushRecord]) -> None:
    rng = np.random.default_rng(0)
    gaps = [with_frames(record, rng.random(len(record.poses.time)) > 0.4) for record in records]
    whole = simulated_pushes(1, 2)[0]
    state = checked(*gaps, whole)
    assert not state.abstains and any("4 of 5 pushes count by their poses at rest" in gate.finding for gate in state.gates)
    for record, kept in zip(gaps, state.records, strict=False):
        before, after = observe_push(record), observe_push(kept)
        assert len(after.time) == 2 < len(before.time)
        np.testing.assert_array_equal(after.pose, before.pose[[0, -1]])
    assert len(state.records[-1].poses.time) == len(whole.poses.time)


def test_burst_of_wrong_poses_is_left_out_and_a_step_that_stays_is_not(records: list[PushRecord]) -> None:
    poses = records[1].poses
    start = len(poses.time) // 3
    frames = slice(start, int(np.searchsorted(poses.time, poses.time[start] + 0.5)))
    moved = np.array(poses.pose)
    moved[frames] += [0.06, -0.03, 0.4]
    state = checked(records[0], replace(records[1], poses=replace(poses, pose=moved)), *records[2:])
    n = frames.stop - frames.start
    assert any(f"{n} poses" in gate.finding and gate.passed for gate in state.gates) and not state.abstains
    np.testing.assert_array_equal(state.records[1].poses.pose, np.delete(poses.pose, np.r_[frames], axis=0))
    stays = np.array(poses.pose)
    stays[start:] += [0.06, 0.0, 0.0]
    kept = checked(records[0], replace(records[1], poses=replace(poses, pose=stays)), *records[2:])
    assert len(kept.records[1].poses.time) == len(poses.time)


@pytest.mark.parametrize(("frames", "axis", "change", "fails"), [(slice(5, None, 10), 2, np.pi, True), (slice(60, None), 0, 0.1, False)])
def test_poses_that_jump_and_come_back_fail_and_a_step_that_stays_does_not(
    records: list[PushRecord], frames: slice, axis: int, change: float, fails: bool
) -> None:
    jumping = []
    for record in records:
        pose = record.poses.pose.copy()
        pose[frames, axis] += change
        jumping.append(replace(record, poses=replace(record.poses, pose=pose)))
    assert any("jump away" in found for found in failed(jumping)) is fails


def test_stage_keeps_the_pushes_that_touch_the_object(records: list[PushRecord]) -> None:
    away = replace(records[1], pusher=replace(records[1].pusher, position=records[1].pusher.position + 5.0))
    state = checked(records[0], away, *records[2:])
    assert not state.abstains and state.source_of(1) == "push 2"
    assert [record.source for record in state.records] == ["push 0", "push 2", "push 3"]


def test_poses_count_as_no_more_exact_than_the_time_steps_up_to_a_limit() -> None:
    policy, noise = GatePolicy(), NoiseModel()
    variance = np.array([2e-4, 2e-4, 2e-3]) ** 2
    problem = SimpleNamespace(noise=noise, observations=[SimpleNamespace(last_covariance=np.diag(variance))] * 3)
    fit = cast(Any, SimpleNamespace(problem=problem))
    assert noise_above_steps(fit, 0.9 * policy.max_step_effect, policy) is None
    floor = noise_above_steps(fit, 3.0 * policy.max_step_effect, policy)
    assert floor is not None
    # With the new floor in place of the old one, the same change of the ends is below the limit.
    change = 3.0 * policy.max_step_effect * np.sqrt(variance / (variance + floor.floor.diagonal() - noise.floor.diagonal()))
    assert np.all(change < policy.max_step_effect) and change == pytest.approx(0.92 * policy.max_step_effect, rel=0.05)
    assert noise_above_steps(fit, 30.0 * policy.max_step_effect, policy) is None
    assert noise_above_steps(fit, np.inf, policy) is None
