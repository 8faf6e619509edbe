"""Streams fall into the same pushes as a bag does."""

from __future__ import annotations

import numpy as np
import pytest
from objects import hammer_shape

from push_ident.pushing.assembly import PushAssembler
from push_ident.types import PushRecord

COVARIANCE = np.diag([1e-6, 1e-6, 1e-4])


def play(pose_times: list[float], pusher_times: list[float], *, flush: bool = False) -> list[list[PushRecord]]:
    assembler = PushAssembler()
    assembler.set_shape("o1", hammer_shape())
    assembler.set_radius(0.01)
    pushes = []
    for time, kind in sorted([(t, "pose") for t in pose_times] + [(t, "pusher") for t in pusher_times]):
        if kind == "pose":
            assembler.add_pose("o1", time, np.array([0.01 * time, 0.0, 0.0]), COVARIANCE)
        else:
            assembler.add_pusher(time, np.array([0.1 * time, 0.2]))
        pushes += assembler.finished()
    return pushes + assembler.finished(flush=flush)


def times(start: float, end: float, rate: float = 20.0) -> list[float]:
    return list(np.arange(start, end, 1 / rate))


def test_pause_of_the_pusher_tells_pushes_apart() -> None:
    pushes = play(times(0, 10), times(2, 3) + times(6, 7))
    assert len(pushes) == 2
    first, second = pushes[0][0], pushes[1][0]
    assert first.pusher.time[[0, -1]] == pytest.approx([2.0, 2.95])
    assert first.poses.time[0] >= 1.5 and first.poses.time[-1] <= 3.5
    assert second.poses.time[0] >= 5.5 and second.poses.time[-1] <= 7.5


def test_object_hidden_around_a_push_is_taken_from_where_it_was_seen_last_and_next() -> None:
    (push,) = play(times(0, 1) + times(5, 6), times(2, 3))
    assert push[0].poses.time == pytest.approx([0.95, 5.0])


def test_pose_nearer_to_another_push_is_not_taken() -> None:
    pushes = play([*times(0, 1), 5.5, *times(9, 10)], times(2, 3) + times(5, 6))
    assert pushes[0] == [] and pushes[1][0].poses.time == pytest.approx([5.5, 9.0])


def test_push_under_way_grows() -> None:
    assembler = PushAssembler()
    assembler.set_shape("o1", hammer_shape())
    lengths = []
    for time in times(0, 2):
        assembler.add_pose("o1", time, np.zeros(3), COVARIANCE)
        if time > 1:
            assembler.add_pusher(time, np.array([time, 0.0]))
            partial = assembler.partial("o1")
            lengths.append(0 if partial is None else len(partial.pusher.time))
    assert lengths == sorted(lengths) and lengths[-1] > 10
    assert assembler.finished() == []


def test_end_of_the_stream_needs_a_flush_and_is_handed_out_once() -> None:
    assert play(times(0, 3), times(2, 3)) == []
    assert len(play(times(0, 3), times(2, 3), flush=True)) == 1


def test_reset_forgets_what_was_under_way() -> None:
    assembler = PushAssembler()
    assembler.set_shape("o1", hammer_shape())
    assembler.add_pusher(5.0, np.zeros(2))
    assembler.reset()
    assert assembler.finished(flush=True) == [] and assembler.partial("o1") is None
