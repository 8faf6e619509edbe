"""Bags of ROS 1 and ROS 2 with other topics than those of the contract: the user says which topic holds what."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.decode import stamp_ns
from push_ident.bags.importers.axes import planar_of
from push_ident.bags.importers.recording import (
    Recording,
    RecordingOptions,
    import_recording,
    joined,
    without_gaps,
    without_lost,
)
from push_ident.bags.importers.report import ImportReport
from push_ident.bags.importers.shapes import CELL_SIZE
from push_ident.bags.importers.tracked_poses import read_outline
from push_ident.bags.importers.transforms import TYPES, Transforms
from push_ident.bags.opening import OpenBag, open_bag
from push_ident.errors import BagError, ContentError, InputError
from push_ident.geometry.frames import TABLE_FRAME
from push_ident.limits import LIMITS, plain_text
from push_ident.types import Float64Array, ObjectShape

ROLES: Final = ("object", "pusher", "wrench")
"""What a topic may hold: poses of the object, poses of the tool tip, forces on the object."""
_NEEDED: Final = ("object", "pusher")
_POSES: Final = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry", "Pose", "TFMessage")
_FORCES: Final = ("WrenchStamped", "Wrench")
"""Messages that a topic may hold; of others those that have the same fields."""
_LEVEL: Final = 0.01
"""By which heights of one object on one table may differ among bags [m]: a tilt of 2 degrees, which planar poses neglect, over 0.3 m."""
_CHILD: Final = "#"
"""Separates a topic of transforms from the child frame that is meant."""


@dataclass(frozen=True, slots=True)
class RosbagTopics:
    """A bag, or several of one push each, which of their topics hold what, and what they do not say."""

    bag: Path
    topics: Mapping[str, str]
    """Role of `ROLES` -> topic; of transforms with the child frame, as `/tf#tool0`."""
    outline: Path
    """Table of the outline's vertices x, y [m], object frame, in the order around it."""
    options: RecordingOptions
    length: float = 1.0
    """[m] per unit of the object's positions."""
    pusher_length: float | None = None
    """[m] per unit of the pusher's positions; None: as of the object's."""
    outline_length: float = 1.0
    """[m] per unit of `outline`."""
    cell_size: float = CELL_SIZE
    """[m]"""
    axes: Float64Array = field(default_factory=lambda: np.eye(3))
    """Rotation from the axes of the object's poses to those of `table`, shape (3, 3); see `parse_axes`."""
    pusher_axes: Float64Array = field(default_factory=lambda: np.eye(3))
    """Likewise of the pusher."""
    wrench_axes: Float64Array | None = None
    """Likewise of the force; None: as of the pusher, to whose frame it is brought."""
    frame: str = ""
    """Frame of the bag's transforms with z up to which everything is brought; empty: the nearest from which they lead to object and pusher,
    where these are in two."""
    log_time: bool = False
    """Whether the times of recording count instead of the stamps."""
    wrench_on_sensor: bool = False
    """Whether the force is that on the sensor, the negative of that on the object."""
    more_bags: tuple[Path, ...] = ()
    """Further bags, with pushes of the same object on the same table on the same topics."""


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
    """Convert a bag, or several as one, to a new contract bag, with a push record for each push; see `import_recording` and `joined`.

    Object, pusher and force in different frames are brought to one by the transforms of the bag.

    Poses may be PoseStamped, PoseWithCovarianceStamped, TransformStamped, Odometry, Pose, or transforms of one child frame; forces
    WrenchStamped or Wrench. Raises BagError for topics that are not there or hold something else, or bags of two objects or tables,
    InputError for options out of range, or a bag that is given twice.
    """
    source.options.check()
    shape = read_outline(source.outline, length=source.outline_length, cell_size=source.cell_size)
    bags = (source.bag, *source.more_bags)
    LIMITS.PUSHES.check(len(bags), "the list of bags", remedy="Name fewer bags.")
    paths = [bag.resolve() for bag in bags]
    if twice := [bag for at, bag in enumerate(bags) if paths[at] in paths[:at]]:
        raise InputError(f"{twice[0]} is given twice, expected each bag once; leave one out.")
    read = [_read_bag(replace(source, bag=bag), shape) for bag in bags]
    for bag, (_, setup) in zip(bags[1:], read[1:], strict=True):
        _check_same(bag, setup, source.bag, read[0][1])
    return import_recording(*joined([recording for recording, _ in read], source.options), out_bag)


@dataclass(frozen=True, slots=True)
class _Setup:
    """What all bags of one object on one table have in common."""

    frames: Mapping[str, str]
    """Of poses and forces after all transforms, by role."""
    body: str
    """Child frame of the object's poses; empty where the messages name none."""
    height: float
    """Median height of the object's poses [m]."""


