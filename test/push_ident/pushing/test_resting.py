"""Whether an object was moved, from noisy poses at rest."""

from __future__ import annotations

import numpy as np

from push_ident.pushing.executed_push import RestingPose, displacement

COVARIANCE = np.diag([1e-3, 1e-3, np.radians(0.5)]) ** 2


def rest(pose: np.ndarray, rng: np.random.Generator) -> RestingPose:
    """Thirty poses with noise."""
    found = RestingPose()
    for k, error in enumerate(rng.multivariate_normal(np.zeros(3), COVARIANCE, size=30)):
        found.add(float(k), pose + error, COVARIANCE)
    return found


def test_noise_is_no_motion_however_often_it_is_looked_at() -> None:
    rng, pose, said = np.random.default_rng(0), np.array([0.1, -0.2, np.pi]), 0
    for _ in range(300):
        before, after = rest(pose, rng), RestingPose()
        for k, error in enumerate(rng.multivariate_normal(np.zeros(3), COVARIANCE, size=30)):
            after.add(float(k), pose + error, COVARIANCE)
            said += displacement(before, after)[2]
    assert said <= 3


def test_small_motion_is_seen_and_measured_across_the_wrap_of_yaw() -> None:
    rng = np.random.default_rng(1)
    pose = np.array([0.1, -0.2, np.pi])
    shift, turn, is_moved = displacement(rest(pose, rng), rest(pose + np.array([0.003, 0.0, 0.02]), rng))
    assert is_moved and abs(shift - 0.003) < 1e-3 and abs(turn - 0.02) < 0.01


def test_exact_poses_are_compared_too_and_one_that_is_not_newer_is_not_counted_twice() -> None:
    rests = [RestingPose(), RestingPose()]
    for pose, exact in zip((0.0, 0.01), rests, strict=True):
        exact.add(0.0, np.array([pose, 0.0, 0.0]), np.zeros((3, 3)))
    assert displacement(*rests) == (0.01, 0.0, True)
    found = RestingPose()
    for _ in range(5):
        found.add(1.0, np.zeros(3), COVARIANCE)
    assert found.n == 1
