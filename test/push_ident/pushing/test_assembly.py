"""Streams fall into the same pushes as a bag does."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import hammer_shape
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


@pytest.mark.parametrize("ahead", ["pose", "pusher"])
def test_order_among_topics_does_not_matter(ahead: str) -> None:
    """After a stall, or from a bag played fast, one topic may be seconds ahead of the others."""
    pose_times, pusher_times = times(0, 10), times(2, 3) + times(6, 7)
    expected = play(pose_times, pusher_times)
    assembler = PushAssembler()
    assembler.set_shape("o1", hammer_shape())
    assembler.set_radius(0.01)
    kinds = {"pose": pose_times, "pusher": pusher_times}
    messages = [(ahead, t) for t in kinds.pop(ahead)] + [(kind, t) for kind, values in kinds.items() for t in values]
    pushes = []
    for number, (kind, time) in enumerate(messages):
        if number == len(messages) // 2:
            assembler.end_push(2.95)
            assembler.end_push(6.95)
        if kind == "pose":
            assert assembler.add_pose("o1", time, np.array([0.01 * time, 0.0, 0.0]), COVARIANCE)
        else:
            assert assembler.add_pusher(time, np.array([0.1 * time, 0.2]))
    for _ in range(5):
        pushes += assembler.finished()
    assert assembler.run == 1
    assert len(pushes) == len(expected) == 2
    for (push,), (other,) in zip(pushes, expected, strict=True):
        assert np.array_equal(push.poses.time, other.poses.time) and np.array_equal(push.pusher.time, other.pusher.time)


def test_push_that_failed_is_left_out_as_from_a_bag() -> None:
    assembler = PushAssembler()
    assembler.set_shape("o1", hammer_shape())
    assembler.set_radius(0.01)
    for time in times(0, 10):
        assembler.add_pose("o1", time, np.array([0.01 * time, 0.0, 0.0]), COVARIANCE)
    for time in times(2, 3) + times(6, 7):
        assembler.add_pusher(time, np.array([0.1 * time, 0.2]))
    assembler.end_push(2.95, failed_since=2.0)
    assembler.end_push(6.95)
    ((push,),) = assembler.finished(flush=True)
    assert push.pusher.time[0] == 6.0 and assembler.n_failed == 1


def test_push_is_not_handed_out_before_the_forces_on_its_way() -> None:
    assembler = PushAssembler()
    assembler.set_shape("o1", hammer_shape())
    assembler.add_wrench(0.0, np.zeros(2))
    for time in times(0, 5):
        assembler.add_pose("o1", time, np.zeros(3), COVARIANCE)
        if 1 <= time <= 2:
            assembler.add_pusher(time, np.array([time, 0.0]))
    assert assembler.finished() == []
    for time in times(0.05, 5):
        assembler.add_wrench(time, np.array([time, 0.0]))
    pushes = [push for _ in range(5) for push in assembler.finished()]
    assert len(pushes) == 1 and pushes[0][0].wrench is not None and len(pushes[0][0].wrench.time) == 21


def test_looped_bag_drops_what_a_slower_topic_still_had_to_say_of_the_run_before() -> None:
    assembler = PushAssembler()
    assembler.set_shape("o1", hammer_shape())
    for time in times(0, 10):
        assembler.add_pose("o1", time, np.zeros(3), COVARIANCE)
    for time in times(2, 7):
        assembler.add_pusher(time, np.zeros(2))
    assert assembler.add_pose("o1", 0.0, np.zeros(3), COVARIANCE) and assembler.run == 2
    assert not assembler.add_pusher(7.05, np.zeros(2))
    assert assembler.add_pusher(2.0, np.zeros(2)) and assembler.run == 2
    assert assembler.now == 2.0