def _read_bag(source: RosbagTopics, shape: ObjectShape) -> tuple[Recording, _Setup]:
    """The first bag of `source`."""
    notes: list[str] = []
    with open_bag(source.bag) as bag:
        transforms = Transforms(bag, log_time=source.log_time)
        streams = {role: _read(bag, role, topic, transforms, source, notes) for role, topic in source.topics.items()}
        streams = _in_one_frame({role: _cleaned(stream, notes) for role, stream in streams.items()}, transforms, source, notes)
    body, tool = streams["object"], streams["pusher"]
    rows, names = body.rows, (f"{source.bag} {body.topic}", f"{source.bag} {tool.topic}")
    other = "; or name a frame of the bag's transforms with z up as --frame" if transforms.are_recorded else ""
    yaw = np.unwrap(planar_of(rows[:, 4:8], source.axes, names[0], notes, other))
    position = rows[:, 1:4] @ source.axes.T
    poses = np.column_stack([rows[:, 0], position[:, :2], yaw])
    pusher = np.column_stack([tool.rows[:, 0], tool.rows[:, 1:4] @ source.pusher_axes.T])
    force = _force(streams["wrench"], source) if "wrench" in streams else np.zeros((0, 3))
    recording = Recording(poses, pusher, shape, None, force, names, tuple(notes), pusher_axes=source.pusher_axes)
    frames = {role: next(iter(stream.frames)) for role, stream in streams.items()}
    return recording, _Setup(frames, body.child, float(np.median(position[:, 2])))


def _check_same(bag: Path, setup: _Setup, first: Path, expected: _Setup) -> None:
    """Raise ContentError where a bag shows another object or another table than the first one."""
    apart = "import the bags of each object and table to a bag of their own"
    for role, frame in setup.frames.items():
        if frame != expected.frames[role]:
            got, other = plain_text(frame), plain_text(expected.frames[role])
            what = "forces" if role == "wrench" else f"{role} poses"
            raise ContentError(f"{bag}: {what} are in `{got}`, expected `{other}` as in {first}; name one of both as --frame, or {apart}.")
    if setup.body and expected.body and setup.body != expected.body:
        got, other = plain_text(setup.body), plain_text(expected.body)
        raise ContentError(f"{bag}: the object's poses are those of `{got}`, expected `{other}` as in {first}; {apart}.")
    if abs(setup.height - expected.height) > _LEVEL:
        got, other = f"{1e3 * setup.height:.0f} mm", f"{1e3 * expected.height:.0f} mm within {1e3 * _LEVEL:.0f} mm"
        raise ContentError(f"{bag}: the object is at a height of {got}, expected {other} as in {first}: another object or table; {apart}.")


@dataclass(frozen=True, slots=True)
class _Stream:
    topic: str
    rows: Float64Array
    """Rows (time, …): position and quaternion of a pose, shape (n, 8), or a force, shape (n, 4)."""
    frames: frozenset[str]
    child: str = ""
    """Child frame that the messages name."""


def _read(bag: OpenBag, role: str, topic: str, transforms: Transforms, source: RosbagTopics, notes: list[str]) -> _Stream:
    name, _, child = topic.partition(_CHILD)
    log_time = source.log_time
    found = [recorded for recorded in bag.topics if recorded.topic.strip("/") == name.strip("/")]
    if not sum(recorded.msgcount for recorded in found):
        present = ", ".join(f"{topic} ({count})" for topic, count in bag.counts().items() if count)[:500]
        raise ContentError(f"{bag.path}: nothing on {plain_text(name)}; the bag has {present or 'no messages at all'}. Map one of these.")
    bag.register(found)
    kinds = {recorded.msgtype for recorded in found}
    rows, stamped, frames, children = [], [], set(), set()
    for recorded, logged, message in bag.messages(found):
        for header, values, of_child in _samples(message):
            if values is None:
                raise _unusable(bag, role, topic, recorded.msgtype)
            children.add(of_child)
            if child and of_child.strip("/") != child.strip("/"):
                continue
            stamp = stamp_ns(header.stamp) if header is not None and not log_time else 0
            rows.append([1e-9 * (stamp or logged), *values])
            stamped.append(stamp != 0)
            frames.add(str(header.frame_id).strip("/") if header is not None else "")
    if child and len(rows) < 2 and kinds & set(TYPES) and len(times := transforms.times(child.strip("/"))):
        # A frame that stands still in one that moves.
        own = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        return _Stream(topic, np.column_stack([times, np.tile(own, (len(times), 1))]), frozenset({child.strip("/")}))
    if not rows or (not child and len(children) > 1):
        listed = ", ".join(sorted(filter(None, children)))[:300]
        raise ContentError(
            f"{bag.path}: {plain_text(topic)} holds transforms of {listed}; name one of them as {plain_text(name)}{_CHILD}FRAME."
        )
    ordered = np.array(rows, dtype=np.float64)
    if not log_time and not all(stamped):
        # The log time is that of another clock where messages have stamps.
        without, used = stamped.count(False), "left out" if any(stamped) else "their log time is used"
        notes.append(f"{plain_text(topic)}: {without} of {len(stamped)} messages have no stamp; {used}")
        ordered = ordered[stamped] if any(stamped) else ordered
    ordered = ordered[np.argsort(ordered[:, 0], kind="stable")] if log_time else ordered
    if ordered.shape[1] == 8:
        length = source.length if role != "pusher" or source.pusher_length is None else source.pusher_length
        ordered[:, 1:4] *= length
    return _Stream(topic, ordered, frozenset(frames), "" if child else next(iter(children)).strip("/"))


