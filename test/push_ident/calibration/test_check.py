"""The errors of a calibration are found from contacts, with right deviations, and what the pushes do not show is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import hammer_shape, square
from helpers.paths import recording
from helpers.tangent_pushes import RADIUS, observed, pushes_around, tangent_push
from push_ident.bags.importers.cmu_icra16 import import_cmu_icra16
from push_ident.calibration.check import CalibrationCheck, Outcome, Verdict, check_calibration
from push_ident.calibration.contacts import contacts_of, gaps_of
from push_ident.errors import InputError
from push_ident.geometry.se2 import rotation
from push_ident.offline.loading import load_pushes
from push_ident.types import CameraAccuracy, Float64Array, PusherPath, PushRecord
from push_ident_sim.injected.into_recordings import Values, with_causes

SHIFT, TURN = np.array([4e-3, -3e-3]), 0.02
WRONG: dict[str, Values] = {
    "camera_rotation": (TURN,),
    "camera_translation": (4e-3, -3e-3),
    "outline_error": (-2e-3,),
    "pose_latency": (0.03,),
}
BY_HAND = CameraAccuracy(2e-3, 5e-3)
FRAME, SHARED = np.array([2e-4, 2e-4, 2e-3]), np.array([3e-4, 3e-4, 3e-3])
"""Standard deviations of the noise of a frame and of what the frames of a push share [m, m, rad]."""


def at_centre(check: CalibrationCheck, shift: Float64Array, turn: float) -> Float64Array:
    """What a camera with this error at the origin of the table displaces at the middle of the contacts [m]."""
    return np.asarray(rotation(turn) @ check.centre - check.centre + shift)


def noisy(n: int, seed: int, errors: Float64Array) -> list[PushRecord]:
    """Pushes around a traced hammer, with `errors` of the calibration, shape (5,), and noise; the camera is calibrated by hand."""
    rng = np.random.default_rng(seed)
    shape = replace(hammer_shape(), outline_std=np.full(len(hammer_shape().outline), 7e-4))
    pushes = [observed(r, rng, std=FRAME, shared=SHARED, camera=BY_HAND) for r in pushes_around(shape, n, rng, gap=errors[3])]
    causes: dict[str, Values] = {"camera_rotation": (errors[2],), "camera_translation": tuple(errors[:2]), "pose_latency": (errors[4],)}
    return with_causes(pushes, causes)


def outcomes(check: CalibrationCheck) -> dict[str, Outcome]:
    return {quantity.name: quantity.outcome for quantity in check.quantities}


def test_derivatives_of_gaps_are_those_of_finite_differences() -> None:
    at, step = np.array([2e-3, -1e-3, 0.02, 1e-3, 0.01]), 1e-6
    for contacts in contacts_of(pushes_around(hammer_shape(), 6, np.random.default_rng(1))):
        gaps = gaps_of(contacts, at)
        for k, axis in enumerate(np.eye(5)):
            change = gaps_of(contacts, at + step * axis).gap - gaps_of(contacts, at - step * axis).gap
            # Between two samples of its path the tool keeps its speed, whose change the derivative by the clock has.
            np.testing.assert_allclose(gaps.by_unknown[:, k], change / (2 * step), atol=2e-3 if k == 4 else 1e-6)
        for k, axis in enumerate(np.eye(3)):
            ends = [gaps_of(replace(contacts, pose=contacts.pose + sign * step * axis), at).gap for sign in (1, -1)]
            np.testing.assert_allclose(gaps.by_pose[:, k], (ends[0] - ends[1]) / (2 * step), atol=1e-6)


def test_gaps_of_a_right_calibration_are_zero_also_at_the_rest_after_a_push() -> None:
    contacts = contacts_of(pushes_around(square(), 4, np.random.default_rng(2)))
    assert len(contacts) == 4 and all(len(one) > 3 and not one.moves[-1] for one in contacts)
    assert max(np.abs(gaps_of(one, np.zeros(5)).gap).max() for one in contacts) < 2e-5


def test_all_errors_at_once_are_found_as_they_are() -> None:
    check = check_calibration(with_causes(pushes_around(hammer_shape(), 12, np.random.default_rng(3)), WRONG))
    np.testing.assert_allclose(check.unknowns[:2], at_centre(check, SHIFT, TURN), atol=5e-5)
    assert np.all(np.abs(check.unknowns[2:] - [TURN, -2e-3, 0.03]) < [2e-4, 5e-5, 5e-4])
    assert check.verdict is Verdict.DIFFERS and set(outcomes(check).values()) == {Outcome.DIFFERS}


def test_corrected_camera_is_the_true_one() -> None:
    check = check_calibration(with_causes(pushes_around(hammer_shape(), 12, np.random.default_rng(3)), WRONG))
    true, error = np.eye(4), np.eye(4)
    true[:3, 3] = 0.5, 0.1, 0.8
    error[:2, :2], error[:2, 3] = rotation(TURN), SHIFT
    corrected, accuracy = check.corrected(error @ true)
    np.testing.assert_allclose(corrected, true, atol=3e-4)
    assert 0.0 < accuracy.position < 1e-3 and 0.0 < accuracy.heading < 5e-3


def test_intervals_hold_the_truth_and_right_calibrations_are_not_called_wrong() -> None:
    """25 calibrations drawn as their accuracy states, 10 pushes each; a right check fails one of both bounds in 1 of 1000 such tests."""
    rng, within, differing = np.random.default_rng(4), [], 0
    for seed in range(25):
        errors = rng.normal(size=5) * [2e-3, 2e-3, 5e-3, 7e-4, 9.6e-3]
        check = check_calibration(noisy(10, seed, errors))
        truth = np.append(at_centre(check, errors[:2], errors[2]), errors[2:])
        within.append(np.abs(check.unknowns - truth) < 1.645 * np.sqrt(np.diag(check.covariance)))
        differing += check.verdict is Verdict.DIFFERS
    assert np.all(np.mean(within, axis=0) > 0.68) and differing <= 6


def test_a_camera_that_is_wrong_by_more_than_is_stated_is_named_and_nothing_else_is() -> None:
    check = check_calibration(noisy(10, 5, np.array([9e-3, 0.0, 0.0, 0.0, 0.0])))
    found = outcomes(check)
    assert check.verdict is Verdict.DIFFERS and found.pop("camera_x") is Outcome.DIFFERS
    assert Outcome.DIFFERS not in found.values()
    assert check.quantities[0].estimate == pytest.approx(9e-3, abs=1e-3)


def test_pushes_from_one_side_are_not_enough_and_the_next_one_comes_from_another() -> None:
    rng = np.random.default_rng(6)
    one_side = [tangent_push(square(), np.array([x, 0.0, 0.0]), 0, 0.5, turn=0.0, speed=0.1) for x in (-0.1, 0.0, 0.1)]
    check = check_calibration([observed(r, rng, std=FRAME, shared=SHARED, camera=CameraAccuracy()) for r in one_side])
    assert check.verdict is Verdict.NOT_ENOUGH and check.next_push is not None
    into = -gaps_of(check.contacts[0], check.unknowns).outward[0]
    assert into @ check.next_push.towards < 0.5 and check.next_push.std_after < 0.1 * check.next_push.std


def test_without_motion_or_with_another_tool_there_is_nothing_to_check() -> None:
    record = tangent_push(square(), np.zeros(3), 0, 0.5, turn=0.0, speed=0.1)
    still = replace(record, poses=replace(record.poses, pose=np.zeros_like(record.poses.pose)))
    with pytest.raises(InputError, match="none of 1 pushes shows a contact"):
        check_calibration([still])
    path = record.pusher
    prism = PusherPath(path.time, path.position, RADIUS, polygon=np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]]))
    with pytest.raises(InputError, match="no cylinder"):
        check_calibration([replace(record, pusher=prism)])


def test_an_object_that_was_left_behind_shows_no_rest_against_the_tool() -> None:
    record = tangent_push(square(), np.zeros(3), 0, 0.5, turn=0.0, speed=0.1)
    (touching,) = contacts_of([record])
    half = int(np.argmax(record.poses.pose[:, 1] > 0.02))
    pose = record.poses.pose.copy()
    pose[half:] = pose[half]
    (left,) = contacts_of([replace(record, poses=replace(record.poses, pose=pose))])
    assert not touching.moves[-1] and np.all(left.moves)


def test_contradicting_pushes_are_no_calibration() -> None:
    pushes = pushes_around(square(), 6, np.random.default_rng(7))
    mirrored = [replace(r, pusher=replace(r.pusher, position=r.pusher.position * [1.0, -1.0])) for r in pushes]
    check = check_calibration(mirrored)
    assert check.verdict is Verdict.NOT_ENOUGH and check.warnings and set(outcomes(check).values()) == {Outcome.UNKNOWN}


def test_a_displacement_put_into_real_pushes_is_found_and_none_without_it(tmp_path: Path) -> None:
    """Aluminium triangle on hardboard, 30 pushes (CMU, ICRA 2016), of which only the poses at rest are known."""
    import_cmu_icra16(recording("cmu_icra16", "30_90_30_30_30_90__exp_08_11_30.txt"), tmp_path / "bag")
    pushes = load_pushes([tmp_path / "bag"]).records
    right, wrong = check_calibration(pushes), check_calibration(with_causes(pushes, {"camera_translation": (3e-3, -2e-3)}))
    assert right.verdict is Verdict.AGREES and wrong.verdict is Verdict.DIFFERS
    np.testing.assert_allclose(wrong.unknowns[:2] - right.unknowns[:2], [3e-3, -2e-3], atol=1e-4)
    assert "clock" not in outcomes(right)
