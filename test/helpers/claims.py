"""Bags that claim what they do not have, or have far more than they seem to."""

from __future__ import annotations

import bz2
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml
from backports import zstd
from rosbags.rosbag2 import StoragePlugin, Writer

from helpers.bags import COVARIANCE, L_SHAPE, write_push
from push_ident.bags.contract import Role
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter

ZEROS = 40_000_000
MAGIC = b"\x89MCAP0\r\n"


def sound(path: Path) -> Path:
    """A small sound bag: one object, one push."""
    with BagWriter(path) as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        writer.write_pusher_shape(1.0, 0.01)
        write_push(writer, 2.0)
    return path


def sqlite_bag(path: Path) -> Path:
    """A small sound sqlite3 bag."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        link = writer.add_connection("/pusher/pose", Role.PUSHER.msgtype, typestore=jazzy_typestore())
        for k in range(200):
            writer.write(link, k, bytes(80))
    return path


def record(code: int, content: bytes) -> bytes:
    return bytes([code]) + struct.pack("<Q", len(content)) + content


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def chunk(data: bytes, compression: bytes, size: int, *, end: int = 2**62) -> bytes:
    return record(6, struct.pack("<QQQI", 0, end, size, 0) + text(compression) + struct.pack("<Q", len(data)) + data)


def mcap(path: Path, *records: bytes) -> Path:
    """An MCAP file of these records, without an index."""
    path.write_bytes(
        MAGIC + record(1, text(b"ros2") + text(b"test")) + b"".join(records) + record(15, bytes(4)) + record(2, bytes(20)) + MAGIC
    )
    return path


def bomb(path: Path, *, claimed: int | None = None, times: int = 1) -> Path:
    """Chunks of zeros: 5 kB for 40 MB."""
    content = record(12, bytes(ZEROS))
    return mcap(path / "bomb.mcap", chunk(zstd.compress(content), b"zstd", len(content) if claimed is None else claimed) * times)


def with_index(path: Path, *, listed: int = 1, offset: int | None = None) -> Path:
    """A chunk of 100 000 empty messages that the index lists several times, or at another place."""
    messages = record(5, struct.pack("<HIQQ", 1, 0, 5, 5)) * 100_000
    begin = MAGIC + record(1, text(b"ros2") + text(b""))
    one = chunk(zstd.compress(messages), b"zstd", len(messages))
    at = len(begin) if offset is None else offset
    entry = (
        struct.pack("<QQQQ", 0, 2**62, at, len(one))
        + struct.pack("<I", 0)
        + bytes(8)
        + text(b"zstd")
        + struct.pack("<QQ", 0, len(messages))
    )
    body = begin + one
    pose = Role.PUSHER.msgtype.encode()
    summary = record(3, struct.pack("<H", 1) + text(pose) + text(b"ros2msg") + text(b"uint8 x"))
    summary += record(4, struct.pack("<HH", 1, 1) + text(b"/pusher/pose") + text(b"cdr") + struct.pack("<I", 0))
    summary += record(8, entry) * listed
    (path / "indexed.mcap").write_bytes(body + summary + record(2, struct.pack("<QQI", len(body), 0, 0)) + MAGIC)
    return path / "indexed.mcap"


def with_schema(path: Path, definition: bytes) -> Path:
    """One pusher pose of another definition."""
    messages = record(3, struct.pack("<H", 1) + text(Role.PUSHER.msgtype.encode()) + text(b"ros2msg") + text(definition))
    messages += record(4, struct.pack("<HH", 1, 1) + text(b"/pusher/pose") + text(b"cdr") + struct.pack("<I", 0))
    return mcap(path / "schema.mcap", messages, record(5, struct.pack("<HIQQ", 1, 0, 5, 5) + b"\x00\x01\x00\x00" + b"\xff" * 60))


def with_grid(path: Path, side: int) -> Path:
    """An object with a full grid of `side` x `side` cells."""
    sound(path / "small")
    store = jazzy_typestore()
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 0), "object_7")
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    )
    info = types["nav_msgs/msg/MapMetaData"](header.stamp, 0.001, side, side, pose)
    grid = types["nav_msgs/msg/OccupancyGrid"](header, info, np.full(side * side, 100, np.int8))
    with BagWriter(path / "grid") as writer:
        writer.write_raw("/objects/7/cells", Role.CELLS.msgtype, 10**9, store.serialize_cdr(grid, Role.CELLS.msgtype))
        write_push(writer, 2.0)
    return path / "grid"


def with_objects(path: Path, n: int) -> Path:
    with BagWriter(path / "objects") as writer:
        write_push(writer, 2.0)
        for k in range(n):
            writer.write_pose(f"x{k}", 2.0, (0.0, 0.0, 0.0), COVARIANCE)
    return path / "objects"


def with_metadata(path: Path, change: Callable[[dict], None] | str) -> Path:  # type: ignore[type-arg]
    """A sound bag with another metadata.yaml."""
    file = sound(path / "bag") / "metadata.yaml"
    if isinstance(change, str):
        file.write_text(change)
    else:
        content = yaml.safe_load(file.read_text())
        change(content["rosbag2_bagfile_information"])
        file.write_text(yaml.safe_dump(content))
    return path / "bag"


def with_statements(path: Path, statements: str) -> Path:
    """A sqlite3 bag that was changed."""
    file = sqlite_bag(path / "bag") / "bag.db3"
    database = sqlite3.connect(file)
    database.executescript(statements)
    database.close()
    return file


def rosbag1_bomb(path: Path) -> Path:
    """Forty chunks of 50 MB of zeros in a ROS 1 bag."""

    def fields(**values: bytes) -> bytes:
        joined = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in values.items())
        return struct.pack("<I", len(joined)) + joined

    data = bz2.compress(bytes(ZEROS))
    one = fields(op=b"\x05", compression=b"bz2", size=struct.pack("<I", ZEROS)) + struct.pack("<I", len(data)) + data

    def head(index: int) -> bytes:
        counts = {"conn_count": bytes(4), "chunk_count": struct.pack("<I", 40)}
        return b"#ROSBAG V2.0\n" + fields(op=b"\x03", index_pos=struct.pack("<Q", index), **counts) + bytes(4)

    begin = len(head(0))
    places = (struct.pack("<Q", begin + number * len(one)) for number in range(40))
    times = {"ver": struct.pack("<I", 1), "start_time": bytes(8), "end_time": bytes(8), "count": bytes(4)}
    index = b"".join(fields(op=b"\x06", chunk_pos=place, **times) + bytes(4) for place in places)
    (path / "bomb.bag").write_bytes(head(begin + 40 * len(one)) + one * 40 + index)
    return path / "bomb.bag"