def _unusable(bag: OpenBag, role: str, topic: str, msgtype: str) -> ContentError:
    """For a message without a pose or a force."""
    kinds = _FORCES if role == "wrench" else _POSES
    name = plain_text(msgtype)
    return ContentError(
        f"{bag.path}: {plain_text(topic)} holds {name.rpartition('/')[2]} ({name}); expected one of {', '.join(kinds)} for {role}. "
        "Publish it as one of these while you play the recording, or write it to a table for `push-ident import csv`."
    )


def _samples(message: Any) -> Iterator[tuple[Any, tuple[float, ...] | None, str]]:
    """Header, numbers and child frame of what a message holds; None for a message without a pose or a force."""
    if hasattr(message, "transforms"):
        for transform in message.transforms:
            yield from _samples(transform)
        return
    header, child = getattr(message, "header", None), str(getattr(message, "child_frame_id", ""))
    inner: Any = message
    for name in ("pose", "pose", "transform", "wrench"):
        inner = getattr(inner, name, inner)
    place: Any = getattr(inner, "position", getattr(inner, "translation", None))
    turn: Any = getattr(inner, "orientation", getattr(inner, "rotation", None))
    force: Any = getattr(inner, "force", None)
    if all(hasattr(force, axis) for axis in "xyz"):
        yield header, (force.x, force.y, force.z), child
    elif all(hasattr(place, axis) for axis in "xyz") and all(hasattr(turn, axis) for axis in "xyzw"):
        yield header, (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w), child
    else:
        yield header, None, child


def _cleaned(stream: _Stream, notes: list[str]) -> _Stream:
    """Without lost tracking and repeated times, in order of time."""
    places = [f"message {number}" for number in range(1, len(stream.rows) + 1)]
    rows = stream.rows if stream.rows.shape[1] == 4 else without_lost(stream.rows, stream.topic, notes)
    return replace(stream, rows=without_gaps(rows, [True] * rows.shape[1], places, stream.topic, notes))


def _in_one_frame(streams: Mapping[str, _Stream], transforms: Transforms, source: RosbagTopics, notes: list[str]) -> dict[str, _Stream]:
    """Streams in the frame of the object's poses, or in that from which the transforms of the bag lead to all of them.

    Raises BagError where there is no such frame and no option says how the frames lie, or a topic holds something else than its role.
    """
    unnamed = plain_text(", ".join(stream.topic for stream in streams.values() if "" in stream.frames))
    streams = {role: _named(role, stream, source, notes) for role, stream in streams.items()}
    for role, stream in streams.items():
        if stream.rows.shape[1] != (4 if role == "wrench" else 8):
            wanted = "forces" if role == "wrench" else "poses"
            raise ContentError(f"{source.bag}: {plain_text(stream.topic)} is mapped to {role}, which needs {wanted}; map another topic.")
        if len(stream.frames) > 1:
            listed = plain_text(", ".join(sorted(stream.frames)))
            raise ContentError(f"{source.bag}: {plain_text(stream.topic)} is in the frames {listed}, expected one; record them as topics.")
    if source.frame and source.frame not in transforms.frames:
        known = plain_text(", ".join(transforms.frames)) or "no transforms"
        raise InputError(f"--frame is {plain_text(source.frame)!r}, expected a frame of the bag's transforms; it has {known}.")
    ours, theirs = (next(iter(streams[role].frames)) for role in _NEEDED)
    is_told = source.options.pusher_frame is not None
    target = source.frame or (ours if ours == theirs or is_told else transforms.common((ours, theirs)))
    if not target:
        raise _two_frames(source, transforms, ours, theirs, unnamed)
    moved = {}
    for role, stream in streams.items():
        frame = next(iter(stream.frames))
        to = theirs if is_told and role != "object" else target
        if frame == to or (role == "wrench" and source.wrench_axes is not None):
            moved[role] = stream
        elif transforms.common((frame, to)):
            moved[role] = _brought(stream, frame, to, transforms, notes)
        else:
            raise _two_frames(source, transforms, to, frame, unnamed, role)
    return moved


