"""Whatever a bag claims, it is refused in one line, with bounded time and memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import claims
from helpers.bags import COVARIANCE, L_SHAPE, bag_error, make_record, write_push
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.bags.records import write_records
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError
from push_ident.limits import LIMITS
from push_ident.types import Float64Array, ObjectShape

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
    "bomb": (lambda path: claims.bomb(path, times=60), "content uncompressed"),
    "bomb that claims little": (lambda path: claims.bomb(path, claimed=1000), "expected 1000"),
    "bomb that claims much": (lambda path: claims.bomb(path, claimed=2**63), "expected at most 67,108,864 bytes"),
    "chunk listed often": (lambda path: claims.with_index(path, listed=1000), "overlaps others"),
    "chunk listed elsewhere": (lambda path: claims.with_index(path, offset=20), "damaged"),
    "chunk listed beyond the end": (lambda path: claims.with_index(path, offset=2**63), "where there is none"),
    "type that contains itself": (lambda path: claims.with_schema(path, b"PoseStamped x"), "contains itself"),
    "array of 2^31 numbers": (lambda path: claims.with_schema(path, b"float64[2147483647] x"), "array of 2147483647"),
    "array without content": (lambda path: claims.with_schema(path, NOTHING_INSIDE), "array of"),
    "long definition": (lambda path: claims.with_schema(path, b"#" * 5_000_000), "message definition"),
    "grid of a million cells": (lambda path: claims.with_grid(path, 1000), "number of cells of one object"),
    "more objects than a cell has": (lambda path: claims.with_objects(path, 60), "number of objects"),
    "nested metadata": (lambda path: claims.with_metadata(path, "[" * 1_000_000), "nested deeper"),
    "metadata that laugh": (lambda path: claims.with_metadata(path, "a: &a [1]\nb: [*a, *a]\n"), "aliases"),
    "long metadata": (lambda path: claims.with_metadata(path, "#" * 30_000_000), "larger than"),
    "file above the folder": (lambda path: claims.with_metadata(path, elsewhere), "not in the folder"),
    "file listed twice": (lambda path: claims.with_metadata(path, twice), "twice"),
    "view without end": (lambda path: claims.with_statements(path, RECURSIVE_VIEW), "expected a plain table"),
    "computed column": (lambda path: claims.with_statements(path, COMPUTED), "expected a plain table"),
    "bomb of ROS 1": (claims.rosbag1_bomb, "content uncompressed"),
}

READ = """
import json, re, sys, time
from pathlib import Path
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.errors import PushIdentError
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


def test_messages_in_the_journal_of_a_killed_recorder_are_not_lost_silently(tmp_path: Path) -> None:
    bag = claims.sqlite_bag(tmp_path / "bag")
    (bag / "bag.db3-wal").write_bytes(bytes(100))
    assert "wal_checkpoint" in bag_error(bag)


def test_tables_that_are_linked_in_a_circle_end(tmp_path: Path) -> None:
    """Every entry of an inner page leads to the same leaf."""
    file = claims.sqlite_bag(tmp_path / "bag") / "bag.db3"
    data = bytearray(file.read_bytes())
    inner = next(page for page in range(4096, len(data), 4096) if data[page] == 5)
    data[inner + 3 : inner + 5] = (1900).to_bytes(2, "big")
    for at in range(inner + 14, inner + 12 + 3800, 2):
        data[at : at + 2] = data[inner + 12 : inner + 14]
    file.write_bytes(data)
    assert "cannot be read" in bag_error(file)


def test_pipes_are_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    assert "not a regular file" in bag_error(tmp_path / "pipe.mcap")


def test_a_file_in_zstd_is_read_and_a_bomb_of_one_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LIMITS, "UNCOMPRESSED", replace(LIMITS.UNCOMPRESSED, value=10_000_000))  # a gigabyte takes seconds

    def compressed(information: dict[str, Any]) -> None:
        information["compression_format"], information["compression_mode"] = "zstd", "file"
        information["relative_file_paths"] = ["bag.mcap.zstd"]

    bag = claims.with_metadata(tmp_path, compressed)
    raw = claims.zstd.compress((bag / "bag.mcap").read_bytes())
    (bag / "bag.mcap.zstd").write_bytes(raw)
    assert len(read_bag(bag).pusher) == 31
    (bag / "bag.mcap.zstd").write_bytes(claims.zstd.compress(bytes(11_000_000)))
    assert "content uncompressed" in bag_error(bag)


@pytest.mark.parametrize(
    ("outline", "reason"),
    [(10.0 * L_SHAPE.outline, "cell"), (0.1 * L_SHAPE.outline, "cell"), (L_SHAPE.outline[[0, 2, 1, 3, 4, 5]], "crosses itself")],
    ids=["larger", "smaller", "crossed"],
)
def test_an_outline_that_is_not_that_of_the_cells_is_refused(tmp_path: Path, outline: Float64Array, reason: str) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", ObjectShape(L_SHAPE.cells, outline), 1.0)
        write_push(writer, 2.0)
    contents = read_bag(tmp_path / "bag")
    assert contents.objects["7"].shape is None
    assert any("outline" in note and reason in note for note in contents.notes)


def test_a_pose_of_the_next_century_is_not_waited_for(tmp_path: Path) -> None:
    """The simulation of a push steps to its last pose."""
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        write_push(writer, 2.0)
        writer.write_pose("7", 2e9, (0.0, 0.0, 0.0), COVARIANCE)
    (record,) = split_pushes(read_bag(tmp_path / "bag"), "7")
    assert record.poses.time[-1] < 10.0


def test_a_pusher_that_is_recorded_for_hours_makes_no_push_of_hours(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        for k in range(3000):
            writer.write_pose("7", 2.0 + 0.4 * k, (0.0, 0.0, 0.0), COVARIANCE)
            writer.write_pusher(2.0 + 0.4 * k, (0.0, 0.0))
    with pytest.raises(BagError, match="duration of a push"):
        split_pushes(read_bag(tmp_path / "bag"), "7")


def test_more_pushes_than_a_bag_can_have_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        write_push(writer, 2.0)
        for k in range(LIMITS.PUSHES.value + 1):
            writer.write_push_record(k, "7", 2.0, 3.0)
    assert "number of pushes" in bag_error(tmp_path / "bag")


def test_poses_and_forces_beyond_any_cell_are_dropped(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0)
        writer.write_pusher(4.0, (1e30, 0.0))
        writer.write_pose("7", 4.0, (0.0, 0.0, 0.0), np.eye(3) * 1e30)
    contents = read_bag(tmp_path / "bag")
    assert (len(contents.pusher), len(contents.objects["7"].time)) == (31, 31)


def test_many_pushes_with_many_samples_are_cut_in_linear_time(tmp_path: Path) -> None:
    """Each push took a copy of all samples: 500 pushes of 40 samples copied ten million numbers."""
    write_records(tmp_path / "bag", [make_record(5.0 * k) for k in range(200)])
    contents = read_bag(tmp_path / "bag")
    began = time.process_time()
    assert len(split_pushes(contents, "7")) == 200
    assert time.process_time() - began < 1.2
