"""Whatever a bag claims, it is refused in one line, with bounded time and memory."""

from __future__ import annotations

import json
import os
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from backports import zstd
from rosbags import rosbag1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from helpers.bags import COVARIANCE, L_SHAPE, bag_error, pose_msg, write_cells, write_push
from push_ident.bags.contract import Role
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError
from push_ident.limits import LIMITS
from push_ident.types import ObjectShape

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


def pusher_channel(definition: bytes) -> bytes:
    schema = record(3, struct.pack("<H", 1) + text(Role.PUSHER.msgtype.encode()) + text(b"ros2msg") + text(definition))
    return schema + record(4, struct.pack("<HH", 1, 1) + text(b"/pusher/pose") + text(b"cdr") + struct.pack("<I", 0))


def with_index(path: Path, *, listed: int = 1, offset: int | None = None) -> Path:
    """A chunk of 100 000 empty messages that the index lists several times, or at another place."""
    messages = record(5, struct.pack("<HIQQ", 1, 0, 5, 5)) * 100_000
    begin = MAGIC + record(1, text(b"ros2") + text(b""))
    one = chunk(zstd.compress(messages), b"zstd", len(messages))
    at = len(begin) if offset is None else offset
    entry = struct.pack("<QQQQI", 0, 2**62, at, len(one), 0) + bytes(8) + text(b"zstd") + struct.pack("<QQ", 0, len(messages))
    body = begin + one
    summary = pusher_channel(b"uint8 x") + record(8, entry) * listed
    (path / "indexed.mcap").write_bytes(body + summary + record(2, struct.pack("<QQI", len(body), 0, 0)) + MAGIC)
    return path / "indexed.mcap"


def with_schema(path: Path, definition: bytes) -> Path:
    """One pusher pose of another definition."""
    return mcap(
        path / "schema.mcap", pusher_channel(definition), record(5, struct.pack("<HIQQ", 1, 0, 5, 5) + b"\x00\x01\x00\x00" + b"\xff" * 60)
    )


def with_more(path: Path, write: Callable[[BagWriter], object]) -> Path:
    """One push, and more."""
    with BagWriter(path / "more") as writer:
        write_push(writer, 2.0)
        write(writer)
    return path / "more"


def many_cells(writer: BagWriter) -> None:
    write_cells(writer, 0.001, pose_msg(), np.full((1000, 1000), 100))


def many_objects(writer: BagWriter) -> None:
    for k in range(60):
        writer.write_pose(f"x{k}", 2.0, (0.0, 0.0, 0.0), COVARIANCE)


def many_pushes(writer: BagWriter) -> None:
    for k in range(LIMITS.PUSHES.value + 1):
        writer.write_push_record(k, "7", 2.0, 3.0)


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
    """Four chunks of 40 MB of zeros in a ROS 1 bag."""
    writer = rosbag1.Writer(path / "bomb.bag")
    writer.set_compression(writer.CompressionFormat.BZ2)
    with writer:
        link = writer.add_connection("/x", "std_msgs/msg/String", typestore=get_typestore(Stores.ROS1_NOETIC))
        for stamp in range(4):
            writer.write(link, stamp, bytes(ZEROS))
    return path / "bomb.bag"


RECURSIVE_VIEW = """
ALTER TABLE messages RENAME TO m;
CREATE VIEW messages AS WITH RECURSIVE c(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM c)
SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(1000) AS data FROM c;
"""
COMPUTED = """
DROP TABLE messages;
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data AS (zeroblob(900000000)));
INSERT INTO messages(topic_id, timestamp) VALUES (1, 1), (1, 2);
"""
NOTHING_INSIDE = b"geometry_msgs/E[] x\n" + b"=" * 80 + b"\nMSG: geometry_msgs/E\nuint8[0] nothing\n"


def twice(information: dict[str, Any]) -> None:
    information["relative_file_paths"] *= 2


def elsewhere(information: dict[str, Any]) -> None:
    information["relative_file_paths"] = ["../../etc/passwd"]


CLAIMS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "bomb": (lambda path: bomb(path, times=4), "content uncompressed"),
    "bomb that claims little": (lambda path: bomb(path, claimed=1000), "expected 1000"),
    "bomb that claims much": (lambda path: bomb(path, claimed=2**63), "expected at most 67,108,864 bytes"),
    "chunk listed often": (lambda path: with_index(path, listed=1000), "overlaps others"),
    "chunk listed elsewhere": (lambda path: with_index(path, offset=20), "damaged"),
    "chunk listed beyond the end": (lambda path: with_index(path, offset=2**63), "where there is none"),
    "type that contains itself": (lambda path: with_schema(path, b"PoseStamped x"), "contains itself"),
    "array of 2^31 numbers": (lambda path: with_schema(path, b"float64[2147483647] x"), "array of 2147483647"),
    "array without content": (lambda path: with_schema(path, NOTHING_INSIDE), "array of"),
    "long definition": (lambda path: with_schema(path, b"#" * 5_000_000), "message definition"),
    "grid of a million cells": (lambda path: with_more(path, many_cells), "number of cells of one object"),
    "more objects than a cell has": (lambda path: with_more(path, many_objects), "number of objects"),
    "more pushes than a bag can have": (lambda path: with_more(path, many_pushes), "number of pushes"),
    "nested metadata": (lambda path: with_metadata(path, "[" * 1_000_000), "nested deeper"),
    "metadata that laugh": (lambda path: with_metadata(path, "a: &a [1]\nb: [*a, *a]\n"), "aliases"),
    "long metadata": (lambda path: with_metadata(path, "#" * 30_000_000), "larger than"),
    "file above the folder": (lambda path: with_metadata(path, elsewhere), "not in the folder"),
    "file listed twice": (lambda path: with_metadata(path, twice), "twice"),
    "view without end": (lambda path: with_statements(path, RECURSIVE_VIEW), "expected a plain table"),
    "computed column": (lambda path: with_statements(path, COMPUTED), "expected a plain table"),
    "bomb of ROS 1": (rosbag1_bomb, "content uncompressed"),
}

