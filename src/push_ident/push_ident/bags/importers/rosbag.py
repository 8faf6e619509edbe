"""Bags of ROS 1 and ROS 2 with other topics than those of the contract: the user says which topic holds what."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.decode import stamp_ns
from push_ident.bags.importers.axes import planar_of
from push_ident.bags.importers.recording import Recording, RecordingOptions, import_recording, without_gaps, without_lost
from push_ident.bags.importers.report import ImportReport
from push_ident.bags.importers.shapes import CELL_SIZE
from push_ident.bags.importers.tracked_poses import read_outline
from push_ident.bags.opening import OpenBag, open_bag
from push_ident.errors import BagError, InputError
from push_ident.limits import LIMITS, plain_text
from push_ident.types import Float64Array

ROLES: Final = ("object", "pusher", "wrench")
"""What a topic may hold: poses of the object, poses of the tool tip, forces on the object."""
_NEEDED: Final = ("object", "pusher")
_CHILD: Final = "#"
"""Separates a topic of transforms from the child frame that is meant."""


@dataclass(frozen=True, slots=True)
class RosbagTopics:
    """A bag, which of its topics hold what, and what it does not say."""

    bag: Path
    topics: Mapping[str, str]
    """Role of `ROLES` -> topic; of transforms with the child frame, as `/tf#tool0`."""
    outline: Path
    """Table of the outline's vertices x, y [m], object frame, in the order around it."""
    options: RecordingOptions
    outline_length: float = 1.0
    """[m] per unit of `outline`."""
    cell_size: float = CELL_SIZE
    """[m]"""
    axes: Float64Array = field(default_factory=lambda: np.eye(3))
    """Rotation from the axes of the object's poses to those of `table`, shape (3, 3); see `parse_axes`."""
    pusher_axes: Float64Array = field(default_factory=lambda: np.eye(3))
    """Likewise of the pusher."""
    wrench_axes: Float64Array | None = None
    """Likewise of the force; None: as of the pusher, in whose frame it then has to be."""
    log_time: bool = False
    """Whether the times of recording count instead of the stamps."""
    wrench_on_sensor: bool = False
    """Whether the force is that on the sensor, the negative of that on the object."""


def parse_map(texts: list[str]) -> dict[str, str]:
    """`TOPIC=ROLE` of the command line as role -> topic. Raises InputError for another form, or for roles that are lacking."""
    topics: dict[str, str] = {}
    for text in texts:
        topic, equals, role = (part.strip() for part in text.rpartition("="))
        if not (equals and topic) or role not in ROLES:
            raise InputError(f"--map is `{plain_text(text)}`, expected TOPIC=ROLE with a role of {', '.join(ROLES)}.")
        if role in topics:
            raise InputError(f"--map names two topics for {role}, {plain_text(topics[role])} and {plain_text(topic)}; give one of them.")
        topics[role] = topic
    if lacking := [role for role in _NEEDED if role not in topics]:
        raise InputError(f"--map names no topic for {' and '.join(lacking)}; add --map TOPIC={lacking[0]}.")
    return topics


def import_rosbag(source: RosbagTopics, out_bag: Path) -> ImportReport:
    """Convert a bag to a new contract bag, with a push record for each push; see `import_recording`.

    Poses may be PoseStamped, PoseWithCovarianceStamped, TransformStamped, Odometry, Pose, or transforms of one child frame; forces
    WrenchStamped or Wrench. Raises BagError for topics that are not there or hold something else, InputError for options out of range.
    """
    source.options.check()
    shape = read_outline(source.outline, length=source.outline_length, cell_size=source.cell_size)
    notes: list[str] = []
    with open_bag(source.bag) as bag:
        streams = {role: _read(bag, topic, source.log_time, notes) for role, topic in source.topics.items()}
    _check_frames(streams, source)
    body, tool = streams["object"], streams["pusher"]
    rows, names = _rows(body, notes), (f"{source.bag} {body.topic}", f"{source.bag} {tool.topic}")
    yaw = np.unwrap(planar_of(rows[:, 4:8], source.axes, names[0], notes))
    poses = np.column_stack([rows[:, 0], (rows[:, 1:4] @ source.axes.T)[:, :2], yaw])
    pusher = _rows(tool, notes)
    pusher = np.column_stack([pusher[:, 0], pusher[:, 1:4] @ source.pusher_axes.T])
    force = _force(streams["wrench"], source, notes) if "wrench" in streams else np.zeros((0, 3))
    return import_recording(Recording(poses, pusher, shape, None, force, names, tuple(notes), source.pusher_axes), source.options, out_bag)


@dataclass(frozen=True, slots=True)
class _Stream:
    topic: str
    rows: Float64Array
    """Rows (time, …): position and quaternion of a pose, shape (n, 8), or a force, shape (n, 4)."""
    frames: frozenset[str]


