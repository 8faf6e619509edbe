"""Pushes from arrays in memory, and their check."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import push_ident as pi
from helpers.objects import hammer, random_records
from helpers.recordings import tracked_rows
from push_ident.errors import InputError, PushIdentError
from push_ident.types import PushRecord


@pytest.fixture(scope="module")
def pushed() -> list[PushRecord]:
    return random_records(hammer(3), 6, 3, noise=0.2)


@pytest.fixture(scope="module")
def arrays(pushed: list[PushRecord]) -> dict[str, Any]:
    poses, pusher = tracked_rows(pushed)
    return {
        "time": poses[:, 0], "pose": poses[:, 1:4], "pusher_time": pusher[:, 0], "pusher": pusher[:, 1:3], "push": pusher[:, 3],
        "outline": pushed[0].shape.outline, "radius": 0.008, "pose_std": (2e-4, 2e-3),
    }  # fmt: skip


@dataclass
class Frame:
    """What a frame of pandas has that matters here."""

    of: dict[str, Any]

    @property
    def columns(self) -> list[str]:
        return list(self.of)

    def __getitem__(self, names: list[str]) -> Any:
        return np.column_stack([self.of[name] for name in names])


def test_a_long_recording_becomes_its_pushes(pushed: list[PushRecord], arrays: dict[str, Any], tmp_path: Path) -> None:
    pushes = pi.records(**arrays)
    assert len(pushes) == len(pushed) and 50 <= len(pushes[0].shape.cells) <= 150
    for push, true in zip(pushes, pushed, strict=True):
        np.testing.assert_allclose(push.poses.pose[[0, -1], :2], true.poses.pose[[0, -1], :2], atol=2e-3)
    checked = pi.check(pushes, page=tmp_path / "check.html")
    assert checked.agrees and "they agree" in (tmp_path / "check.html").read_text()


def test_frames_of_pandas_are_taken_and_lost_poses_left_out(arrays: dict[str, Any]) -> None:
    x, y, yaw = arrays["pose"].T
    lost = np.where(np.arange(len(x)) == 40, np.nan, x)
    frame = Frame({"time": arrays["time"], "yaw": yaw, "x": lost, "y": y, "quality": [object()] * len(x)})
    pushes = pi.records(**{**arrays, "pose": frame})
    assert len(pushes) == 6 and any("1 of" in note and "left out" in note for note in pushes.notes)


def test_one_push_is_one_record(pushed: list[PushRecord]) -> None:
    push = pushed[0]
    given = (push.poses.time + 2.0, push.poses.pose, push.pusher.time + 2.0, push.pusher.position)
    made = pi.record(*given, outline=push.shape.outline, radius=0.008, pose_std=(2e-4, 2e-3))
    np.testing.assert_allclose(made.poses.pose[-1], push.poses.pose[-1], atol=5e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"pose": np.zeros((5, 2))}, r"`pose` has shape \(5, 2\), expected \(n, 3\): x, y, yaw"),
        ({"pose": "poses.csv"}, "`pose` is a str, expected an array"),
        ({"time": np.arange(3.0)}, "rows, its time 3"),
        ({"wrench": np.zeros((5, 2))}, "expected .n, 3.: time, fx, fy"),
        ({"outline": np.zeros((0, 2))}, "outline"),
        ({"pusher": [[0.0, 1.0], [2.0]]}, "`pusher` is a list"),
    ],
)
def test_other_types_and_shapes_end_in_one_line(arrays: dict[str, Any], change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        pi.records(**{**arrays, **change})


def test_a_clock_that_is_wrong_is_said_with_a_page(arrays: dict[str, Any], tmp_path: Path) -> None:
    pushes = pi.records(**{**arrays, "time": arrays["time"] + 0.1})
    checked = pi.check(pushes, page=tmp_path / "check.html")
    page = (tmp_path / "check.html").read_text()
    assert not checked.agrees and "clock" in repr(checked) and "the clock of the pusher is 0.1" in page and "--time-offset" not in page
    with pytest.raises(InputError, match="no push to check"):
        pi.check([])


def test_errors_of_arrays_name_arguments_of_python(arrays: dict[str, Any]) -> None:
    for wrong, says in (
        ({"pose_std": 5e-4}, "`pose_std` is 0.0005, expected two numbers above 0"),
        ({"pose_std": (1e-3, 1e-3, 5e-3)}, "expected two numbers above 0"),
        ({"radius": 4.75}, "Pusher"),
    ):
        with pytest.raises(PushIdentError, match=says) as error:
            pi.records(**{**arrays, **wrong})
        assert "--" not in str(error.value) and "/tmp" not in str(error.value)


def test_a_result_is_saved_and_a_planned_push_has_the_pusher_of_the_pushes(pushed: list[PushRecord], tmp_path: Path) -> None:
    result = pi.identify(pushed[:2])
    path = pi.save(result, tmp_path / "models" / "thing.json", "thing")
    assert "thing" in path.read_text()
    path_of_push = [(-0.3, 0.01), (-0.1, 0.01)]
    planned = pi.predict(result, pose=(0, 0, 0), path=path_of_push, speed=0.1)
    assert planned.path.radius == pushed[0].pusher.radius
    assert len(planned.outcomes) != 1 or np.array_equal(planned.outcomes[0].end, planned.prediction.pose[-1])
    assert pi.predict(path, pose=(0, 0, 0), path=path_of_push, speed=0.1, radius=0.01).path.radius == 0.01