READ = """
import json, re, sys, time
from dataclasses import replace
from pathlib import Path
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.errors import PushIdentError
from push_ident.limits import LIMITS
LIMITS.UNCOMPRESSED = replace(LIMITS.UNCOMPRESSED, value=100_000_000)  # a gigabyte takes seconds
found = {}
for name, path in json.load(sys.stdin).items():
    began = time.process_time()
    try:
        split_pushes(read_bag(Path(path)), "7")
        text = ""
    except PushIdentError as error:
        text = str(error) + "".join(getattr(error, "__notes__", ()))
    # Not from getrusage, which counts the process that started this one as well.
    peak = int(re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1])
    found[name] = (text, time.process_time() - began, peak)
print(json.dumps(found))
"""


def test_what_a_bag_claims_costs_neither_time_nor_memory(tmp_path: Path) -> None:
    paths = {}
    for number, (name, (make, _)) in enumerate(CLAIMS.items()):
        (tmp_path / str(number)).mkdir()
        paths[name] = str(make(tmp_path / str(number)))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run(
        [sys.executable, "-c", READ], input=json.dumps(paths), capture_output=True, text=True, timeout=300, env=environment, check=True
    )
    for name, (text, seconds, memory) in json.loads(done.stdout).items():
        assert CLAIMS[name][1] in text, f"{name}: {text}"
        assert "\n" not in text
        assert seconds < 5.0, f"{name} took {seconds:.1f} s"
        assert memory < 600_000, f"{name} took {memory / 1e6:.2f} GB"


def test_messages_in_the_journal_of_a_killed_recorder_are_not_lost_silently_and_pipes_not_waited_for(tmp_path: Path) -> None:
    bag = sqlite_bag(tmp_path / "bag")
    (bag / "bag.db3-wal").write_bytes(bytes(100))
    assert "wal_checkpoint" in bag_error(bag)
    os.mkfifo(tmp_path / "pipe.mcap")
    assert "not a regular file" in bag_error(tmp_path / "pipe.mcap")


def test_a_file_in_zstd_is_read_and_a_bomb_of_one_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LIMITS, "UNCOMPRESSED", replace(LIMITS.UNCOMPRESSED, value=10_000_000))  # a gigabyte takes seconds

    def compressed(information: dict[str, Any]) -> None:
        information["compression_format"], information["compression_mode"] = "zstd", "file"
        information["relative_file_paths"] = ["bag.mcap.zstd"]

    bag = with_metadata(tmp_path, compressed)
    raw = zstd.compress((bag / "bag.mcap").read_bytes())
    (bag / "bag.mcap.zstd").write_bytes(raw)
    assert len(read_bag(bag).pusher) == 31
    (bag / "bag.mcap.zstd").write_bytes(zstd.compress(bytes(11_000_000)))
    assert "content uncompressed" in bag_error(bag)


def test_an_outline_that_is_not_that_of_the_cells_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", ObjectShape(L_SHAPE.cells, 10.0 * L_SHAPE.outline), 1.0)
        write_push(writer, 2.0)
    contents = read_bag(tmp_path / "bag")
    assert contents.objects["7"].shape is None
    assert any("outline" in note and "cell" in note for note in contents.notes)


def test_poses_and_forces_beyond_any_cell_and_a_pose_of_the_next_century_are_dropped(tmp_path: Path) -> None:
    """The simulation of a push steps to its last pose."""
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        write_push(writer, 2.0)
        writer.write_pusher(4.0, (1e30, 0.0))
        writer.write_pose("7", 4.0, (0.0, 0.0, 0.0), np.eye(3) * 1e30)
        writer.write_pose("7", 2e9, (0.0, 0.0, 0.0), COVARIANCE)
    contents = read_bag(tmp_path / "bag")
    assert (len(contents.pusher), len(contents.objects["7"].time)) == (31, 32)
    (record,) = split_pushes(contents, "7")
    assert record.poses.time[-1] < 10.0


def test_a_pusher_that_is_recorded_for_hours_makes_no_push_of_hours(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        for k in range(3000):
            writer.write_pose("7", 2.0 + 0.4 * k, (0.0, 0.0, 0.0), COVARIANCE)
            writer.write_pusher(2.0 + 0.4 * k, (0.0, 0.0))
    with pytest.raises(BagError, match="duration of a push"):
        split_pushes(read_bag(tmp_path / "bag"), "7")
