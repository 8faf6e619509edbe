"""Reading contract bags: `read_bag` reads the small topics into memory, depth frames are decoded one by one."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

from push_ident.bags import decode
from push_ident.bags.contract import OBJECT_ROLES, Role, TopicRole
from push_ident.bags.opening import Connection, OpenBag, open_bag
from push_ident.bags.read_options import MAPPING, ReadOptions, map_hint, message_types, word_of
from push_ident.bags.records import LATE
from push_ident.errors import BagError, ContentError, FrameError, InputError
from push_ident.geometry.cut_cells import cut_at_outline
from push_ident.geometry.frames import CAMERA_FRAME, TABLE_FRAME
from push_ident.geometry.outline import outline_of_cells
from push_ident.geometry.shape_check import check_shape
from push_ident.limits import LIMITS, plain_text
from push_ident.perception.frame.camera_info import intrinsics_of
from push_ident.pushing.cutter import PushInterval
from push_ident.types import CameraAccuracy, CameraIntrinsics, DepthFrame, Float64Array, ObjectShape, PusherShape

_STAMPED: Final = frozenset({Role.POSE, Role.PUSHER, Role.WRENCH})
_LAST_COUNTS: Final = frozenset({Role.CELLS, Role.OUTLINE, Role.OUTLINE_STD, Role.PUSHER_SHAPE, Role.CAMERA_ACCURACY})
"""Latched topics: a newer message replaces the previous one."""
_DEPTH: Final = frozenset({Role.DEPTH, Role.CAMERA_INFO})


@dataclass(frozen=True, slots=True)
class Samples:
    """A recorded quantity over the whole bag."""

    time: Float64Array
    """[s] since the origin of the bag, shape (n,), strictly increasing."""
    value: Float64Array
    """Shape (n, ...)."""

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, slots=True)
class ObjectTrack:
    """The data of one object in a bag."""

    shape: ObjectShape | None
    """None where the bag has no usable cells."""
    time: Float64Array
    """[s] since the origin of the bag, shape (n_frames,), strictly increasing; empty where there are no poses."""
    pose: Float64Array
    """(x, y, yaw) of the object frame in `table` [m, m, rad], shape (n_frames, 3)."""
    covariance: Float64Array
    """Covariance of (x, y, yaw), shape (n_frames, 3, 3); zero where it is unknown: of position, yaw or both."""
    has_outline: bool = True
    """Whether the outline was measured; else it was traced from the cells."""


@dataclass(frozen=True, slots=True)
class BagContents:
    """The content of a bag in the types of the package. Times are in seconds since `origin_ns`."""

    path: Path
    origin_ns: int
    """Absolute time of time zero [ns]."""
    objects: dict[str, ObjectTrack]
    pusher: Samples
    """Positions of the tool tip in `table` [m], shape (n, 2); of a tool that is no cylinder its poses (x, y, yaw), shape (n, 3)."""
    pusher_shape: PusherShape | None
    """None where the bag does not have it."""
    wrench: Samples | None
    """Force of the pusher on the object in `table` [N], shape (n, 2)."""
    push_intervals: tuple[PushInterval, ...]
    """In order of time; empty where the bag has no push records."""
    camera_in_table: Float64Array | None
    """Pose of the optical frame in `table`, homogeneous, shape (4, 4), where the bag has it."""
    camera_accuracy: CameraAccuracy | None
    """How well that pose is known, where the bag has it."""
    n_depth: int
    """Depth images in the bag."""
    topics: dict[str, int]
    """Messages by topic, all topics."""
    notes: list[str] = field(default_factory=list)
    """Data that was missing, dropped or assumed; one line each."""
    options: ReadOptions = field(default_factory=ReadOptions)
    """How it was read."""

    @property
    def pusher_radius(self) -> float | None:
        """As `PusherShape.radius` [m]; None where the bag does not have it."""
        return None if self.pusher_shape is None else self.pusher_shape.radius

    @property
    def has_poses(self) -> bool:
        """Whether any object has poses; without them they can be tracked in depth frames."""
        return any(len(track.time) for track in self.objects.values())

    def depth_frames(self) -> Iterator[DepthFrame]:
        """Depth frames in recorded order, decoded one at a time; unusable ones are skipped and counted in `notes`.

        Raises BagError when the bag has no depth images or no camera info, FrameError when no image is usable.
        """
        with open_bag(self.path) as bag:
            yield from _depth_frames(bag, self.origin_ns, self.notes, self.options)


@dataclass(frozen=True, slots=True)
class DepthRecording:
    """The depth images of a bag, whatever else it has or lacks."""

    path: Path
    camera_in_table: Float64Array | None
    """Pose of the optical frame in `table`, homogeneous, shape (4, 4), where the bag has it."""
    notes: list[str] = field(default_factory=list)
    """Images that are not usable, and what else was left out."""
    options: ReadOptions = field(default_factory=ReadOptions)
    """How it was read."""

    def frames(self) -> Iterator[DepthFrame]:
        """As `BagContents.depth_frames`; stamps are seconds since 1970 or since the start of the clock [s]."""
        with open_bag(self.path) as bag:
            yield from _depth_frames(bag, 0, self.notes, self.options)


@dataclass(slots=True)
class _Recorded:
    stamps: list[int] = field(default_factory=list)
    """[ns]"""
    values: list[Float64Array] = field(default_factory=list)
    """Planar values of the roles in `_STAMPED`."""
    messages: list[Any] = field(default_factory=list)
    """Messages of the other roles: all, or the last one of latched topics."""
    frames: set[str] = field(default_factory=set)
    log_times: list[int] = field(default_factory=list)
    """[ns]"""


def read_bag(path: Path, options: ReadOptions | None = None) -> BagContents:
    """Read a bag of the contract: a folder, an MCAP or sqlite3 file, or a ROS 1 bag; `options` names topics that are not of the contract.

    Header stamps are used as time, the log time where they are zero. Raises BagError for anything that is not such a bag or lacks
    required topics: pusher poses, and object poses or depth images.
    """
    options, notes = options or ReadOptions(), list[str]()
    with open_bag(Path(path)) as bag:
        by_role = _connections_by_role(bag, notes, options)
        wanted = {role: connections for role, connections in by_role.items() if role.role not in _DEPTH}
        camera_frame = _camera_frame(bag, by_role, notes)
        n_depth = sum(c.msgcount for role, connections in by_role.items() if role.role is Role.DEPTH for c in connections)
        recorded = _read(bag, wanted)
        object_ids = sorted({role.object_id for role in by_role if role.role in OBJECT_ROLES})
        return _contents(bag, recorded, object_ids, n_depth, notes, camera_frame, options)


def read_depth(path: Path, options: ReadOptions | None = None) -> DepthRecording:
    """The depth images of a bag that need not have poses or a pusher; `options` names topics that are not of the contract.

    Raises BagError for anything that is no bag, or one without depth images.
    """
    options, notes = options or ReadOptions(), list[str]()
    with open_bag(Path(path)) as bag:
        by_role = _connections_by_role(bag, notes, options)
        if not sum(topic.msgcount for topic in by_role.get(TopicRole(Role.DEPTH), [])):
            _fail_for_missing(bag, [Role.DEPTH], options)
        static = {role: topics for role, topics in by_role.items() if role.role is Role.TF_STATIC}
        camera_frame = _camera_frame(bag, by_role, notes)
        camera_in_table = _camera_in_table(_read(bag, static), camera_frame, notes) if static else None
        return DepthRecording(bag.path, camera_in_table, notes, options)


_Stamped = tuple[np.ndarray[Any, np.dtype[np.int64]], Float64Array]
_NOTHING: Final[_Stamped] = (np.empty(0, dtype=np.int64), np.empty((0, 0)))


def _contents(
    bag: OpenBag,
    recorded: dict[TopicRole, _Recorded],
    object_ids: list[str],
    n_depth: int,
    notes: list[str],
    camera_frame: str,
    options: ReadOptions,
) -> BagContents:
    path = bag.path
    stamped = {role: record for role, record in recorded.items() if role.role in _STAMPED}
    # Log times are those of another clock where anything is stamped.
    by_log_time = not any(any(record.stamps) for record in stamped.values())
    shape = _pusher_shape(path, recorded, notes)
    if TopicRole(Role.PUSHER) in stamped and (shape is None or shape.is_cylinder):
        # A cylinder has no heading, whatever is sent for it.
        stamped[TopicRole(Role.PUSHER)].values = [value[:2] for value in stamped[TopicRole(Role.PUSHER)].values]
    samples = {role: _clean(path, role, record, notes, by_log_time=by_log_time) for role, record in stamped.items()}
    missing = [] if len(samples.get(TopicRole(Role.PUSHER), _NOTHING)[0]) else [Role.PUSHER]
    if not n_depth and not any(role.role is Role.POSE and len(stamps) for role, (stamps, _) in samples.items()):
        missing.append(Role.POSE)
    if missing:
        _fail_for_missing(bag, missing, options)
    _check_frames(path, recorded, notes)
    camera_in_table = _camera_in_table(recorded, camera_frame, notes)
    other = next((frame for frame in recorded[TopicRole(Role.PUSHER)].frames if frame.strip("/") not in ("", TABLE_FRAME)), "")
    if camera_in_table is not None and n_depth and other:
        notes.append(f"the pusher is in {plain_text(other)!r}, the camera in {TABLE_FRAME!r}: they are taken for one frame.")
    origin = min(int(stamps[0]) for stamps, _ in samples.values() if len(stamps))
    wrench = samples.get(TopicRole(Role.WRENCH), _NOTHING)
    return BagContents(
        path=path,
        origin_ns=origin,
        objects={object_id: _object_track(object_id, recorded, samples, origin, notes) for object_id in object_ids},
        pusher=_samples(samples[TopicRole(Role.PUSHER)], origin),
        pusher_shape=shape,
        wrench=_samples(wrench, origin) if len(wrench[0]) else None,
        push_intervals=_push_intervals(recorded, origin, notes),
        camera_in_table=camera_in_table,
        camera_accuracy=_camera_accuracy(recorded, notes),
        n_depth=n_depth,
        topics=bag.counts(),
        notes=notes,
        options=options,
    )


def _fail_for_missing(bag: OpenBag, missing: list[Role], options: ReadOptions) -> NoReturn:
    names = " and ".join(f"`{role.value.name.replace('{id}', '<id>')}` ({role.msgtype})" for role in missing)
    raise ContentError(f"{bag.path}: no usable messages of {names}; the bag has {_present(bag)}. {map_hint(bag, missing, options)}")


def _present(bag: OpenBag) -> str:
    return ", ".join(f"{plain_text(topic)} ({count})" for topic, count in bag.counts().items() if count)[:500] or "no messages at all"


def _connections_by_role(bag: OpenBag, notes: list[str], options: ReadOptions) -> dict[TopicRole, list[Connection]]:
    """Topics with a role in this bag. Raises BagError for two topics of one role, which would mix two cells, and for topics that are mapped
    to a role and are not there or hold something else.
    """
    by_role: dict[TopicRole, list[Connection]] = defaultdict(list)
    recorded = {topic.strip("/") for topic in bag.counts()}
    if absent := [topic for topic in options.topics if topic not in recorded]:
        word = word_of(options.topics[absent[0]])
        raise ContentError(
            f"{bag.path}: no topic {plain_text(absent[0])}, which is mapped to {word}; the bag has {_present(bag)}. Map one of these."
        )
    options = options.with_camera_info(bag)
    for connection in bag.topics:
        if not (role := options.role_of(connection.topic)):
            continue
        if connection.msgtype not in message_types(role.role):
            expected = " or ".join(message_types(role.role))
            if connection.topic.strip("/") in options.topics:
                other = "; `push-ident import rosbag` takes other types" if role.role in _STAMPED else ""
                raise ContentError(
                    f"{bag.path}: {plain_text(connection.topic)} holds {plain_text(connection.msgtype)}, expected {expected} for "
                    f"{role.role.name.lower()}; map another topic{other}."
                )
            notes.append(f"topic {connection.topic} is of type {connection.msgtype}, expected {expected}; it is not used.")
            continue
        by_role[role].append(connection)
    has_depth = TopicRole(Role.DEPTH) in by_role
    # The camera info beside depth images that are chosen among several belongs to them, and without images none counts.
    for role, connections in sorted(by_role.items(), key=lambda item: item[0].role is Role.CAMERA_INFO):
        if role.role is Role.CAMERA_INFO and not has_depth:
            continue
        names = sorted({connection.topic for connection in connections})
        if len(names) > 1 and role.role is not Role.TF_STATIC:
            raise BagError(
                f"{bag.path}: topics {' and '.join(names)} all have the role of `{role}`; keep the topics of one cell, or choose one: "
                f"{MAPPING} --map {plain_text(names[0])}={word_of(role)}."
            )
    LIMITS.OBJECTS.check(len({role.object_id for role in by_role if role.role in OBJECT_ROLES}), str(bag.path), error=BagError)
    records = sum(topic.msgcount for topic in by_role.get(TopicRole(Role.PUSH_RECORD), []))
    LIMITS.PUSHES.check(records, str(bag.path), error=BagError, remedy="Split the bag.")
    return dict(by_role)


def _read(bag: OpenBag, wanted: dict[TopicRole, list[Connection]]) -> dict[TopicRole, _Recorded]:
    role_by_topic = {connection.topic: role for role, connections in wanted.items() for connection in connections}
    connections = [connection for group in wanted.values() for connection in group]
    bag.register(connections)
    recorded: dict[TopicRole, _Recorded] = defaultdict(_Recorded)
    for connection, log_time, message in bag.messages(connections):
        record = recorded[role_by_topic[connection.topic]]
        record.stamps.append(decode.stamp_ns(message.header.stamp) if hasattr(message, "header") else 0)
        record.log_times.append(log_time)
        role = role_by_topic[connection.topic].role
        if role in _STAMPED:
            record.values.append(_planar(role, message))
            record.frames.add(str(message.header.frame_id))
        else:
            if role in _LAST_COUNTS:
                record.messages.clear()
            record.messages.append(message)
    promised = sum(connection.msgcount for connection in connections) + sum(bag.lacking.get(topic, 0) for topic in role_by_topic)
    got = sum(len(record.stamps) for record in recorded.values())
    if got < promised:
        raise BagError(f"{bag.path}: its index lists {promised} messages of the contract, {got} could be read; the file is truncated.")
    return dict(recorded)


def _clean(path: Path, role: TopicRole, record: _Recorded, notes: list[str], *, by_log_time: bool) -> _Stamped:
    """Stamps and planar values of a topic in order of time, without values that are not finite and repeated stamps.

    Log times count where nothing of the bag is stamped (`by_log_time`), else messages without a stamp are left out. Stamps may run
    backwards by less than a second (late delivery); a larger jump means that a clock was reset.
    """
    stamps = np.array(record.stamps, dtype=np.int64)
    values = np.array(record.values)
    if by_log_time:
        stamps = np.array(record.log_times, dtype=np.int64)
        notes.append(f"`{role}`: none of {len(stamps)} messages has a stamp; their log time is used.")
    elif not np.all(stamps):
        notes.append(f"`{role}`: {np.count_nonzero(stamps == 0)} of {len(stamps)} messages have no stamp, where others have; dropped.")
        stamps, values = stamps[stamps != 0], values[stamps != 0]
    back = int(np.min(np.diff(stamps), initial=0))
    if back < -int(1e9 * LATE):
        raise BagError(f"{path}: the time of `{role}` jumps back by {-back * 1e-9:.3g} s; the clock was reset, cut the bag there.")
    most = LIMITS.FORCE if role.role is Role.WRENCH else LIMITS.COORDINATE
    usable = np.asarray(np.isfinite(values).all(axis=1) & (np.abs(values[:, :2]) <= most.value).all(axis=1))
    order = np.argsort(stamps, kind="stable")
    order = order[usable[order]]
    first = np.append(True, np.diff(stamps[order]) > 0) if len(order) else np.empty(0, dtype=np.bool_)
    for count, what in (
        (int(np.sum(np.diff(stamps) < 0)), "were out of order; sorted"),
        (int(np.sum(~usable)), f"hold values that are not finite or beyond {most.value} {most.unit}; dropped"),
        (int(np.sum(~first)), "repeat a stamp; dropped"),
    ):
        if count:
            notes.append(f"`{role}`: {count} of {len(stamps)} messages {what}.")
    return stamps[order[first]], values[order[first]]


def _planar(role: Role, message: Any) -> Float64Array:
    """x, y, yaw and the nine numbers of their covariance for a pose; x, y, yaw for the pusher; x, y for forces."""
    if role is Role.POSE:
        return np.append(decode.planar_pose_of(message.pose.pose), decode.covariance_of(message.pose.covariance).ravel())
    if role is Role.PUSHER:
        return decode.planar_pose_of(message.pose)
    return np.array([message.wrench.force.x, message.wrench.force.y], dtype=np.float64)


def _samples(stamped: _Stamped, origin: int) -> Samples:
    # Nanoseconds are subtracted as integers: floating-point seconds since 1970 have rounding errors of up to 0.2 us.
    return Samples((stamped[0] - origin).astype(np.float64) * 1e-9, stamped[1])


def _check_frames(path: Path, recorded: dict[TopicRole, _Recorded], notes: list[str]) -> None:
    """Poses, pusher and forces must be in one frame. One that is not named is taken for `table`, with a note."""
    frames = {frame or TABLE_FRAME: str(role) for role, record in recorded.items() for frame in record.frames}
    unnamed = [str(role) for role, record in recorded.items() if "" in record.frames]
    if unnamed:
        notes.append(
            f"{' and '.join(f'`{topic}`' for topic in unnamed)}: no frame_id; taken as in {TABLE_FRAME!r}. If they are in another frame, "
            "give `push-ident import rosbag` the bag with --pusher-frame X,Y,YAW (poses) or --wrench-axes (forces)."
        )
    if len(frames) > 1:
        listed = ", ".join(
            f"`{topic}` in {plain_text(frame)!r}{' (no frame_id)' if topic in unnamed and frame == TABLE_FRAME else ''}"
            for frame, topic in sorted(frames.items())
        )
        raise BagError(f"{path}: {listed}; expected all in {TABLE_FRAME!r}. `push-ident import rosbag` brings poses to one frame.")


def _object_track(
    object_id: str, recorded: dict[TopicRole, _Recorded], samples: dict[TopicRole, _Stamped], origin: int, notes: list[str]
) -> ObjectTrack:
    track = _samples(samples.get(TopicRole(Role.POSE, object_id), (_NOTHING[0], np.empty((0, 12)))), origin)
    covariance = track.value[:, 3:].reshape(-1, 3, 3)
    lack_position, lack_yaw = covariance[:, 0, 0] == 0, covariance[:, 2, 2] == 0
    for lack, what in (
        (lack_position & lack_yaw, "a covariance"),
        (lack_position & ~lack_yaw, "a covariance of x and y"),
        (lack_yaw & ~lack_position, "a variance of the yaw"),
    ):
        if lack.any():
            notes.append(f"object {object_id}: {int(lack.sum())} of {len(track)} poses lack {what}, which is zero or none.")
    shape, has_outline = _shape(object_id, recorded, notes)
    return ObjectTrack(shape, track.time, track.value[:, :3], covariance, has_outline)


def _messages(recorded: dict[TopicRole, _Recorded], role: Role, object_id: str = "") -> list[Any]:
    return recorded.get(TopicRole(role, object_id), _Recorded()).messages


def _shape(object_id: str, recorded: dict[TopicRole, _Recorded], notes: list[str]) -> tuple[ObjectShape | None, bool]:
    """Cells and outline from the last message of each, and whether there is an outline."""
    grids, polygons, deviations = (_messages(recorded, role, object_id) for role in (Role.CELLS, Role.OUTLINE, Role.OUTLINE_STD))
    if not grids:
        notes.append(f"object {object_id}: the bag has no cells.")
        return None, bool(polygons)
    try:
        cells, yaw = decode.cells_of(grids[-1])
        measured = outline = decode.outline_of(polygons[-1].polygon) if polygons else None
        if outline is None:
            lacking = "its outline encloses nothing" if polygons else "no outline"
            notes.append(f"object {object_id}: {lacking}; it is traced from the cells.")
            outline = outline_of_cells(cells.centres, cells.size, yaw=yaw)
            LIMITS.VERTICES.check(len(outline), "the traced outline", error=BagError)
        std = decode.outline_std_of(deviations[-1], len(outline)) if deviations and measured is not None else None
        return cut_at_outline(check_shape(ObjectShape(cells, outline, std))), measured is not None
    except (BagError, InputError) as error:
        notes.append(f"object {object_id}: its cells cannot be used: {error}")
        return None, bool(polygons)


def _pusher_shape(path: Path, recorded: dict[TopicRole, _Recorded], notes: list[str]) -> PusherShape | None:
    shapes = _messages(recorded, Role.PUSHER_SHAPE)
    try:
        shape = decode.pusher_shape_of(shapes[-1]) if shapes else None
    except InputError as error:
        raise BagError(f"{path}: `{Role.PUSHER_SHAPE.value.name}`: {error}") from None
    if shape is None:
        notes.append(f"{'`pusher/shape` is neither cylinder nor prism' if shapes else 'no `pusher/shape`'}: its radius is unknown.")
    return shape


def _push_intervals(recorded: dict[TopicRole, _Recorded], origin: int, notes: list[str]) -> tuple[PushInterval, ...]:
    intervals = []
    for message in _messages(recorded, Role.PUSH_RECORD):
        start, end = ((decode.stamp_ns(stamp) - origin) * 1e-9 for stamp in (message.start, message.end))
        if end > start:
            intervals.append(PushInterval(int(message.push_id), str(message.object_id), start, end, int(message.error_code)))
        else:
            notes.append(f"push record {message.push_id} (error code {message.error_code}) covers no time; ignored.")
    return tuple(sorted(intervals, key=lambda interval: interval.start))


def _camera_frame(bag: OpenBag, by_role: dict[TopicRole, list[Connection]], notes: list[str]) -> str:
    """Frame that the depth images name, where there are transforms to look for it; empty where they name none."""
    images = by_role.get(TopicRole(Role.DEPTH), [])
    if not images or TopicRole(Role.TF_STATIC) not in by_role:
        return ""
    bag.register(images)
    frame = next((str(image.header.frame_id).strip("/") for _, _, image in bag.messages(images)), None)
    if frame == "":
        notes.append(f"depth images: no frame_id; taken as in {CAMERA_FRAME!r}. If they are of another camera, record them with its frame.")
    return frame or ""


def _camera_in_table(recorded: dict[TopicRole, _Recorded], camera_frame: str, notes: list[str]) -> Float64Array | None:
    """Pose of the frame of the camera from the chain of static transforms to the table, if there is one."""
    parents = {}
    for message in _messages(recorded, Role.TF_STATIC):
        LIMITS.TRANSFORMS.check(len(message.transforms), "tf_static", error=ContentError)
        for stamped in message.transforms:
            parents[stamped.child_frame_id.strip("/")] = (stamped.header.frame_id.strip("/"), stamped.transform)
    frame, camera_in_frame = camera_frame or CAMERA_FRAME, np.eye(4)
    if frame not in parents:
        if parents and camera_frame:
            notes.append(
                f"static transforms have no frame {plain_text(camera_frame)!r}, which the depth images name; extrinsics are unknown."
            )
        return None
    while frame != TABLE_FRAME and frame in parents:
        frame, transform = parents.pop(frame)
        camera_in_frame = decode.homogeneous_of(transform) @ camera_in_frame
    if frame != TABLE_FRAME:
        start = plain_text(camera_frame or CAMERA_FRAME)
        notes.append(f"static transforms lead from {start} to {plain_text(frame)}, not to {TABLE_FRAME}; extrinsics are unknown.")
        return None
    return camera_in_frame


def _camera_accuracy(recorded: dict[TopicRole, _Recorded], notes: list[str]) -> CameraAccuracy | None:
    messages = _messages(recorded, Role.CAMERA_ACCURACY)
    accuracy = decode.camera_accuracy_of(messages[-1]) if messages else None
    if messages and accuracy is None:
        notes.append(f"`{Role.CAMERA_ACCURACY.value.name}` has no covariance of x, y and yaw; the camera counts as exact.")
    return accuracy


def _depth_frames(bag: OpenBag, origin: int, notes: list[str], options: ReadOptions) -> Iterator[DepthFrame]:
    """As `BagContents.depth_frames`, from an open bag."""
    by_role = _connections_by_role(bag, [], options)
    images, infos = (by_role.get(TopicRole(role), []) for role in (Role.DEPTH, Role.CAMERA_INFO))
    if not images or not infos:
        _fail_for_missing(bag, [Role.CAMERA_INFO if images else Role.DEPTH], options)
    bag.register([*images, *infos])
    intrinsics: CameraIntrinsics | None = next((intrinsics_of(info) for _, _, info in bag.messages(infos)), None)
    refused: list[FrameError] = []
    total, is_stamped = 0, None
    for connection, log_time, message in bag.messages([*images, *infos]):
        try:
            if connection.msgtype == Role.CAMERA_INFO.msgtype:
                intrinsics = intrinsics_of(message)
                continue
            total += 1
            if intrinsics is None:
                raise FrameError("no camera info was recorded.")
            stamp = decode.stamp_ns(message.header.stamp)
            is_stamped = bool(stamp) if is_stamped is None else is_stamped
            if is_stamped and not stamp:
                raise FrameError("it has no stamp, others have.")
            stamp = stamp if is_stamped else log_time
            yield decode.depth_frame_of(message, intrinsics, (stamp - origin) * 1e-9, options.depth_unit)
        except FrameError as error:
            refused.append(error)
    if refused and len(refused) >= total:
        raise FrameError(f"{bag.path}: none of {total} depth images is usable; the first: {refused[0]}")
    if refused:
        notes.append(f"depth: {len(refused)} of {total} images are not usable and skipped; the first: {refused[0]}")
