"""Cuts the streams of a cell into pushes: the same rules for a bag, which is there as a whole, and for messages as they arrive.

1. A push is an interval of time, given by its push record. Without an executor that writes records it is a run of pusher samples without a
   pause over `gap`. With one, a run without a record is no push: the executor ended in the middle of it. Samples that continue, without a
   pause over `gap`, after the end of a record that came before them belong to its push.
2. The window of a push lies between the midpoints to the intervals before and after it, those of failed pushes included.
3. Of the poses in its window, a push has those up to `gap` around its interval. If there is none at or before its start, it has the last
   one before; if there is none at or after its end, the first one after; neither is farther than a minute.
4. It has the pusher samples and forces within its interval; a path whose stamps jitter is smoothed (`regular_path.py`).
5. There is no record of a failed push, one beyond the duration or travel of `limits.py`, one with fewer than 2 pusher samples, or one with
   fewer than 2 poses of an object.

Each topic arrives in order, but nothing orders one topic among the others: after a stall, or from a bag that is played fast, poses may be
seconds ahead of the pusher. Nothing here depends on the order across streams: a push is complete when every stream that still delivers
has passed it. A stream that falls behind itself means that time was set back.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from push_ident.errors import InputError
from push_ident.limits import LIMITS
from push_ident.pushing.pose_noise import PoseNoise, pusher_moves
from push_ident.pushing.regular_path import regular_path
from push_ident.types import CameraAccuracy, Float64Array, ObjectShape, PoseTrack, PusherPath, PusherShape, PushRecord, WrenchTrack

LIVE_CAPACITY: Final = 20_000
"""Samples of a stream that a live cell keeps: ten minutes at 30 Hz."""
UNRECORDED: Final = "push without an end record: the executor ended in the middle"
"""Why such a run is no push."""


@dataclass(frozen=True, slots=True)
class CutterSettings:
    """When a push is complete, and what belongs to it."""

    clock_jump: float = 1.0
    """A stamp this much older than the latest of its own stream means that time was set back [s]."""
    n_records: int = 100
    """Push records of a live cell that are kept for pusher samples still to come."""
    silent_calls: int = 3
    """A stream without a sample between so many calls of `finished` has delivered all it had. A node handles one waiting message of each
    topic between two calls of a timer, so that no message can be waiting then."""
    max_rest: float = 60.0
    """Longest time from a push to a pose that shows the object at rest before or after it, or to the rests that show the noise of its poses
    [s]."""
    record_delay: float = 10.0
    """Longest time from the end of a push to its record [s]: an executor may first take the arm home."""
    rounding: float = 5e-7
    """Difference of stamps and ends of intervals by different roundings [s]."""


_SETTINGS: Final = CutterSettings()


@dataclass(frozen=True, slots=True)
class PushInterval:
    """When a push took place."""

    push_id: int
    """Of its push record; 0 for a run of pusher samples."""
    object_id: str
    """Of its push record; empty for a run of pusher samples."""
    start: float
    """[s]"""
    end: float
    error_code: int
    """0: the push was made as planned; others as in action/ExecutePush."""


@dataclass(frozen=True, slots=True)
class CutPush:
    """One push, complete."""

    interval: PushInterval
    records: list[PushRecord]
    """One for each object that has a shape and enough poses; empty for a failed push."""
    left_out: dict[str, str]
    """Objects that have a shape but no record, and why."""
    unrecorded: bool = False
    """Whether it should have a push record, but has none."""


@dataclass(slots=True)
class _Samples:
    """Samples of one stream, in order of time."""

    capacity: int | None
    time: list[float] = field(default_factory=list)
    value: list[Any] = field(default_factory=list)

    def append(self, time: float, value: Any) -> None:
        self.time.append(time)
        self.value.append(value)
        if self.capacity is not None and len(self.time) >= 2 * self.capacity:
            self._drop(len(self.time) - self.capacity)

    def select(self, start: float, end: float) -> tuple[Float64Array, list[Any]]:
        """Times and values from `start` to `end`, both included."""
        chosen = slice(bisect_left(self.time, start - _SETTINGS.rounding), bisect_right(self.time, end + _SETTINGS.rounding))
        return np.array(self.time[chosen], dtype=np.float64), self.value[chosen]

    def around(self, span: tuple[float, float], window: tuple[float, float], gap: float) -> tuple[Float64Array, list[Any]]:
        """Poses of a push: during it, at rest around it, and where there are none at rest the nearest one on that side; rules 2 and 3."""
        start, end = span
        window_first, window_last = bisect_right(self.time, window[0]), bisect_right(self.time, window[1])
        first, last = bisect_left(self.time, start - gap), bisect_right(self.time, end + gap)
        first = max(first, window_first)
        last = max(min(last, window_last), first)
        # The pose nearest to an end may be far from it, but the simulation steps through all the time to it.
        if bisect_right(self.time, start) <= first > window_first and self.time[first - 1] >= start - _SETTINGS.max_rest:
            first -= 1
        if (first == last or bisect_left(self.time, end) >= last) and last < window_last and self.time[last] <= end + _SETTINGS.max_rest:
            last += 1
        return np.array(self.time[first:last], dtype=np.float64), self.value[first:last]

    def forget(self, before: float) -> None:
        """Drop what is older than `before`, except the last of it."""
        self._drop(max(bisect_left(self.time, before) - 1, 0))

    def _drop(self, count: int) -> None:
        del self.time[:count]
        del self.value[:count]


@dataclass(slots=True)
class _Stream:
    latest: float = -math.inf
    silent: int = 0
    """Calls of `finished` since its last sample."""
    is_behind: bool = False
    """Time was set back, but this topic has not yet delivered all from before."""


@dataclass(slots=True)
class _Run:
    """Pusher samples without a pause, or the interval of a record where no runs are looked for."""

    start: float
    end: float
    record: PushInterval | None = None
    expects_record: bool = False


class PushCutter:
    """Collects the streams of one cell and hands out complete pushes.

    Args:
        gap: pause of the pusher that ends a push [s].
        capacity: samples of each stream to keep at least; None keeps all.
        find_runs: whether runs of pusher samples are looked for. False for a complete bag that has push records.
        pose_std: standard deviations of poses that lack a covariance [m, rad]; None: as their rests show them.
    """

    def __init__(
        self,
        gap: float = 0.5,
        *,
        capacity: int | None = LIVE_CAPACITY,
        find_runs: bool = True,
        pose_std: tuple[float, float] | None = None,
    ) -> None:
        self._gap = gap
        self._capacity = capacity
        self._find_runs = find_runs
        self._pose_std = pose_std
        self._tool = PusherShape(0.0)
        self._camera = CameraAccuracy()
        self._shapes: dict[str, ObjectShape] = {}
        self._poses: dict[str, _Samples] = {}
        self._noise: dict[str, PoseNoise] = {}
        self._pusher = _Samples(capacity)
        self._wrench = _Samples(capacity)
        self._open: _Run | None = None
        self._ended: deque[_Run] = deque()
        self._last_end = -math.inf
        """Of the last run that has ended [s]."""
        self._handed_out_until = -math.inf
        """End of the last push that was handed out [s]."""
        self._now = -math.inf
        self._before = math.inf
        """Time when it was last set back [s]."""
        self._streams: dict[str, _Stream] = {}
        self._cuts: deque[float] = deque()
        self._records: deque[PushInterval] = deque(maxlen=None if capacity is None else _SETTINGS.n_records)
        self.run = 1
        """Counts how often time was set back, from 1."""
        self.expects_records = False
        """Whether an executor writes push records: from now on, and for the run under way, a run without one is no push."""

    # ---- input

    @property
    def now(self) -> float:
        """Latest stamp [s]; -inf before the first."""
        return self._now

    def set_radius(self, radius: float) -> None:
        """Radius of the pusher, a cylinder [m]."""
        self._tool = PusherShape(radius)

    def set_pusher_shape(self, shape: PusherShape) -> None:
        """Outline of the pusher. The poses of one that is no cylinder need a yaw."""
        self._tool = shape

    def set_camera(self, accuracy: CameraAccuracy) -> None:
        """How well the camera that measures the poses knows where it stands."""
        self._camera = accuracy

    def set_shape(self, object_id: str, shape: ObjectShape) -> None:
        """Cells and outline of an object."""
        self._shapes[object_id] = shape

    def add_pose(self, object_id: str, stamp: float, pose: Float64Array, covariance: Float64Array) -> bool:
        """A pose of an object, (x, y, yaw) in the table frame, with its 3 x 3 covariance, zero where it is unknown (`pose_noise.py`).

        Returns whether it was taken. This and the other streams drop stamps that do not increase, and what is left from before time was
        set back.
        """
        taken = self._take(f"pose of {object_id}", stamp)
        if taken:
            self._poses.setdefault(object_id, _Samples(self._capacity)).append(stamp, (pose, covariance))
            self._noise.setdefault(object_id, PoseNoise(self._pose_std)).state(covariance)
        return taken

    def covariance_of(self, object_id: str, covariance: Float64Array) -> Float64Array | None:
        """Covariances of an object, shape (..., 3, 3), with what its poses do not state; None where that is not known yet."""
        return self._noise[object_id].filled(covariance) if object_id in self._noise else covariance

    def noise_texts(self) -> dict[str, str]:
        """Of each object with poses that lack a covariance: what is taken for it, or what is missing."""
        return {object_id: noise.text() for object_id, noise in self._noise.items() if noise.is_needed}

    def add_wrench(self, stamp: float, force: Float64Array) -> bool:
        """Force of the pusher on the object [N], shape (2,), table frame."""
        taken = self._take("wrench", stamp)
        if taken:
            self._wrench.append(stamp, (float(force[0]), float(force[1])))
        return taken

    def add_pusher(self, stamp: float, position: Float64Array) -> bool:
        """Position of the pusher [m], shape (2,), or its pose (x, y, yaw), table frame; a pause before it ends the run before."""
        if not self._take("pusher", stamp):
            return False
        self._pusher.append(stamp, (float(position[0]), float(position[1]), float(position[2]) if len(position) > 2 else 0.0))
        if self._find_runs:
            self._extend_run(stamp)
        return True

    def add_record(self, record: PushInterval) -> None:
        """A push record; the pusher samples of its interval may still arrive. One that covers no time is ignored."""
        if record.end <= record.start:
            return
        if not self._find_runs:
            self._ended.append(_Run(record.start, record.end, record))
            return
        self._records.append(record)
        if self._take("push record", record.end) and record.end > self._last_end:
            self._cuts.append(record.end)

    def _extend_run(self, stamp: float) -> None:
        while self._cuts and stamp > self._cuts[0] + _SETTINGS.rounding:
            self._cuts.popleft()
            self._end_run()
        if self._open is not None and stamp - self._open.end > self._gap:
            self._end_run()
        if self._open is None:
            self._open = _Run(stamp, stamp)
        self._open.end = stamp
        self._open.expects_record |= self.expects_records

    def _end_run(self) -> None:
        if self._open is not None:
            self._last_end = self._open.end
            self._ended.append(self._open)
            self._open = None

    def _take(self, name: str, stamp: float) -> bool:
        """Whether a sample is used: it is newer than the previous one, and not from before time was set back."""
        stream = self._streams.setdefault(name, _Stream())
        stream.silent = 0
        if stamp < stream.latest - _SETTINGS.clock_jump:
            if not stream.is_behind:
                self._set_back(stamp)
            stream.is_behind = False
        elif stamp <= stream.latest:
            return False
        elif stream.is_behind:
            # Samples from before time was set back are not later than the time then: a later one means one late message, not a set clock.
            stream.is_behind = self._now < stream.latest and stamp <= self._before + _SETTINGS.clock_jump
        stream.latest = stamp
        if not stream.is_behind:
            self._now = max(self._now, stamp)
        return not stream.is_behind

    def _set_back(self, stamp: float) -> None:
        before = self._now
        self._forget_all()
        self._before = before
        self._now = stamp
        self.run += 1
        for stream in self._streams.values():
            stream.is_behind = stream.latest > stamp + _SETTINGS.clock_jump

    def reset(self) -> None:
        """Drop everything that was buffered, keep the shapes."""
        self._forget_all()
        self._streams.clear()

    def _forget_all(self) -> None:
        self._poses.clear()
        self._pusher, self._wrench = _Samples(self._capacity), _Samples(self._capacity)
        self._ended.clear()
        self._cuts.clear()
        self._records.clear()
        self._open = None
        self._last_end = self._handed_out_until = self._now = -math.inf
        for noise in self._noise.values():
            noise.end_rest()

    # ---- output

    def partial(self, object_id: str) -> PushRecord | None:
        """The part so far of the push under way; None while there is none, or too little of it."""
        if self._open is None or object_id not in self._shapes:
            return None
        interval = PushInterval(0, "", self._open.start, self._open.end, 0)
        before = self._interval(self._ended[-1]).end if self._ended else self._handed_out_until
        record = self._cut(object_id, interval, (_midpoint(before, interval.start), math.inf))
        return record if isinstance(record, PushRecord) else None

    def finished(self, *, flush: bool = False) -> list[CutPush]:
        """Pushes that are complete, oldest first. Each is handed out once.

        A push is complete when an object was observed after it and stamps have passed the time in which poses belong to it, or when the
        next one is nearer. Streams that went silent are not waited for; to notice them, call this at regular times, not at every sample.
        `flush` takes what there is.
        """
        for stream in self._streams.values():
            stream.silent += 1
        passed, rounding = math.inf if flush else self._passed, _SETTINGS.rounding
        if self._open is not None and (passed > self._open.end + self._gap or (self._cuts and passed >= self._cuts[0] - rounding)):
            self._end_run()
        while self._cuts and passed > self._cuts[0] + rounding:
            self._cuts.popleft()
        self._learn_noise(passed - self._gap)
        pushes = []
        while self._ended:
            run, interval, window = self._ended[0], self._interval(self._ended[0]), self._window()
            if interval.push_id and interval.end <= self._handed_out_until:
                self._ended.popleft()  # a second run of a push during which the pusher's poses paused
                continue
            if not (flush or passed > window[1] or (self._observed_after(interval.end) and passed > interval.end + self._gap)):
                break
            unrecorded = run.expects_record and not self._records_of(run)
            is_tail = self._is_tail(run, self._handed_out_until)
            is_overdue = flush or passed > run.end + _SETTINGS.record_delay or any(r.start >= run.end for r in self._records)
            if unrecorded and not is_tail and not is_overdue:
                break
            # The rests up to the next push may show it.
            lacks_noise = any(noise.is_needed and noise.std() is None for noise in self._noise.values())
            if lacks_noise and not flush and passed <= run.end + _SETTINGS.max_rest:
                break
            self._ended.popleft()
            if is_tail:
                continue
            lost = CutPush(interval, [], dict.fromkeys(self._shapes, UNRECORDED), unrecorded=True)
            pushes.append(lost if unrecorded else self._cut_push(interval, window))
            self._handed_out_until = interval.end
            self._forget(interval.end)
        return pushes

    def _learn_noise(self, until: float) -> None:
        """Take in the frames at rest up to then [s], where poses lack a covariance."""
        for object_id, noise in self._noise.items():
            if not noise.is_needed or object_id not in self._poses:
                continue
            time, values = self._poses[object_id].select(noise.latest + 2 * _SETTINGS.rounding, until)
            if not len(time):
                continue
            stamps, positions = self._pusher.select(float(time[0]) - self._gap, float(time[-1]) + self._gap)
            moves = pusher_moves(time, np.column_stack([stamps, np.array(positions).reshape(-1, 3)[:, :2]]), self._gap)
            for stamp, (pose, _), may_move in zip(time.tolist(), values, moves.tolist(), strict=True):
                noise.add(stamp, pose, moves=may_move, pause=self._gap)

    @property
    def is_under_way(self) -> bool:
        """Whether a run of pusher samples has not ended yet."""
        return self._open is not None

    @property
    def n_ended(self) -> int:
        """Pushes that have ended and are not handed on yet: their last poses, or a record, may still come."""
        return len(self._ended)

    @property
    def is_awaiting(self) -> bool:
        """Whether the record of a push is still to come, or a push has ended after which no object was observed yet."""
        run = self._ended[0] if self._ended else self._open
        if run is not None and run.expects_record and not self._records_of(run):
            return True
        return bool(self._ended) and not self._observed_after(self._interval(self._ended[0]).end)

    @property
    def _passed(self) -> float:
        """Time up to which all samples have arrived [s]."""
        return min((s.latest for s in self._streams.values() if s.silent <= _SETTINGS.silent_calls and not s.is_behind), default=self._now)

    def _observed_after(self, end: float) -> bool:
        return any(poses.time and poses.time[-1] >= end for poses in self._poses.values())

    def _interval(self, run: _Run) -> PushInterval:
        """Rule 1. Of several records that overlap a run, one of a failed push counts first."""
        records = self._records_of(run)
        failed = [record for record in records if record.error_code]
        return (failed or records or [PushInterval(0, "", run.start, run.end, 0)])[0]

    def _records_of(self, run: _Run) -> list[PushInterval]:
        if run.record is not None:
            return [run.record]
        return [record for record in self._records if record.start < run.end and run.start < record.end]

    def _is_tail(self, run: _Run, end: float) -> bool:
        """Whether a run is the rest of a push that ended at `end` [s]: samples behind the end of its record, which came before them.

        However long it is, where a push would have a record: a busy executor may leave the tool down for seconds before it lifts it.
        """
        goes_on = run.end <= end + self._gap or (run.expects_record and run.start <= end + self._gap)
        return end < run.end and goes_on and not self._records_of(run)

    def _window(self) -> tuple[float, float]:
        """Rule 2, for the oldest push that was not handed out."""
        interval = self._interval(self._ended[0])
        later = [*list(self._ended)[1:], *([self._open] if self._open is not None else [])]
        following = next((run for run in later if not self._is_tail(run, interval.end)), None)
        after = math.inf if following is None else self._interval(following).start
        return _midpoint(self._handed_out_until, interval.start), _midpoint(interval.end, after)

    def _cut_push(self, interval: PushInterval, window: tuple[float, float]) -> CutPush:
        push = CutPush(interval, [], {})
        for object_id in self._shapes:
            record = self._cut(object_id, interval, window)
            if isinstance(record, PushRecord):
                push.records.append(record)
            else:
                push.left_out[object_id] = record
        return push

    def _cut(self, object_id: str, interval: PushInterval, window: tuple[float, float]) -> PushRecord | str:
        """The record of one object, or why there is none: rules 3 to 5."""
        start, end = interval.start, interval.end
        if interval.error_code:
            return f"its push record has error code {interval.error_code}"
        time, positions = self._pusher.select(start, end)
        stamps, observed = (self._poses.get(object_id) or _Samples(None)).around((start, end), window, self._gap)
        path = np.array(positions).reshape(-1, 3)
        if reason := _unusable(time, path[:, :2], len(stamps)):
            return reason
        covariance = self.covariance_of(object_id, np.array([covariance for _, covariance in observed]))
        if covariance is None:
            return self._noise[object_id].text()
        wrench_time, forces = self._wrench.select(start, end)
        tool, yaw = self._tool, None if self._tool.is_cylinder else np.unwrap(path[:, 2])
        return PushRecord(
            object_id=object_id,
            shape=self._shapes[object_id],
            poses=PoseTrack(stamps, np.array([pose for pose, _ in observed]), covariance, self._camera),
            pusher=regular_path(PusherPath(time, path[:, :2], tool.radius, tool.polygon, yaw, tool.fingers)),
            wrench=WrenchTrack(wrench_time, np.array(forces)) if len(wrench_time) else None,
            source=f"push at {time[0]:.2f} s",
        )

    def _forget(self, before: float) -> None:
        if self._capacity is not None:
            for samples in (*self._poses.values(), self._wrench, self._pusher):
                samples.forget(before)


def _midpoint(end: float, start: float) -> float:
    return 0.5 * (end + start)


def _unusable(time: Float64Array, positions: Float64Array, n_poses: int) -> str:
    if len(time) < 2:
        return f"{len(time)} pusher poses, expected at least 2"
    if n_poses < 2:
        return f"{n_poses} object poses, expected at least the two end poses"
    try:
        LIMITS.PUSH_SECONDS.check(
            float(time[-1] - time[0]), "it is no push", remedy="Record push records, or the pusher only during pushes."
        )
        LIMITS.PUSH_TRAVEL.check(float(np.sum(np.linalg.norm(np.diff(positions, axis=0), axis=1))), "it is no push")
    except InputError as error:
        return str(error).rstrip(".")
    return ""
