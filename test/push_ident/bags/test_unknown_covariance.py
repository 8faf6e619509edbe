"""Poses without a covariance: their noise is that of their rests, and the maps are those of a bag that states it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.bags import copy_with_covariances
from helpers.objects import hammer, random_records, with_frames
from push_ident.bags.read_options import ReadOptions
from push_ident.bags.records import write_records
from push_ident.cli.identify import read_options
from push_ident.errors import BagError, InputError
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.offline.loading import load_pushes
from push_ident.types import PoseTrack, PushRecord

N_REST = 12
"""Frames at rest before each push and after it."""


def with_rests(record: PushRecord, rng: np.random.Generator) -> PushRecord:
    """The same push with frames at rest around it, at its rate, with the noise that it states."""
    poses, n = record.poses, N_REST
    step, std = np.median(np.diff(poses.time)), np.sqrt(np.diag(poses.covariance[0]))
    before, after = poses.time[0] - step * np.arange(n, 0, -1), poses.time[-1] + step * np.arange(1, n + 1)
    still = [pose + std * rng.normal(size=(n, 3)) for pose in poses.pose[[0, -1]]]
    covariance = np.repeat(poses.covariance[:1], len(poses.time) + 2 * n, axis=0)
    track = PoseTrack(np.r_[before, poses.time, after], np.vstack([still[0], poses.pose, still[1]]), covariance)
    return replace(record, poses=track)


@pytest.fixture(scope="module")
def pushed() -> list[PushRecord]:
    rng = np.random.default_rng(1)
    return [with_rests(record, rng) for record in random_records(hammer(0), 8, 0)]


@pytest.fixture(scope="module")
def bag(pushed: list[PushRecord], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stated") / "bag"
    write_records(path, pushed)
    return path


def nothing(covariance: Any) -> None:
    covariance[:] = 0.0


def not_estimated(covariance: Any) -> None:
    """As sensor_msgs/Imu writes it."""
    covariance[:] = 0.0
    covariance[0] = -1.0


def no_yaw(covariance: Any) -> None:
    covariance[[5, 11, 17, 23, 29, *range(30, 36)]] = 0.0


def no_position(covariance: Any) -> None:
    covariance[:30] = 0.0
    covariance[30:35] = 0.0


@pytest.mark.parametrize(
    ("change", "lacks"),
    [
        (nothing, "a covariance"),
        (not_estimated, "a covariance"),
        (no_yaw, "a variance of the yaw"),
        (no_position, "a covariance of x and y"),
    ],
)
def test_noise_is_that_of_the_rests_and_a_note_says_so(bag: Path, tmp_path: Path, change: Callable[[Any], None], lacks: str) -> None:
    stated, loaded = load_pushes([bag]), load_pushes([copy_with_covariances(bag, tmp_path / "bag", change)])
    true, found = (np.sqrt(np.diag(pushes.records[0].poses.covariance[0])) for pushes in (stated, loaded))
    # Some 190 frames of 8 pushes: 4 to 5 % of a standard deviation.
    assert found == pytest.approx(true, rel=0.15)
    known = {no_yaw: [0, 1], no_position: [2]}.get(change, [])
    assert found[known] == pytest.approx(true[known], rel=1e-9)
    n = sum(len(record.poses.time) for record in stated.records)
    (first, second) = [note for note in loaded.notes if "lack" in note]
    assert first == f"bag: object {stated.object_id}: {n} of {n} poses lack {lacks}, which is zero or none."
    assert "standard deviations" in second and "frames at rest" in second and "--pose-std" in second
    assert not [note for note in stated.notes if "lack" in note]


def test_maps_are_those_of_a_bag_that_states_its_noise(bag: Path, tmp_path: Path) -> None:
    errors, stds = [], []
    for path in (bag, copy_with_covariances(bag, tmp_path / "bag", nothing)):
        records = load_pushes([path]).records
        result = identify(records[:4])
        errors.append(float(np.mean(held_out_errors(result.model, records[4:]))))
        stds.append(float(np.mean(np.sqrt(np.diag(result.posterior.covariance)))))
    assert errors[1] == pytest.approx(errors[0], rel=0.1, abs=1e-4) and stds[1] == pytest.approx(stds[0], rel=0.1)


def test_of_end_poses_nothing_shows_the_noise_and_the_error_says_what_to_state(pushed: list[PushRecord], tmp_path: Path) -> None:
    write_records(tmp_path / "ends", [with_frames(record, [0, -1]) for record in pushed])
    ends = copy_with_covariances(tmp_path / "ends", tmp_path / "bag", nothing)
    with pytest.raises(BagError, match=r"its poses lack a covariance, and 0 of its frames at rest.*--pose-std METRES,RADIANS"):
        load_pushes([ends])
    loaded = load_pushes([ends], options=read_options(None, None, "1mm,0.5deg"))
    assert len(loaded) == len(pushed)
    assert np.sqrt(np.diag(loaded.records[0].poses.covariance[0])) == pytest.approx([1e-3, 1e-3, np.radians(0.5)])
    assert any("as given" in note for note in loaded.notes)


def test_poses_without_a_covariance_take_that_of_the_others(bag: Path, tmp_path: Path) -> None:
    chosen = iter((np.random.default_rng(2).random(10_000) < 0.1).tolist())

    def some(covariance: Any) -> None:
        if next(chosen):
            covariance[:] = 0.0

    (stated, *_), (found, *_) = (load_pushes([path]).records for path in (bag, copy_with_covariances(bag, tmp_path / "bag", some)))
    np.testing.assert_allclose(found.poses.covariance, stated.poses.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("wrong", [(0.0, 0.1), (1e-3, np.nan), (np.inf, 0.1), (-1.0, 0.1)])
def test_standard_deviations_that_are_none_are_refused(wrong: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="expected two positive numbers"):
        ReadOptions(pose_std=wrong)