def _read(bag: OpenBag, topic: str, log_time: bool, notes: list[str]) -> _Stream:
    name, _, child = topic.partition(_CHILD)
    found = [recorded for recorded in bag.topics if recorded.topic.strip("/") == name.strip("/")]
    if not sum(recorded.msgcount for recorded in found):
        present = ", ".join(f"{topic} ({count})" for topic, count in bag.counts().items() if count)[:500]
        raise BagError(f"{bag.path}: nothing on {plain_text(name)}; the bag has {present or 'no messages at all'}.")
    bag.register(found)
    rows, stamped, frames, children = [], [], set(), set()
    for _, logged, message in bag.messages(found):
        for header, values, of_child in _samples(message, plain_text(topic)):
            children.add(of_child)
            if child and of_child.strip("/") != child.strip("/"):
                continue
            stamp = stamp_ns(header.stamp) if header is not None and not log_time else 0
            rows.append([1e-9 * (stamp or logged), *values])
            stamped.append(stamp != 0)
            frames.add(str(header.frame_id).strip("/") if header is not None else "")
    if not rows or (not child and len(children) > 1):
        listed = ", ".join(sorted(filter(None, children)))[:300]
        raise BagError(
            f"{bag.path}: {plain_text(topic)} holds transforms of {listed}; name one of them as {plain_text(name)}{_CHILD}FRAME."
        )
    ordered = np.array(rows, dtype=np.float64)
    if not log_time and not all(stamped):
        # The log time is that of another clock where messages have stamps.
        without, used = stamped.count(False), "left out" if any(stamped) else "their log time is used"
        notes.append(f"{plain_text(topic)}: {without} of {len(stamped)} messages have no stamp; {used}")
        ordered = ordered[stamped] if any(stamped) else ordered
    return _Stream(topic, ordered[np.argsort(ordered[:, 0], kind="stable")] if log_time else ordered, frozenset(frames - {""}))


def _samples(message: Any, topic: str) -> Iterator[tuple[Any, tuple[float, ...], str]]:
    """Header, numbers and child frame of what a message holds. Raises BagError for a message without a pose or a force."""
    if hasattr(message, "transforms"):
        for transform in message.transforms:
            yield from _samples(transform, topic)
        return
    header, child = getattr(message, "header", None), str(getattr(message, "child_frame_id", ""))
    inner = message
    for name in ("pose", "pose", "transform", "wrench"):
        inner = getattr(inner, name, inner)
    if hasattr(inner, "force"):
        yield header, (inner.force.x, inner.force.y, inner.force.z), child
        return
    place, turn = getattr(inner, "position", getattr(inner, "translation", None)), getattr(inner, "orientation", None)
    turn = getattr(inner, "rotation", turn)
    if place is None or turn is None:
        raise BagError(f"{topic} holds {type(message).__name__.split('__')[-1]}, expected poses, transforms or wrenches.")
    yield header, (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w), child


def _check_frames(streams: Mapping[str, _Stream], source: RosbagTopics) -> None:
    """Raise BagError unless what is compared is in one frame, and each topic holds what its role needs."""
    for role, stream in streams.items():
        width = 4 if role == "wrench" else 8
        if stream.rows.shape[1] != width:
            wanted = "forces" if role == "wrench" else "poses"
            raise BagError(f"{source.bag}: {plain_text(stream.topic)} is mapped to {role}, which needs {wanted}; map another topic.")
        if len(stream.frames) > 1:
            raise BagError(f"{source.bag}: {plain_text(stream.topic)} is in the frames {', '.join(sorted(stream.frames))}, expected one.")
    ours, theirs = streams["object"].frames, streams["pusher"].frames
    if ours and theirs and ours != theirs and source.options.pusher_frame is None:
        raise BagError(
            f"{source.bag}: object poses are in `{plain_text(*ours)}`, the pusher in `{plain_text(*theirs)}`; say with "
            "--pusher-frame X,Y,YAW where the second lies in the first (0,0,0 where they are one)."
        )
    felt = streams["wrench"].frames if "wrench" in streams else frozenset[str]()
    if felt and theirs and felt != theirs and source.wrench_axes is None:
        raise BagError(
            f"{source.bag}: the force is in `{plain_text(*felt)}`, the pusher in `{plain_text(*theirs)}`; say with --wrench-axes which "
            "axes of the sensor are x, y and z of the table (x,y,z where they are parallel; x,-y,-z for a sensor that looks down at yaw "
            "0), or turn the force into the frame of the pusher before recording where the sensor turns."
        )


def _rows(stream: _Stream, notes: list[str]) -> Float64Array:
    places = [f"message {number}" for number in range(1, len(stream.rows) + 1)]
    rows = stream.rows if stream.rows.shape[1] == 4 else without_lost(stream.rows, stream.topic, notes)
    return without_gaps(rows, [True] * rows.shape[1], places, stream.topic, notes)


def _force(stream: _Stream, source: RosbagTopics, notes: list[str]) -> Float64Array:
    """Rows (time, fx, fy) of the force on the object [s, N, N], shape (n, 3)."""
    rows = _rows(stream, notes)
    axes = source.pusher_axes if source.wrench_axes is None else source.wrench_axes
    force = (rows[:, 1:] @ axes.T)[:, :2] * (-1.0 if source.wrench_on_sensor else 1.0)
    LIMITS.FORCE.check(float(np.abs(force).max()), stream.topic, error=BagError)
    return np.column_stack([rows[:, 0], force])