def _named(role: str, stream: _Stream, source: RosbagTopics, notes: list[str]) -> _Stream:
    """With the frame `table` in place of none, and a note of it where no option says where the unknown frame lies."""
    if "" not in stream.frames:
        return stream
    is_told = source.wrench_axes is not None if role == "wrench" else source.options.pusher_frame is not None
    if not is_told:
        other = "--wrench-axes" if role == "wrench" else "--pusher-frame X,Y,YAW"
        notes.append(f"{plain_text(stream.topic)}: no frame_id; taken as in `{TABLE_FRAME}`. If it is in another frame, give {other}")
    return replace(stream, frames=frozenset(frame or TABLE_FRAME for frame in stream.frames))


def _two_frames(source: RosbagTopics, transforms: Transforms, ours: str, theirs: str, unnamed: str, role: str = "pusher") -> ContentError:
    """For streams in two frames between which no transforms lead, with the option that can say how they lie; `unnamed` lack a frame."""
    what = "the force is" if role == "wrench" else f"{role} poses are"
    where = f"`{plain_text(theirs)}`, the object in `{plain_text(ours)}`"
    where += f" ({unnamed}: no frame_id, taken as `{TABLE_FRAME}`)" if unnamed else ""
    text = f"{source.bag}: {what} in {where}, and no transforms of the bag lead from one to the other"
    if not (transforms.is_flat(ours) and transforms.is_flat(theirs)):
        return ContentError(
            f"{text}; one of them moves or is tilted, so no option can say how they lie: record /tf and /tf_static as well."
        )
    if role == "wrench":
        return ContentError(
            f"{text}; say with --wrench-axes which axes of the sensor are x, y and z of the table (x,y,z where they are parallel; x,-y,-z "
            "for a sensor that looks down at yaw 0), or record /tf and /tf_static as well where the sensor turns."
        )
    return ContentError(
        f"{text}; record /tf and /tf_static as well, or say with --pusher-frame X,Y,YAW where the second lies in the first, if it stands "
        "still there with z up (0,0,0 where they are one)."
    )


def _brought(stream: _Stream, frame: str, target: str, transforms: Transforms, notes: list[str]) -> _Stream:
    """A stream in another frame, without messages for whose time the transforms are not known."""
    from scipy.spatial.transform import Rotation

    rotation, shift, known = transforms.between(frame, target, stream.rows[:, 0])
    rows = stream.rows.copy()
    rows[:, 1:4] = rotation.apply(rows[:, 1:4])
    if rows.shape[1] == 8:
        rows[:, 1:4] += shift
        length = np.linalg.norm(rows[:, 4:], axis=1)
        turned = np.flatnonzero(length > 0)
        rows[turned, 4:] = length[turned, None] * (rotation[turned] * Rotation.from_quat(rows[turned, 4:])).as_quat()
    name, n_lost = plain_text(stream.topic), int(np.sum(~known))
    when = " at the time of each message" if transforms.moves(frame, target) else ""
    notes.append(f"{name}: brought from `{plain_text(frame)}` to `{plain_text(target)}` by the transforms of the bag{when}")
    if len(rows) - n_lost < 2:
        raise ContentError(f"{name}: the transforms from {plain_text(frame)} to {plain_text(target)} are of other times than its messages.")
    if n_lost:
        notes.append(f"{name}: {n_lost} of {len(rows)} messages have no transform at their time and are left out")
    return replace(stream, rows=rows[known], frames=frozenset({target}))


def _force(stream: _Stream, source: RosbagTopics) -> Float64Array:
    """Rows (time, fx, fy) of the force on the object [s, N, N], shape (n, 3)."""
    rows = stream.rows
    axes = source.pusher_axes if source.wrench_axes is None else source.wrench_axes
    force = (rows[:, 1:] @ axes.T)[:, :2] * (-1.0 if source.wrench_on_sensor else 1.0)
    LIMITS.FORCE.check(float(np.abs(force).max()), stream.topic, error=BagError)
    return np.column_stack([rows[:, 0], force])
