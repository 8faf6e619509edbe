"""Paths whose stamps jitter."""

from pathlib import Path

import numpy as np

from helpers.bags import COVARIANCE, L_SHAPE
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.bags.writer import BagWriter
from push_ident.pushing.regular_path import regular_path
from push_ident.types import PusherPath

TAKEN = 0.004 * np.arange(150)
ALONG = 0.1 * np.clip(TAKEN - 0.1, 0.0, 0.4)
"""A start, 40 mm at 0.1 m/s, and a stop [m]."""
ARRIVED = np.sort(TAKEN + np.random.default_rng(3).uniform(0.0, 0.0039, len(TAKEN)))


def path(time: np.ndarray) -> PusherPath:
    return PusherPath(time, np.column_stack([ALONG, -0.5 * ALONG]), 0.005)


def test_a_path_with_jitter_has_the_speed_of_the_arm_and_ends_where_it_ended() -> None:
    exact = path(TAKEN)
    assert regular_path(exact) is exact
    smooth = regular_path(path(ARRIVED))
    speed = np.linalg.norm(np.diff(smooth.position, axis=0), axis=1) / np.diff(smooth.time)
    assert speed.max() < 1.1 * 0.1 * np.hypot(1.0, 0.5)
    at_true_times = np.interp(TAKEN + 0.002, smooth.time, smooth.position[:, 0])  # the mean delay remains
    assert np.abs(at_true_times - ALONG).max() < 0.1 * 0.004  # as far as the arm moves between two samples
    assert np.abs(smooth.position[-1] - exact.position[-1]).max() < 1e-4


def test_pushes_of_a_bag_say_that_their_paths_are_smoothed(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        for time in (1.0, 3.0):
            writer.write_pose("7", time, (0.0, 0.0, 0.0), COVARIANCE)
        for stamp, x in zip(ARRIVED, ALONG, strict=True):
            writer.write_pusher(2.0 + stamp, (x, 0.0))
    contents = read_bag(tmp_path / "bag")
    (record,) = split_pushes(contents, "7")
    assert len(record.pusher.time) == len(ARRIVED)
    assert any("jitter in 1 of 1 pushes" in note for note in contents.notes)
