"""Small sound bags that are mutated: one of each format, all from the example bag of the repository."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from push_ident.bags.opening import open_bag
from push_ident.bags.records import write_records
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.offline.loading import load_pushes

__all__ = ["SOURCES", "Message", "make_sources", "read_messages", "write_mcap", "write_sqlite"]

_PUSHES: Final = 2
_DEPTH_SECONDS: Final = 11.0
"""From the begin of the example bag: its first push, and the object at rest around it [s]."""


@dataclass(slots=True)
class Message:
    """One message of a bag, serialised."""

    topic: str
    msgtype: str
    stamp_ns: int
    data: bytes


def read_messages(path: Path) -> list[Message]:
    """All messages of a bag."""
    with open_bag(path) as bag:
        return [Message(topic.topic, topic.msgtype, stamp, bytes(data)) for topic, stamp, data in bag.raw_messages()]


def write_mcap(path: Path, messages: list[Message]) -> None:
    """Write messages as an MCAP bag."""
    with BagWriter(path, chunk_size=8192) as writer:
        for message in messages:
            writer.write_raw(message.topic, message.msgtype, message.stamp_ns, message.data)


def write_sqlite(path: Path, messages: list[Message]) -> None:
    """Write messages as a sqlite3 bag."""
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections: dict[tuple[str, str], Any] = {}
        for message in messages:
            key = (message.topic, message.msgtype)
            if key not in connections:
                connections[key] = writer.add_connection(*key, typestore=jazzy_typestore())
            writer.write(connections[key], message.stamp_ns, message.data)


def _write_rosbag1(path: Path, messages: list[Message]) -> None:
    """Write messages of the contract as a ROS 1 bag; `push_record` has no ROS 1 type with a header and is left out."""
    store, jazzy = get_typestore(Stores.ROS1_NOETIC), jazzy_typestore()
    path.mkdir()
    writer = Rosbag1Writer(path / f"{path.name}.bag")
    writer.set_compression(Rosbag1Writer.CompressionFormat.BZ2)
    with writer:
        connections: dict[str, Any] = {}
        for message in messages:
            if message.msgtype not in store.fielddefs:
                continue
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(message.topic, message.msgtype, typestore=store)
            decoded: Any = jazzy.deserialize_cdr(message.data, message.msgtype)
            writer.write(connections[message.topic], message.stamp_ns, store.serialize_ros1(_as_ros1(decoded, store), message.msgtype))


def _as_ros1(message: Any, store: Any) -> Any:
    """The same message with the fields of ROS 1: its headers are numbered, its solids have no polygon."""
    if type(message).__name__.endswith("SolidPrimitive"):
        return store.types["shape_msgs/msg/SolidPrimitive"](message.type, message.dimensions)
    if hasattr(message, "header"):
        message.header = store.types["std_msgs/msg/Header"](0, message.header.stamp, message.header.frame_id)
    return message


def _write_poses(path: Path, example: Path) -> None:
    write_records(path, load_pushes([example]).records[:_PUSHES])


def _write_depth(path: Path, example: Path) -> None:
    messages = read_messages(example)
    last = min(message.stamp_ns for message in messages) + int(_DEPTH_SECONDS * 1e9)
    write_mcap(path, [message for message in messages if message.stamp_ns <= last])


def _write_icra16(path: Path, example: Path) -> None:
    """The text format of the importer, with the numbers of the example's first push."""
    del example
    rng = np.random.default_rng(0)
    path.mkdir()
    lines = ["2"]
    for push in range(2):
        lines += [" ".join(f"{v:.6g}" for v in (100.0, 50.0 + x, 0.0, 1.0, 0.0, 0.0, 0.1 * push)) for x in (0.0, 20.0)]
        time = 100.0 * push + np.arange(80) / 40
        force = np.column_stack([time, 3.0 * (time % 100 > 1) + 0.01 * rng.normal(size=80), 0.01 * rng.normal(size=80)])
        x = np.full(80, 150.0)
        robot = np.column_stack([time, x, 20 + 20 * (time % 100), 10 + 0 * x, 1 + 0 * x, 0 * x, 0 * x, 0 * x])
        for block in (force, robot):
            lines += [str(len(block)), *(" ".join(f"{v:.6g}" for v in row) for row in block)]
    (path / f"{path.name}.txt").write_text("\n".join(lines) + "\n")


_MOCAP_TYPES: Final = {
    "mocap/msg/markers": "geometry_msgs/Pose[] body_poses",
    "robot_comm/msg/log": "float64 x\nfloat64 y\nfloat64 z",
}


def _write_mocap(path: Path, example: Path) -> None:
    """The ROS 1 format of the importer, with a made-up push."""
    del example
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in _MOCAP_TYPES.items():
        store.register(get_types_from_msg(text, name))
    types: Any = store.types
    path.mkdir()
    with Rosbag1Writer(path / f"{path.name}.bag") as writer:
        names = {
            "/Mocap": "mocap/msg/markers",
            "/robot_CartesianLog": "robot_comm/msg/log",
            "/netft_data": "geometry_msgs/msg/WrenchStamped",
        }
        links = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in names.items()}
        zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        for k in range(300):
            stamp, moved = 10**12 + k * 10**7, max(0.0, min(k - 100, 100)) * 0.2
            point = types["geometry_msgs/msg/Point"](300.0 + moved, 100.0, 30.0)
            pose = types["geometry_msgs/msg/Pose"](point, types["geometry_msgs/msg/Quaternion"](0.5, 0.5, 0.5, 0.5))
            header = types["std_msgs/msg/Header"](k, types["builtin_interfaces/msg/Time"](0, 0), "")
            force = types["geometry_msgs/msg/Vector3"](1.0 if 100 < k < 200 else 0.0, 0.0, 0.0)
            wrench = types["geometry_msgs/msg/WrenchStamped"](header, types["geometry_msgs/msg/Wrench"](force, zero))
            for topic, message in (
                ("/Mocap", types["mocap/msg/markers"]([pose])),
                ("/robot_CartesianLog", types["robot_comm/msg/log"](290.0 + moved, 100.0, 30.0)),
                ("/netft_data", wrench),
            ):
                writer.write(links[topic], stamp, store.serialize_ros1(message, names[topic]))


SOURCES: Final[dict[str, Callable[[Path, Path], None]]] = {
    "mcap": _write_poses,
    "sqlite3": lambda path, example: write_sqlite(path, read_messages(path.parent / "mcap")),
    "depth": _write_depth,
    "rosbag1": lambda path, example: _write_rosbag1(path, read_messages(path.parent / "mcap")),
    "mocap": _write_mocap,
    "icra16": _write_icra16,
}
"""Name of a source -> how it is written into a new folder of that name, from the example bag."""


def make_sources(folder: Path, example: Path) -> dict[str, Path]:
    """Write every source below `folder`; their folders by name."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, write in SOURCES.items():
        if not (folder / name).exists():
            write(folder / name, example)
    return {name: folder / name for name in SOURCES}
