"""From streams of poses and pusher samples to push records, while they come in.

The rules are those by which a bag is cut: a push is a run of pusher samples without a pause over `gap`; it takes the poses up to `gap`
around it or, where the object was hidden then, the nearest one on that side, but none nearer to another push.

Each topic comes in order, but nothing orders one topic among the others: after a stall, or from a bag played fast, poses may be
seconds ahead of the pusher. Hence nothing here depends on the order across streams: a push is handed out when every stream that still
delivers has passed it, and time was set back when a stream falls behind itself.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from push_ident.types import Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord, WrenchTrack

__all__ = ["PushAssembler"]

_MAX_BUFFER = 20_000
"""Samples kept of each stream: ten minutes at 30 Hz."""
_JUMP_BACK = 1.0
"""A stamp this much older than the latest of its own stream means that time was set back [s]."""
_MAX_FAILED = 100
_LOOKS = 3
"""A stream that brought nothing between so many looks has delivered all it had. A node handles one waiting message of each topic between
two looks of a timer, so that no message can be waiting then."""
_ROUNDING = 5e-7
"""Stamps and ends of pushes went through different roundings [s]."""


@dataclass(slots=True)
class _Stream:
    """How far one topic has come."""

    latest: float = -np.inf
    silent: int = 0
    """Looks since its last sample."""
    is_behind: bool = False
    """Time was set back, but this topic has not yet delivered all from before."""


@dataclass(slots=True)
class _Span:
    """One push: its pusher samples, and the time between its neighbours [s], within which poses are nearer to it than to them."""

    after: float
    samples: list[tuple[float, float, float]] = field(default_factory=list)
    before: float = np.inf

    @property
    def start(self) -> float:
        return self.samples[0][0]

    @property
    def end(self) -> float:
        return self.samples[-1][0]


class PushAssembler:
    """Collects what the topics of one cell say and hands out finished pushes.

    Args:
        gap: pause of the pusher that ends a push [s].
    """

    def __init__(self, gap: float = 0.5) -> None:
        self._gap = gap
        self._radius = 0.0
        self._shapes: dict[str, ObjectShape] = {}
        self._poses: dict[str, deque[tuple[float, Float64Array, Float64Array]]] = {}
        self._wrench: deque[tuple[float, float, float]] = deque(maxlen=_MAX_BUFFER)
        self._open: _Span | None = None
        self._ended: deque[_Span] = deque()
        self._last_end = -np.inf
        self._now = -np.inf
        self._streams: dict[str, _Stream] = {}
        self._cuts: deque[float] = deque()
        self._failed: deque[tuple[float, float]] = deque(maxlen=_MAX_FAILED)
        self.n_failed = 0
        """Pushes that were left out since somebody said that they failed."""
        self.run = 1
        """Counts how often time was set back, from 1."""

    @property
    def now(self) -> float:
        """Latest stamp seen [s]; -inf before the first."""
        return self._now

    def set_radius(self, radius: float) -> None:
        """Radius of the pusher [m]."""
        self._radius = radius

    def set_shape(self, object_id: str, shape: ObjectShape) -> None:
        """Cells and outline of an object."""
        self._shapes[object_id] = shape

    def add_pose(self, object_id: str, stamp: float, pose: Float64Array, covariance: Float64Array) -> bool:
        """A pose of an object, (x, y, yaw) in the table frame, with its 3 x 3 covariance.

        Returns whether it was taken, here as for the other streams: stamps that do not increase are dropped, and so is what was still on
        its way when time was set back.
        """
        taken = self._take(f"pose of {object_id}", stamp)
        if taken:
            self._poses.setdefault(object_id, deque(maxlen=_MAX_BUFFER)).append((stamp, pose, covariance))
        return taken

    def add_wrench(self, stamp: float, force: Float64Array) -> bool:
        """Force of the pusher on the object [N], shape (2,), table frame."""
        taken = self._take("wrench", stamp)
        if taken:
            self._wrench.append((stamp, float(force[0]), float(force[1])))
        return taken

    def add_pusher(self, stamp: float, position: Float64Array) -> bool:
        """Position of the pusher [m], shape (2,), table frame; a pause before it ends the push before."""
        if not self._take("pusher", stamp):
            return False
        while self._cuts and stamp > self._cuts[0] + _ROUNDING:
            self._cuts.popleft()
            self._end_push()
        if self._open is not None and stamp - self._open.end > self._gap:
            self._end_push()
        if self._open is None:
            middle = 0.5 * (stamp + self._last_end) if np.isfinite(self._last_end) else -np.inf
            self._open = _Span(after=middle)
            if self._ended:
                self._ended[-1].before = middle
        self._open.samples.append((stamp, float(position[0]), float(position[1])))
        return True

    def end_push(self, stamp: float, failed_since: float | None = None) -> None:
        """Somebody said that a push ended then [s]; its samples may still be on their way.

        `failed_since`: when it began [s], if it did not go as planned; it is then left out, as from a bag.
        """
        if failed_since is not None:
            self._failed.append((failed_since, stamp))
        if self._take("push record", stamp) and stamp > self._last_end:
            self._cuts.append(stamp)

    def _end_push(self) -> None:
        if self._open is not None:
            self._last_end = self._open.end
            self._ended.append(self._open)
            self._open = None

    def _take(self, name: str, stamp: float) -> bool:
        """Whether a sample belongs to what is collected now."""
        stream = self._streams.setdefault(name, _Stream())
        stream.silent = 0
        if stamp < stream.latest - _JUMP_BACK:
            if not stream.is_behind:
                self._set_back(stamp)
            stream.is_behind = False
        elif stamp <= stream.latest:
            return False
        elif stream.is_behind:
            stream.is_behind = self._now < stream.latest
        stream.latest = stamp
        if not stream.is_behind:
            self._now = max(self._now, stamp)
        return not stream.is_behind

    def _set_back(self, stamp: float) -> None:
        self._forget_all()
        self._now = stamp
        self.run += 1
        for stream in self._streams.values():
            stream.is_behind = stream.latest > stamp + _JUMP_BACK

    def partial(self, object_id: str) -> PushRecord | None:
        """The push under way as far as it has come; None while there is none, or too little of it."""
        return self._record(object_id, self._open) if self._open is not None else None

    def finished(self, *, flush: bool = False) -> list[list[PushRecord]]:
        """Pushes that are complete, each as one record per object, oldest first; empty where too little was seen. Each is handed out once.

        A push is complete when an object was seen after it and stamps have passed the time in which poses belong to it, or when the
        next one is nearer. Streams that went silent are not waited for; to notice them, call this at regular times, not at every sample.
        `flush` takes what there is.
        """
        for stream in self._streams.values():
            stream.silent += 1
        passed = np.inf if flush else self._passed
        if self._open is not None and (passed > self._open.end + self._gap or (self._cuts and passed >= self._cuts[0] - _ROUNDING)):
            self._end_push()
        while self._cuts and passed > self._cuts[0] + _ROUNDING:
            self._cuts.popleft()
        pushes = []
        while self._ended and (flush or self._complete(self._ended[0], passed)):
            span = self._ended.popleft()
            if any(start < span.end and span.start < end for start, end in self._failed):
                self.n_failed += 1
                self._forget(span.end)
                continue
            records = [record for object_id in self._shapes if (record := self._record(object_id, span)) is not None]
            pushes.append(records)
            self._forget(span.end)
        return pushes

    @property
    def is_under_way(self) -> bool:
        """Whether the pusher is pushing, as far as is known."""
        return self._open is not None

    @property
    def is_awaiting(self) -> bool:
        """Whether a push has ended after which no object was seen yet."""
        return bool(self._ended) and not self._seen_after(self._ended[0])

    def _seen_after(self, span: _Span) -> bool:
        return any(poses and poses[-1][0] >= span.end for poses in self._poses.values())

    def _complete(self, span: _Span, passed: float) -> bool:
        return passed > span.before or (self._seen_after(span) and passed > span.end + self._gap)

    @property
    def _passed(self) -> float:
        """Up to when everything has come in [s]."""
        return min((s.latest for s in self._streams.values() if s.silent <= _LOOKS and not s.is_behind), default=self._now)

    def reset(self) -> None:
        """Begin anew: forget everything that was buffered, keep the shapes."""
        self._forget_all()
        self._streams.clear()

    def _forget_all(self) -> None:
        self._poses.clear()
        self._wrench.clear()
        self._ended.clear()
        self._cuts.clear()
        self._failed.clear()
        self._open = None
        self._last_end = self._now = -np.inf

    def _record(self, object_id: str, span: _Span) -> PushRecord | None:
        mine = [p for p in self._poses.get(object_id, ()) if span.after < p[0] <= span.before]
        seen = [p for p in mine if span.start - self._gap <= p[0] <= span.end + self._gap]
        if not any(p[0] <= span.start for p in seen):
            seen = [p for p in mine if p[0] < span.start][-1:] + seen
        if not any(p[0] >= span.end for p in seen):
            seen = seen + [p for p in mine if p[0] > span.end][:1]
        if object_id not in self._shapes or len(seen) < 2 or len(span.samples) < 2:
            return None
        samples = np.array(span.samples)
        felt = np.array([w for w in self._wrench if span.start <= w[0] <= span.end])
        return PushRecord(
            object_id=object_id,
            shape=self._shapes[object_id],
            poses=PoseTrack(np.array([p[0] for p in seen]), np.array([p[1] for p in seen]), np.array([p[2] for p in seen])),
            pusher=PusherPath(samples[:, 0], samples[:, 1:], self._radius),
            wrench=WrenchTrack(felt[:, 0], felt[:, 1:]) if len(felt) else None,
            source=f"push at {span.start:.2f} s",
        )

    def _forget(self, before: float) -> None:
        """Drop poses and forces that no later push can need."""
        for poses in self._poses.values():
            while len(poses) > 1 and poses[1][0] < before:
                poses.popleft()
        while len(self._wrench) > 1 and self._wrench[1][0] < before:
            self._wrench.popleft()
