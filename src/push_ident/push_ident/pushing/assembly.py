"""From streams of poses and pusher samples to push records, while they come in.

The rules are those by which a bag is cut: a push is a run of pusher samples without a pause over `gap`; it takes the poses up to `gap`
around it or, where the object was hidden then, the nearest one on that side, but none nearer to another push.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from push_ident.types import Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord, WrenchTrack

__all__ = ["PushAssembler"]

_MAX_BUFFER = 20_000
"""Samples kept of each stream: ten minutes at 30 Hz."""


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

    def add_pose(self, object_id: str, stamp: float, pose: Float64Array, covariance: Float64Array) -> None:
        """A pose of an object, (x, y, yaw) in the table frame, with its 3 x 3 covariance. Stamps that do not increase are dropped."""
        poses = self._poses.setdefault(object_id, deque(maxlen=_MAX_BUFFER))
        if not poses or stamp > poses[-1][0]:
            poses.append((stamp, pose, covariance))
            self._now = max(self._now, stamp)

    def add_wrench(self, stamp: float, force: Float64Array) -> None:
        """Force of the pusher on the object [N], shape (2,), table frame."""
        if not self._wrench or stamp > self._wrench[-1][0]:
            self._wrench.append((stamp, float(force[0]), float(force[1])))

    def add_pusher(self, stamp: float, position: Float64Array) -> None:
        """Position of the pusher [m], shape (2,), table frame; a pause before it ends the push before."""
        if self._open is not None and stamp - self._open.end > self._gap:
            self.end_push()
        if self._open is None:
            middle = 0.5 * (stamp + self._last_end) if np.isfinite(self._last_end) else -np.inf
            self._open = _Span(after=middle)
            if self._ended:
                self._ended[-1].before = middle
        if not self._open.samples or stamp > self._open.end:
            self._open.samples.append((stamp, float(position[0]), float(position[1])))
            self._now = max(self._now, stamp)

    def end_push(self) -> None:
        """The push under way has ended (somebody said so, or the pusher paused)."""
        if self._open is not None:
            self._last_end = self._open.end
            self._ended.append(self._open)
            self._open = None

    def partial(self, object_id: str) -> PushRecord | None:
        """The push under way as far as it has come; None while there is none, or too little of it."""
        return self._record(object_id, self._open) if self._open is not None else None

    def finished(self, *, flush: bool = False) -> list[list[PushRecord]]:
        """Pushes that are complete, each as one record per object, oldest first; empty where too little was seen. Each is handed out once.

        A push is complete when an object was seen after it and stamps have passed the time in which poses belong to it, or when the
        next one is nearer. `flush` takes what there is.
        """
        if self._open is not None and (flush or self._now - self._open.end > self._gap):
            self.end_push()
        pushes = []
        while self._ended and (flush or self._complete(self._ended[0])):
            span = self._ended.popleft()
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

    def _complete(self, span: _Span) -> bool:
        return self._now > span.before or (self._seen_after(span) and self._now > span.end + self._gap)

    def reset(self) -> None:
        """Time was set back: forget everything that was buffered, keep the shapes."""
        self._poses.clear()
        self._wrench.clear()
        self._ended.clear()
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
