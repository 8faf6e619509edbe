"""Bags that tests write, push by push or message by message."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from push_ident.bags.contract import Role
from push_ident.bags.opening import open_bag
from push_ident.bags.reader import read_bag
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.se2 import quaternion_of_yaw
from push_ident.types import ObjectShape, PoseTrack, PusherPath, PushRecord, WrenchTrack

COVARIANCE = np.array([[2e-6, 3e-7, 1e-7], [3e-7, 1e-6, 2e-7], [1e-7, 2e-7, 8e-5]])
L_OUTLINE = np.array([[0.0, 0.0], [0.06, 0.0], [0.06, 0.02], [0.02, 0.02], [0.02, 0.05], [0.0, 0.05]])
L_SHAPE = ObjectShape(cells_in_outline(L_OUTLINE, 0.01), L_OUTLINE)


def make_record(start: float, *, object_id: str = "7", n_poses: int = 6, wrench: bool = True) -> PushRecord:
    """A push of 1 s; the numbers follow no physics, they only have to come back."""
    time = start + np.linspace(0.0, 1.0, 31)
    pose_time = start + np.linspace(0.0, 1.0, n_poses)
    pose = np.column_stack([0.1 + 0.02 * (pose_time - start), 0.3 - 0.01 * (pose_time - start), 3.1 + 0.2 * (pose_time - start)])
    force = WrenchTrack(time, np.column_stack([np.sin(time), np.cos(time)])) if wrench else None
    return PushRecord(
        object_id,
        L_SHAPE,
        PoseTrack(pose_time, pose, np.tile(COVARIANCE, (n_poses, 1, 1))),
        PusherPath(time, np.column_stack([0.05 * (time - start), np.full_like(time, 0.31)]), 0.0085),
        force,
    )


def write_push(writer: BagWriter, start: float, *, n: int = 31, poses: bool = True, pusher: bool = True) -> None:
    for time in start + np.linspace(0.0, 1.0, n):
        if poses:
            writer.write_pose("7", time, (0.1, 0.2, time), COVARIANCE)
        if pusher:
            writer.write_pusher(time, (time, 0.0))


def new(msgtype: str, *fields: Any) -> Any:
    return jazzy_typestore().types[msgtype](*fields)


def header_msg(stamp: float, frame: str) -> Any:
    return new("std_msgs/msg/Header", time_msg(round(1e9 * stamp)), frame)


def time_msg(stamp_ns: int) -> Any:
    return new("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))


def pose_msg(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Any:
    turn = new("geometry_msgs/msg/Quaternion", *(float(value) for value in quaternion_of_yaw(yaw)))
    return new("geometry_msgs/msg/Pose", new("geometry_msgs/msg/Point", x, y, z), turn)


def copy_renamed(bag: Path, copy: Path, names: dict[str, str]) -> Path:
    """The same messages under other topics where `names` has them."""
    with BagWriter(copy) as writer, open_bag(bag) as recorded:
        for topic, stamp, data in recorded.raw_messages():
            writer.write_raw(names.get(topic.topic, topic.topic), topic.msgtype, stamp, bytes(data))
    return copy


def write_raw(writer: BagWriter, msgtype: str, topic: str, stamp_ns: int, *fields: Any) -> None:
    writer.write_raw(topic, msgtype, stamp_ns, jazzy_typestore().serialize_cdr(new(msgtype, *fields), msgtype))


def write_pusher_logged(writer: BagWriter, stamp_ns: int, log_ns: int, topic: str = "/pusher/pose") -> None:
    """A pusher pose whose log time is not its stamp."""
    write_raw(writer, Role.PUSHER.msgtype, topic, log_ns, new("std_msgs/msg/Header", time_msg(stamp_ns), "table"), pose_msg())


def write_cells(writer: BagWriter, size: float, origin: Any, values: np.ndarray) -> None:
    """The cells of object 7 as occupancy of rows and columns."""
    header = header_msg(1.0, "object_7")
    info = new("nav_msgs/msg/MapMetaData", header.stamp, size, *values.shape[::-1], origin)
    write_raw(writer, Role.CELLS.msgtype, "/objects/7/cells", 10**9, header, info, values.astype(np.int8).ravel())


def bag_error(path: Path) -> str:
    with pytest.raises(BagError) as caught:
        read_bag(path)
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    return text


def assert_same_record(got: PushRecord, expected: PushRecord) -> None:
    shift = got.pusher.time[0] - expected.pusher.time[0]
    assert (got.object_id, got.pusher.radius) == (expected.object_id, expected.pusher.radius)
    np.testing.assert_allclose(got.shape.cells.centres, expected.shape.cells.centres, atol=1e-9)
    assert got.shape.cells.size == pytest.approx(expected.shape.cells.size, rel=1e-9)
    np.testing.assert_allclose(got.shape.outline, expected.shape.outline, atol=1e-8)  # float32 on the wire
    for name in ("time", "pose", "covariance"):
        offset = shift if name == "time" else 0.0
        np.testing.assert_allclose(getattr(got.poses, name) - offset, getattr(expected.poses, name), atol=2e-9)
    np.testing.assert_allclose(got.pusher.time - shift, expected.pusher.time, atol=2e-9)
    np.testing.assert_array_equal(got.pusher.position, expected.pusher.position)
    assert (got.wrench is None) == (expected.wrench is None)
    if got.wrench is not None and expected.wrench is not None:
        np.testing.assert_array_equal(got.wrench.force, expected.wrench.force)


def copy_with_covariances(bag: Path, copy: Path, change: Callable[[Any], None]) -> Path:
    """The same messages; `change` sets the 36 numbers of the covariance of each pose."""
    store = jazzy_typestore()
    with BagWriter(copy) as writer, open_bag(bag) as recorded:
        for topic, stamp, raw in recorded.raw_messages():
            data = bytes(raw)
            if topic.msgtype == Role.POSE.msgtype:
                message = store.deserialize_cdr(data, topic.msgtype)
                message.pose.covariance = message.pose.covariance.copy()  # type: ignore[attr-defined]
                change(message.pose.covariance)  # type: ignore[attr-defined]
                data = bytes(store.serialize_cdr(message, topic.msgtype))
            writer.write_raw(topic.topic, topic.msgtype, stamp, data)
    return copy
