"""Whether an object was moved, from noisy poses at rest."""

from __future__ import annotations

import numpy as np

from push_ident.pushing.executed_push import RestingPose, displacement

COVARIANCE = np.diag([1e-3, 1e-3, np.radians(0.5)]) ** 2


def rest(pose: np.ndarray, n: int, rng: np.random.Generator) -> RestingPose:
    found = RestingPose()
    for k, error in enumerate(errors(n, rng)):
        found.add(float(k), pose + error, COVARIANCE)
    return found


def errors(n: int, rng: np.random.Generator) -> np.ndarray:
    """Noise of some poses, shape (n, 3); a draw for each would take most of the time of a test."""
    return rng.multivariate_normal(np.zeros(3), COVARIANCE, size=n)


def test_noise_is_no_motion_however_often_it_is_looked_at() -> None:
    rng = np.random.default_rng(0)
    pose = np.array([0.1, -0.2, np.pi])
    said = 0
    for _ in range(300):
        before, after = rest(pose, 30, rng), RestingPose()
        for k, error in enumerate(errors(30, rng)):
            after.add(float(k), pose + error, COVARIANCE)
            said += displacement(before, after)[2]
    assert said <= 3


def test_small_motion_is_seen_and_measured_across_the_wrap_of_yaw() -> None:
    rng = np.random.default_rng(1)
    pose = np.array([0.1, -0.2, np.pi])
    shift, turn, is_moved = displacement(rest(pose, 30, rng), rest(pose + np.array([0.003, 0.0, 0.02]), 30, rng))
    assert is_moved
    assert abs(shift - 0.003) < 1e-3
    assert abs(turn - 0.02) < 0.01


def test_poses_that_claim_to_be_exact_are_compared_too() -> None:
    rests = [RestingPose(), RestingPose()]
    for pose, found in zip((0.0, 0.01), rests, strict=True):
        found.add(0.0, np.array([pose, 0.0, 0.0]), np.zeros((3, 3)))
    assert displacement(*rests) == (0.01, 0.0, True)


def test_pose_that_is_not_newer_is_not_counted_twice() -> None:
    found = RestingPose()
    for _ in range(5):
        found.add(1.0, np.zeros(3), COVARIANCE)
    assert found.n == 1
