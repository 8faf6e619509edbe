"""The noise of poses from frames at rest, and which frames these are."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.pushing.pose_noise import LEAST_POSITION_STD, LEAST_YAW_STD, PAUSE, PoseNoise, pusher_moves
from push_ident.types import Float64Array

STD = np.array([1e-3, 1e-3, 8e-3])
UNKNOWN = np.zeros((3, 3))


def rests(noise: PoseNoise, n_rests: int, n_frames: int, *, std: Float64Array = STD, drift: Float64Array | None = None) -> None:
    """Rests in other places and headings, also across half a turn; `drift` of a frame to the next."""
    rng = np.random.default_rng(n_rests)
    time = 0.0
    for _ in range(n_rests):
        time += 5.0
        pose = np.array([*rng.uniform(-0.2, 0.2, 2), np.pi])
        for frame in range(n_frames):
            time += 1 / 30
            observed = pose + std * rng.normal(size=3) + (0.0 if drift is None else frame * drift)
            observed[2] = (observed[2] + np.pi) % (2 * np.pi) - np.pi
            noise.state(UNKNOWN)
            noise.add(time, observed, moves=False, pause=PAUSE)


@pytest.mark.parametrize(("n_rests", "n_frames"), [(60, 2), (40, 4), (10, 15), (3, 200)])
def test_short_rests_show_the_noise_as_long_ones_do(n_rests: int, n_frames: int) -> None:
    noise = PoseNoise()
    rests(noise, n_rests, n_frames)
    assert noise.is_needed and noise.std() == pytest.approx((1e-3, 8e-3), rel=0.12)


def test_frames_in_which_the_object_is_carried_elsewhere_are_outvoted() -> None:
    noise = PoseNoise()
    rests(noise, 20, 15)
    alone = noise.std()
    rests(noise, 5, 15, drift=np.array([5e-3, 0.0, 0.02]))
    assert noise.std() == pytest.approx(alone, rel=0.15)


def test_what_does_not_scatter_is_not_known_exactly() -> None:
    noise = PoseNoise()
    rests(noise, 3, 15, std=np.zeros(3))
    assert noise.std() == (LEAST_POSITION_STD, LEAST_YAW_STD)


@pytest.mark.parametrize(("n_rests", "n_frames", "is_enough"), [(9, 1, False), (1, 9, False), (1, 10, True), (4, 3, False), (5, 3, True)])
def test_nine_frames_that_follow_another_one_are_enough(n_rests: int, n_frames: int, is_enough: bool) -> None:
    noise = PoseNoise()
    rests(noise, n_rests, n_frames)
    assert (noise.std() is not None) == is_enough and (noise.filled(UNKNOWN) is not None) == is_enough
    assert (f"{n_rests * (n_frames - 1)} of its frames at rest follow another one" in noise.text()) == (not is_enough)


def test_frames_that_move_belong_to_no_rest() -> None:
    noise = PoseNoise()
    for k in range(200):
        noise.state(UNKNOWN)
        noise.add(k / 30, np.array([0.01 * k, 0.0, 0.0]), moves=k % 2 == 0, pause=PAUSE)
    assert noise.std() is None


def test_only_what_is_not_stated_is_filled() -> None:
    noise = PoseNoise()
    rests(noise, 10, 15)
    full = np.diag([4e-6, 5e-6, 6e-5]) + 1e-7
    assert noise.filled(full) is full
    no_yaw = full.copy()
    no_yaw[2], no_yaw[:, 2] = 0.0, 0.0
    found = noise.filled(np.array([no_yaw, UNKNOWN, full]))
    assert found is not None and np.linalg.eigvalsh(found).min() > 0
    np.testing.assert_array_equal(found[0, :2, :2], full[:2, :2])
    np.testing.assert_array_equal(found[2], full)
    assert np.sqrt(found[:2, 2, 2]) == pytest.approx(STD[2], rel=0.15) and np.sqrt(found[1, 0, 0]) == pytest.approx(STD[0], rel=0.15)


def test_pusher_moves_between_its_pauses_and_nowhere_else() -> None:
    """It drives from 2 to 3 s, is not heard from 4 to 10 s, and then stands elsewhere."""
    time = np.r_[np.arange(1.0, 4.0, 0.01), np.arange(10.0, 11.0, 0.01)]
    x = np.where(time > 9.0, 0.3, 0.1 * np.clip(time - 2.0, 0.0, 1.0))
    path = np.column_stack([time, x, np.zeros_like(time)])
    frames = np.array([0.0, 1.5, 1.9, 2.5, 3.1, 3.5, 4.2, 7.0, 9.9, 10.5, 20.0])
    noisy = path + np.random.default_rng(0).normal(scale=[0.0, 5e-4, 5e-4], size=path.shape)
    for one in (path, noisy):
        assert pusher_moves(frames, one, PAUSE).tolist() == [False, False, True, True, True, *[False] * 6]
    assert not pusher_moves(frames, path[:0], PAUSE).any()
