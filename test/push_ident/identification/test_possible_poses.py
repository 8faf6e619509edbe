"""Poses that no push can have made are left out, or the push is refused; all others are learned, the surprising ones too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes
from helpers.objects import with_frames
from push_ident.identification.observing.observation import rest_frames
from push_ident.identification.online.session import ObjectSession, SessionOptions
from push_ident.identification.predicting.possible_poses import ImpossiblePosesError, check_poses, why_no_object_ends_there
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.types import Float64Array, PushRecord

ASIDE, AROUND = np.array([0.15, 0.2, 0.0]), np.array([0.0, 0.0, np.pi])
PUSHES = simulated_pushes(4, 3)


def displaced(record: PushRecord, frames: slice | np.ndarray, by: Float64Array, *, covariance: Float64Array | None = None) -> PushRecord:
    pose, covariances = record.poses.pose.copy(), record.poses.covariance.copy()
    pose[frames] += by
    if covariance is not None:
        covariances[frames] = covariance
    return replace(record, poses=replace(record.poses, pose=pose, covariance=covariances))


def middle(record: PushRecord) -> int:
    """A frame in the middle of the motion."""
    before, after, _ = rest_frames(record)
    return int(before[-1] + after[0] + 1) // 2


def why(record: PushRecord) -> str:
    checked = check_poses(record)
    return checked.why or why_no_object_ends_there(checked.record, prior_posterior(record.shape, Prior()), Prior())


def test_pushes_as_they_were_are_possible_to_the_last_pose(pushes: list[PushRecord]) -> None:
    assert [check_poses(record).record is record for record in pushes] == [True] * len(pushes)
    assert [why(record) for record in pushes] == [""] * len(pushes)


@pytest.mark.parametrize("by", [ASIDE, AROUND], ids=["25 cm aside", "half a turn"])
def test_push_whose_pose_jumps_and_stays_there_is_impossible_also_where_only_its_ends_are_known(
    pushes: list[PushRecord], by: Float64Array
) -> None:
    for record in pushes:
        before, after, _ = rest_frames(record)
        ends = with_frames(record, np.array([before[-1], after[-1]]))
        assert why(displaced(record, slice(middle(record), None), by)) and why(displaced(ends, slice(1, None), by)) and why(ends) == ""


@pytest.mark.parametrize("by", [np.array([0.05, 0.0, 0.0]), AROUND], ids=["5 cm", "half a turn"])
def test_excursion_of_0_4_s_is_left_out_and_named_and_the_rest_stays(by: Float64Array) -> None:
    for record in PUSHES:
        frames = slice(middle(record) - 6, middle(record) + 6)
        checked = check_poses(displaced(record, frames, by))
        kept = np.delete(np.arange(len(record.poses.time)), frames)
        assert checked.why == "" and checked.n_left_out == 12
        np.testing.assert_array_equal(checked.record.poses.time, record.poses.time[kept])
        np.testing.assert_allclose(checked.record.poses.pose, record.poses.pose[kept], atol=1e-12)
        assert f"12 of {len(record.poses.time)} poses" in checked.note and "no push can have made them" in checked.note


def test_single_wrong_poses_anywhere_are_left_out() -> None:
    record, n = PUSHES[0], len(PUSHES[0].poses.time)
    for wrong in (np.array([0, 7, middle(record), n - 1]), np.arange(3, n, 7)):  # the latter as the flips of a tracker
        checked = check_poses(displaced(record, wrong, AROUND))
        assert checked.n_left_out == len(wrong) and not np.any(np.isin(record.poses.time[wrong], checked.record.poses.time))


def test_poses_that_contradict_each_other_in_most_of_a_push_or_a_rest_are_not_believed() -> None:
    record = PUSHES[0]
    rng = np.random.default_rng(0)
    pose = record.poses.pose + np.column_stack([rng.normal(0.0, 0.05, (len(record.poses.pose), 2)), np.zeros(len(record.poses.pose))])
    assert check_poses(replace(record, poses=replace(record.poses, pose=pose))).why
    before, after, _ = rest_frames(record)
    assert "before the contact" in check_poses(displaced(record, slice(0, before[-1] - 1), ASIDE)).why
    assert "stays there to the end" in check_poses(displaced(record, slice(after[0] + 1, None), ASIDE)).why


def test_pose_of_which_nothing_is_known_is_neither_impossible_nor_a_bridge() -> None:
    record, unknown = PUSHES[0], np.eye(3)
    wild = slice(middle(record), middle(record) + 5)
    assert why(displaced(record, slice(None), np.zeros(3), covariance=unknown)) == ""
    checked = check_poses(displaced(record, wild, ASIDE, covariance=unknown))
    assert checked.why == "" and checked.note == "" and checked.n_left_out == 0
    assert not np.any(np.isin(record.poses.time[wild], checked.record.poses.time))
    bridged = displaced(record, slice(wild.stop, None), ASIDE)
    assert "stays there to the end" in check_poses(displaced(bridged, wild, 0.5 * ASIDE, covariance=unknown)).why


def test_noise_of_five_times_the_stated_one_stamps_in_bursts_and_missing_frames_are_no_jump() -> None:
    for record in (*PUSHES, *simulated_pushes(4, 5, noise=np.array([2e-4, 2e-4, 1e-3]))):
        before, after, _ = rest_frames(record)
        poses, hidden = record.poses, with_frames(record, np.concatenate([before, after]))
        time = poses.time.copy()
        time[2::3] = time[1::3][: len(time[2::3])] + 1e-3  # every third pose arrives together with the one before
        noisy = replace(record, poses=replace(poses, covariance=poses.covariance / 25.0))
        for changed in (noisy, replace(record, poses=replace(poses, time=time))):
            assert check_poses(changed).record.poses.time.size == time.size
        assert check_poses(hidden).record is hidden and why(hidden) == ""


def test_estimate_is_that_without_the_impossible_push_and_without_an_excursion() -> None:
    session, other = (ObjectSession("o1", PUSHES[0].shape, SessionOptions()) for _ in range(2))
    frames = slice(middle(PUSHES[0]) - 6, middle(PUSHES[0]) + 6)
    assert session.finish(displaced(PUSHES[0], frames, ASIDE)) is not None
    assert session.checked is not None and session.checked.n_left_out == 12
    jumping = displaced(PUSHES[1], slice(middle(PUSHES[1]), None), ASIDE)
    assert session.update(with_frames(jumping, np.arange(middle(PUSHES[1]) + 4))) is None
    with pytest.raises(ImpossiblePosesError, match="no push can have made its poses: its pose moves by 2"):
        session.finish(jumping)
    other.finish(with_frames(PUSHES[0], np.delete(np.arange(len(PUSHES[0].poses.time)), frames)))
    scores = [one.finish(PUSHES[2]) for one in (session, other)]
    assert all(score is not None and score.explained for score in scores) and session.n_pushes == 2
    np.testing.assert_array_equal(session.posterior.z, other.posterior.z)
