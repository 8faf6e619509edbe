"""Streams are cut into the same pushes, live and from a bag."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.objects import hammer_shape
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import BagContents, ObjectTrack, Samples
from push_ident.errors import BagError
from push_ident.pushing.cutter import CutPush, PushCutter, PushInterval
from push_ident.types import PusherShape, PushRecord

COVARIANCE = np.diag([1e-6, 1e-6, 1e-4])


def cutter_of(*names: str) -> PushCutter:
    cutter = PushCutter()
    cutter.set_radius(0.01)
    for name in names:
        cutter.set_shape(name, hammer_shape())
    return cutter


def times(start: float, end: float, rate: float = 20.0) -> list[float]:
    return list(np.arange(start, end, 1 / rate))


@pytest.mark.parametrize("back", [1.5, 10.0, 50.0])
def test_one_late_message_does_not_shut_out_the_streams_that_go_on(back: float) -> None:
    """Only the push of that moment may be lost: a record or a force with an old stamp is no clock that was set back."""
    cutter, pushes = cutter_of("o1"), []
    for i, time in enumerate(times(60, 80)):
        cutter.add_pose("o1", time, np.array([0.01 * time, 0.0, 0.0]), COVARIANCE)
        if int(time) in (62, 66, 70):
            cutter.add_pusher(time, np.array([0.1 * time, 0.2]))
            cutter.add_wrench(time, np.zeros(2))
        if i in (0, 50):
            cutter.add_record(PushInterval(9, "o1", time - 0.1 - back * (i > 0), time - back * (i > 0), 0))
        pushes += cutter.finished()
    assert [round(push.interval.start) for push in pushes if push.records][-2:] == [66, 70]


def test_fingers_have_the_heading_of_their_poses_through_half_a_turn_and_a_cylinder_has_none() -> None:
    fingers = PusherShape(0.003, fingers=np.array([[0.0, 0.01], [0.0, -0.01]]))
    for shape in (fingers, PusherShape(0.003)):
        cutter = cutter_of("o1")
        cutter.set_pusher_shape(shape)
        for time in times(0, 4):
            cutter.add_pose("o1", time, np.array([0.01 * time, 0.0, 0.0]), COVARIANCE)
            if 1 < time < 2:
                yaw = 1.6 + time
                cutter.add_pusher(time, np.array([time, 0.0, np.arctan2(np.sin(yaw), np.cos(yaw))]))
        (push,) = cutter.finished(flush=True)
        path = push.records[0].pusher
        if shape is fingers:
            assert path.fingers is not None and path.yaw == pytest.approx(1.6 + path.time, abs=1e-9)
        else:
            assert path.fingers is None and path.yaw is None and path.radius == 0.003


def test_unfinished_push_grows() -> None:
    cutter, lengths = cutter_of("o1"), []
    for time in times(0, 2):
        cutter.add_pose("o1", time, np.zeros(3), COVARIANCE)
        if time > 1:
            cutter.add_pusher(time, np.array([time, 0.0]))
            record = cutter.partial("o1")
            lengths.append(0 if record is None else len(record.pusher.time))
    assert lengths == sorted(lengths) and lengths[-1] > 10
    assert cutter.finished() == []
    cutter.reset()
    assert cutter.finished(flush=True) == [] and cutter.partial("o1") is None


def test_looped_bag_drops_what_a_slower_topic_still_had_to_say_of_the_run_before() -> None:
    cutter = cutter_of("o1")
    for time in times(0, 10):
        cutter.add_pose("o1", time, np.zeros(3), COVARIANCE)
    for time in times(2, 7):
        cutter.add_pusher(time, np.zeros(2))
    assert cutter.add_pose("o1", 0.0, np.zeros(3), COVARIANCE) and cutter.run == 2
    assert not cutter.add_pusher(7.05, np.zeros(2))
    assert cutter.add_pusher(2.0, np.zeros(2)) and cutter.run == 2
    assert cutter.now == 2.0


@dataclass
class Cell:
    """What the topics of a cell deliver, each in order of time."""

    poses: dict[str, list[float]]
    pusher: list[float]
    wrench: list[float]
    records: list[tuple[float, PushInterval]]
    """With the time at which each is published, as late as 0.3 s after its push."""

    def messages(self) -> dict[str, list[tuple[float, Callable[[PushCutter], object]]]]:
        """For each topic: stamps, and how a cutter takes what came then."""
        topics: dict[str, list[tuple[float, Callable[[PushCutter], object]]]] = {
            f"pose {name}": [
                (t, partial(PushCutter.add_pose, object_id=name, stamp=t, pose=pose_at(t), covariance=COVARIANCE)) for t in stamps
            ]
            for name, stamps in self.poses.items()
        }
        topics["pusher"] = [(t, partial(PushCutter.add_pusher, stamp=t, position=position_at(t))) for t in self.pusher]
        topics["wrench"] = [(t, partial(PushCutter.add_wrench, stamp=t, force=position_at(-t))) for t in self.wrench]
        topics["record"] = [(t, partial(PushCutter.add_record, record=record)) for t, record in self.records]
        return {name: messages for name, messages in topics.items() if messages}

    def from_bag(self, object_id: str) -> list[PushRecord]:
        """The pushes of one object as a bag with the same samples gives them."""
        objects = {}
        for name, stamps in self.poses.items():
            poses, covariances = np.array([pose_at(t) for t in stamps]).reshape(-1, 3), np.array([COVARIANCE] * len(stamps))
            objects[name] = ObjectTrack(hammer_shape(), np.array(stamps), poses, covariances)
        contents = BagContents(
            path=Path("bag"),
            origin_ns=0,
            objects=objects,
            pusher=Samples(np.array(self.pusher), np.array([position_at(t) for t in self.pusher])),
            pusher_shape=PusherShape(0.01),
            wrench=Samples(np.array(self.wrench), np.array([position_at(-t) for t in self.wrench])) if self.wrench else None,
            push_intervals=tuple(record for _, record in self.records),
            camera_in_table=None,
            camera_accuracy=None,
            n_depth=0,
            topics={},
        )
        try:
            return split_pushes(contents, object_id)
        except BagError:
            return []


@pytest.mark.parametrize("is_silent", [False, True])
def test_noise_of_poses_without_a_covariance_is_learned_as_rests_come(is_silent: bool) -> None:
    """The pusher drives from 2 to 4 s and from 12 to 13 s. Soon after the first push too few frames have shown the object at rest: it waits
    for more, unless the source falls silent."""
    cutter, rng, std = cutter_of("o1"), np.random.default_rng(0), np.array([1e-3, 1e-3, 8e-3])
    pushes, waits = [], ""
    for time in times(1.7, 16):
        moved = 0.05 * (np.clip(time - 2.0, 0.0, 2.0) + np.clip(time - 12.0, 0.0, 1.0))
        cutter.add_pose("o1", time, np.array([moved, 0.0, 0.0]) + std * rng.normal(size=3), np.zeros((3, 3)))
        if 1.7 < time < 4.1 or 12.0 < time < 13.0:
            cutter.add_pusher(time, np.array([moved, 0.2]))
        pushes += cutter.finished(flush=is_silent and 4.3 < time < 4.4)
        if time < 4.4:
            assert [push.records for push in pushes] in ([], [[]]) and cutter.covariance_of("o1", np.zeros((3, 3))) is None
            waits = cutter.noise_texts()["o1"]
    first, second = pushes
    for why in (waits, *first.left_out.values()):
        assert why.startswith("its poses lack a covariance, and") and why.endswith("expected at least 9")
    assert len(first.left_out) == is_silent
    for record in (*first.records, *second.records):
        assert np.sqrt(np.diag(record.poses.covariance[0])) == pytest.approx(std, rel=0.35)
    assert len(first.records) == (not is_silent) and len(second.records) == 1 and "frames at rest" in cutter.noise_texts()["o1"]


def pose_at(time: float) -> np.ndarray:
    return np.array([np.sin(time), np.cos(3 * time), 0.1 * time])


def position_at(time: float) -> np.ndarray:
    return np.array([np.sin(5 * time), np.cos(7 * time)])


def add_pose(cutter: PushCutter, object_id: str, stamp: float) -> bool:
    return cutter.add_pose(object_id, stamp, pose_at(stamp), COVARIANCE)


def play_in_time(cell: Cell, *, expects_records: bool = False, flush: bool = True) -> list[CutPush]:
    """Messages in order of time, with a call of `finished` each 0.1 s as the nodes make it."""
    cutter, pushes, looked = cutter_of(*cell.poses), [], 0.0
    cutter.expects_records = expects_records
    topics = enumerate(cell.messages().values())
    merged = sorted(((time, number, take) for number, topic in topics for time, take in topic), key=lambda message: message[:2])
    for time, _, take in merged:
        while looked + 0.1 < time:
            looked += 0.1
            pushes += cutter.finished()
        take(cutter)
    return pushes + cutter.finished(flush=flush)


def play_shuffled(cell: Cell, rng: np.random.Generator) -> list[CutPush]:
    """Each topic in order, at a pace of its own: between two calls of `finished` it delivers one message or a backlog."""
    cutter, pushes = cutter_of(*cell.poses), []
    waiting = {name: deque(take for _, take in messages) for name, messages in cell.messages().items()}
    pace = {name: int(rng.choice([1, 1, 3, 30])) for name in waiting}
    while any(waiting.values()):
        for name in rng.permutation(sorted(waiting)):
            for _ in range(min(int(rng.integers(1, pace[name] + 1)), len(waiting[name]))):
                waiting[name].popleft()(cutter)
        pushes += cutter.finished()
    return pushes + cutter.finished(flush=True)


def random_cell(rng: np.random.Generator, *, with_records: bool, hurried: bool) -> Cell:
    """Runs of the pusher with pauses, two objects, forces; if `hurried`, pauses under a second and hidden objects."""
    start, pusher, records = float(rng.uniform(0, 3)), [], []
    for number in range(int(rng.integers(1, 6))):
        run = start + np.cumsum(rng.uniform(0.01, 0.3, int(rng.integers(1, 30))))
        pusher += run.tolist()
        if with_records and len(run) > 1:
            records.append((float(run[-1]) + 0.3, PushInterval(number + 1, "a", float(run[0]), float(run[-1]), 0)))
        start = float(run[-1] + (rng.choice([rng.uniform(0.51, 1.0), rng.uniform(1.0, 6.0)]) if hurried else rng.uniform(1.05, 6.0)))
    poses = {}
    for name in ("a", "b"):
        stamps = np.cumsum(rng.uniform(0.01, 0.2, int((start + 2) / 0.1)))
        for _ in range(int(rng.integers(0, 4)) if hurried else 0):
            hidden = float(rng.uniform(0, start))
            stamps = stamps[(stamps < hidden) | (stamps > hidden + float(rng.uniform(0.2, 4.0)))]
        poses[name] = stamps.tolist()
    wrench = np.cumsum(rng.uniform(0.02, 0.1, int(start / 0.06))).tolist() if rng.uniform() < 0.7 else []
    if with_records:
        # Where a bag has records, samples without one are no push; a live cell cannot know that no record will come.
        pusher = [t for t in pusher if any(r.start <= t <= r.end for _, r in records)]
    return Cell(poses, pusher, wrench, records)


def assert_same_pushes(live: list[CutPush], cell: Cell) -> None:
    for object_id in cell.poses:
        got = [record for push in live for record in push.records if record.object_id == object_id]
        expected = cell.from_bag(object_id)
        assert len(got) == len(expected)
        for record, other in zip(got, expected, strict=True):
            for track in ("poses", "pusher", "wrench"):
                one, two = getattr(record, track), getattr(other, track)
                assert (one is None) == (two is None)
                for name in [field.name for field in fields(one)] if one else ():
                    assert np.array_equal(getattr(one, name), getattr(two, name)), f"{track}.{name}"


@pytest.mark.parametrize("with_records", [False, True], ids=["cut at pauses", "cut at push records"])
@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_live_streams_and_a_bag_give_the_same_pushes(with_records: bool, seed: int) -> None:
    """In any order; and in time, where pushes are over a second apart, of objects in view: a live push is handed out before the next."""
    rng = np.random.default_rng(seed)
    cell = random_cell(rng, with_records=with_records, hurried=True)
    if cell.pusher:
        for _ in range(2):
            assert_same_pushes(play_shuffled(cell, rng), cell)
    cell = random_cell(np.random.default_rng(seed), with_records=with_records, hurried=False)
    if cell.pusher:
        assert_same_pushes(play_in_time(cell), cell)


def test_record_that_comes_in_time_gives_the_interval_as_in_a_bag() -> None:
    """The record covers more than the pusher samples, and two pushes follow without a pause; a third one failed."""
    pusher = [*times(2.0, 3.0), *times(3.2, 4.0), *times(8.0, 9.0)]
    ends = ((1.9, 3.0, 0), (3.1, 4.05, 0), (7.95, 9.1, -5))
    records = [(9.5, PushInterval(k + 1, "a", *values)) for k, values in enumerate(ends)]
    cell = Cell({"a": times(0, 12)}, pusher, times(0, 12), records)
    cutter = cutter_of(*cell.poses)
    for topic in ("record", "pusher", "wrench", "pose a"):
        for _, take in cell.messages()[topic]:
            take(cutter)
    pushes = cutter.finished(flush=True)
    assert_same_pushes(pushes, cell)
    assert [push.interval.error_code for push in pushes] == [0, 0, -5]
    assert pushes[2].records == [] and "error code -5" in pushes[2].left_out["a"]


def play_with_records(
    records: list[tuple[float, PushInterval]], *, pusher: list[tuple[float, float]], end: float, expects: bool = True
) -> list[CutPush]:
    """Poses up to `end` [s], the pusher in some spans of time, records when they come."""
    cell = Cell({"o1": times(0, end)}, [time for span in pusher for time in times(*span)], [], records)
    return play_in_time(cell, expects_records=expects, flush=False)


def record_of(start: float, end: float) -> PushInterval:
    return PushInterval(1, "o1", start, end, 0)


def test_run_without_a_record_is_no_push_where_records_are_written_after_as_long_as_an_arm_may_take_home() -> None:
    assert play_with_records([], pusher=[(2, 3)], end=8) == []
    (lost,) = play_with_records([], pusher=[(2, 3)], end=20)
    assert lost.unrecorded and lost.records == [] and "the executor ended in the middle" in lost.left_out["o1"]
    (push,) = play_with_records([(7.0, record_of(2.0, 3.0))], pusher=[(2, 3)], end=20)
    assert len(push.records) == 1 and push.interval.push_id == 1
    (push,) = play_with_records([], pusher=[(2, 3)], end=20, expects=False)
    assert not push.unrecorded and len(push.records) == 1


def test_record_of_a_later_push_says_that_the_one_before_has_none() -> None:
    lost, push = play_with_records([(7.1, record_of(6.0, 7.0))], pusher=[(2, 3), (6, 7)], end=9)
    assert lost.unrecorded and lost.interval.end == pytest.approx(2.95)
    assert not push.unrecorded and push.records[0].poses.time[0] > 4.0


@pytest.mark.parametrize("lifted", [3.0, 4.0])
def test_samples_behind_the_end_of_a_record_that_came_before_them_belong_to_its_push(lifted: float) -> None:
    """Also where the tool stays down for a second."""
    records = [(2.9, record_of(2.0, 2.93)), (7.0, record_of(6.0, 6.95))]
    first, second = play_with_records(records, pusher=[(2, lifted), (6, 7)], end=8)
    assert [push.interval.push_id for push in (first, second)] == [1, 1] and not (first.unrecorded or second.unrecorded)
    assert first.records[0].poses.time[-1] == pytest.approx(3.4), "the poses at rest after it"
    assert second.records[0].poses.time[0] == pytest.approx(5.5)


def test_push_during_which_the_pusher_paused_is_handed_out_once() -> None:
    pushes = play_with_records([(5.0, record_of(2.0, 4.5))], pusher=[(2, 3), (3.8, 4.48)], end=20)
    assert len(pushes) == 1
    assert pushes[0].records[0].pusher.time[[0, -1]] == pytest.approx([2.0, 4.45])
