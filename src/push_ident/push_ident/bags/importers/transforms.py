"""The transforms of a bag (tf): where one frame lies in another, through several links, at the time of each message."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from push_ident.bags.decode import stamp_ns
from push_ident.bags.opening import OpenBag
from push_ident.errors import ContentError
from push_ident.limits import LIMITS, plain_text
from push_ident.types import BoolArray, Float64Array

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

TYPES: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_GAP: Final = 1.0
"""Longest time between two transforms of a link among which it is interpolated [s]."""
_FLAT: Final = float(np.radians(2.0))
"""Angle between two z axes that a planar pose neglects [rad]."""


@dataclass(frozen=True, slots=True)
class _Link:
    """A frame in its parent."""

    parent: str
    rows: Float64Array
    """Rows (time, x, y, z, qx, qy, qz, qw) [s, m], shape (n, 8), time strictly increasing; one where the link does not move."""

    @property
    def moves(self) -> bool:
        return len(self.rows) > 1

    def at(self, time: Float64Array) -> tuple[Rotation, Float64Array, BoolArray]:
        """Rotation and shift [m] at each time [s], shape (n,), and whether they are known."""
        from scipy.spatial.transform import Rotation, Slerp

        own, known = self.rows[:, 0], np.ones(len(time), dtype=np.bool_)
        if not self.moves:
            return (
                Rotation.from_quat(np.repeat(self.rows[:, 4:], len(time), axis=0)),
                np.repeat(self.rows[:, 1:4], len(time), axis=0),
                known,
            )
        after = np.clip(np.searchsorted(own, time), 1, len(own) - 1)
        known = (time >= own[0]) & (time <= own[-1]) & (own[after] - own[after - 1] <= _GAP)
        within = np.clip(time, own[0], own[-1])
        shift = np.column_stack([np.interp(within, own, self.rows[:, axis]) for axis in (1, 2, 3)])
        return Slerp(own, Rotation.from_quat(self.rows[:, 4:]))(within), shift, known


class Transforms:
    """The transforms of an open bag, read when they are first asked for.

    Args:
        bag: open.
        log_time: whether the times of recording count instead of the stamps.
    """

    def __init__(self, bag: OpenBag, *, log_time: bool) -> None:
        self._bag, self._log_time = bag, log_time

    @property
    def are_recorded(self) -> bool:
        """Whether the bag has any."""
        return any(topic.msgcount for topic in self._bag.topics if topic.msgtype in TYPES)

    @cached_property
    def _links(self) -> dict[str, _Link]:
        """Link by its child. The latest parent counts."""
        topics = [topic for topic in self._bag.topics if topic.msgtype in TYPES]
        self._bag.register(topics)
        parents: dict[str, str] = {}
        static: dict[str, bool] = {}
        numbers: dict[str, array[float]] = defaultdict(lambda: array("d"))
        for topic, logged, message in self._bag.messages(topics):
            LIMITS.TRANSFORMS.check(len(message.transforms), topic.topic, error=ContentError)
            for stamped in message.transforms:
                shift, turn = stamped.transform.translation, stamped.transform.rotation
                row = (shift.x, shift.y, shift.z, turn.x, turn.y, turn.z, turn.w)
                child = stamped.child_frame_id.strip("/")
                # Two frames without a name are not one.
                if not child or not np.isfinite(row).all() or max(map(abs, row[:3])) > LIMITS.COORDINATE.value or not any(row[3:]):
                    continue
                parents[child] = stamped.header.frame_id.strip("/")
                static[child] = topic.topic.endswith("tf_static")
                numbers[child].extend((1e-9 * (0 if self._log_time else stamp_ns(stamped.header.stamp)) or 1e-9 * logged, *row))
        LIMITS.TRANSFORMS.check(len(parents), "frames", error=ContentError)
        return {child: _Link(parent, _in_order(numbers[child], last_only=static[child])) for child, parent in parents.items()}

    @property
    def frames(self) -> tuple[str, ...]:
        """All of them."""
        return tuple(sorted({*self._links, *(link.parent for link in self._links.values())}))

    def chain(self, frame: str) -> list[str]:
        """A frame, its parent and so on to the root. Raises ContentError where it is its own ancestor."""
        ancestry = [frame]
        while (link := self._links.get(ancestry[-1])) is not None:
            if link.parent in ancestry:
                raise ContentError(f"the transforms lead from {plain_text(frame)} round in a circle; one frame has two parents in them.")
            ancestry.append(link.parent)
        return ancestry

    def common(self, frames: Iterable[str]) -> str:
        """The nearest frame from which there are links to all of these; empty where there is none."""
        first, *others = (self.chain(frame) for frame in frames)
        return next((frame for frame in first if all(frame in other for other in others)), "")

    def times(self, frame: str) -> Float64Array:
        """When the nearest link above a frame that moves was recorded [s]; empty where none does."""
        return next((self._links[child].rows[:, 0] for child in self.chain(frame)[:-1] if self._links[child].moves), np.zeros(0))

    def moves(self, frame: str, other: str) -> bool:
        """Whether a link between two frames moves."""
        chains, at = (self.chain(frame), self.chain(other)), self.common((frame, other))
        return any(self._links[child].moves for chain in chains for child in (chain[: chain.index(at)] if at else chain[:-1]))

    def is_flat(self, frame: str) -> bool:
        """Whether a frame stands still in the root of its chain, with z up there."""
        if len(self.times(frame)):
            return False
        rotation, _, _ = self._in(frame, self.chain(frame)[-1], np.zeros(1))
        return float(np.arccos(np.clip(rotation.as_matrix()[0, 2, 2], -1.0, 1.0))) <= _FLAT

    def between(self, frame: str, target: str, time: Float64Array) -> tuple[Rotation, Float64Array, BoolArray]:
        """Rotation and shift [m] that bring vectors of a frame to the target at each time [s], shape (n,), and whether they are known.

        The frames have a `common` one.
        """
        common = self.common((frame, target))
        rotation, shift, known = self._in(frame, common, time)
        back, origin, also = self._in(target, common, time)
        return back.inv() * rotation, back.inv().apply(shift - origin), known & also

    def _in(self, frame: str, ancestor: str, time: Float64Array) -> tuple[Rotation, Float64Array, BoolArray]:
        from scipy.spatial.transform import Rotation

        rotation, shift = Rotation.identity(len(time)), np.zeros((len(time), 3))
        known = np.ones(len(time), dtype=np.bool_)
        chain = self.chain(frame)
        for child in chain[: chain.index(ancestor)]:
            turn, step, is_known = self._links[child].at(time)
            rotation, shift, known = turn * rotation, turn.apply(shift) + step, known & is_known
        return rotation, shift, known


def _in_order(numbers: array[float], *, last_only: bool) -> Float64Array:
    """Rows of a link, shape (n, 8), in order of time, each time once."""
    rows = np.array(numbers, dtype=np.float64).reshape(-1, 8)
    return rows[-1:] if last_only else rows[np.unique(rows[:, 0], return_index=True)[1]]
