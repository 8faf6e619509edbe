"""Bags that are changed: their messages, stamps and topics, the records of MCAP, the tables of sqlite3, metadata.yaml, and any bytes."""

from __future__ import annotations

import random
import resource
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer

from helpers.fuzzing.messages import bytes_like, message_class, messages_like
from push_ident.bags.opening import open_bag
from push_ident.bags.raw import RawMessage
from push_ident.bags.salvage import salvage
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import PushIdentError
from push_ident.offline.loading import load_pushes

Messages = list[RawMessage]
MEMORY = 4 << 30
"""Address space of the process that reads [bytes]: far above what a sound bag takes, far below what one can claim."""
TOPICS = (
    "/objects/[x]/pose",
    "/objects/2/cells",
    "/b/pusher/pose",
    "/x",
    "/objects/<b>/outline",
    "pusher/pose",
    "/push_record",
    "/a\nb",
    "/objects/a\nb/pose",
)
NUMBERS = (0, 1, 2, 255, 65535, 2**16, 2**20, 2**28, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
"""Sizes, offsets and counts that claim too much or nothing."""
STATEMENTS = (
    "UPDATE messages SET data = NULL",
    "UPDATE messages SET data = zeroblob(60000000) WHERE id = 1",
    "UPDATE messages SET timestamp = 'soon' WHERE id = 3",
    "UPDATE messages SET timestamp = 9223372036854775807 WHERE id % 7 = 0",
    "UPDATE messages SET topic_id = 999",
    "DELETE FROM topics WHERE id = 1",
    "UPDATE topics SET name = '[/x]' WHERE id = 1",
    "UPDATE topics SET name = printf('%.100000c', 'x') WHERE id = 2",
    "UPDATE topics SET type = 'std_msgs/msg/String'",
    "UPDATE topics SET serialization_format = 'json'",
    "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS SELECT * FROM m",
    "ALTER TABLE messages RENAME TO m; CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
    "ALTER TABLE messages ADD COLUMN more GENERATED ALWAYS AS (zeroblob(100000000))",
    "UPDATE message_definitions SET encoded_message_definition = 'PoseStamped x'",
    "UPDATE message_definitions SET encoded_message_definition = printf('%.3000000c', '#')",
    "DROP TABLE topics",
    "DROP TABLE message_definitions",
    "PRAGMA writable_schema = ON; UPDATE sqlite_master SET rootpage = 2 WHERE name = 'messages'",
)
METADATA = (
    "[" * 100_000,
    "a: &a [x, x]\n" + "".join(f"b{k}: &b{k} [{', '.join(['*a'] * 9)}]\n" for k in range(9)),
    "!!python/object/apply:os.system ['true']",
    "\0\x01\x02",
    "#" * 3_000_000,
)
VALUES: tuple[Any, ...] = (None, 0, -1, 10**30, "", "../../etc/passwd", "/dev/zero", [], {}, ["x"] * 20_000, "x" * 100_000, True, "zstd")

# ---- messages


def shifted(messages: Messages, rng: random.Random) -> Messages:
    """Log times of one topic: displaced, stretched, all the same, or zero."""
    topic, start = rng.choice(messages).topic, messages[0].stamp_ns
    change: Callable[[int], int] = rng.choice(
        [lambda t: t + 10**15, lambda t: t - 60 * 10**9, lambda t: start + 1000 * (t - start), lambda t: start, lambda t: 0]
    )
    return [replace(m, stamp_ns=min(max(change(m.stamp_ns), 0), 2**63 - 1)) if m.topic == topic else m for m in messages]


def without_topic(messages: Messages, rng: random.Random) -> Messages:
    topic = rng.choice(messages).topic
    return [m for m in messages if m.topic != topic] or messages


def repeated(messages: Messages, rng: random.Random) -> Messages:
    topic = rng.choice(messages).topic
    return messages + [m for m in messages if m.topic == topic] * rng.choice([1, 10])


def reordered(messages: Messages, rng: random.Random) -> Messages:
    return rng.sample(messages, len(messages))


def renamed(messages: Messages, rng: random.Random) -> Messages:
    topic, name = rng.choice(messages).topic, rng.choice([*TOPICS, rng.choice(messages).topic])
    return [replace(m, topic=name) if m.topic == topic else m for m in messages]


def retyped(messages: Messages, rng: random.Random) -> Messages:
    topic, kind = rng.choice(messages).topic, rng.choice(["std_msgs/msg/String", rng.choice(messages).msgtype])
    return [replace(m, msgtype=kind) if m.topic == topic else m for m in messages]


def of_many_objects(messages: Messages, rng: random.Random) -> Messages:
    own = [m for m in messages if m.topic.startswith("/objects/")][:3]
    return messages + [replace(m, topic=m.topic.replace("/objects/", f"/objects/x{k}")) for k in range(rng.choice([3, 300])) for m in own]


@st.composite
def with_changed_content(draw: st.DrawFn, messages: Messages) -> Messages:
    """One message with changed fields or bytes, or all of its topic like it."""
    chosen = draw(st.sampled_from(messages))
    if draw(st.integers(0, 3)) == 0:
        data = draw(bytes_like(chosen.data))
    else:
        *namespaces, name = chosen.msgtype.split("/")
        try:
            message = deserialize_message(chosen.data, message_class(namespaces, name))
            data = serialize_message(draw(messages_like(message)))
        except RuntimeError:
            return messages  # changed before into what nobody can read, or now into what nobody can write
    everywhere = draw(st.booleans())
    return [replace(m, data=data) if m is chosen or (everywhere and m.topic == chosen.topic) else m for m in messages]


# ---- files


def with_other_bytes(data: bytes, rng: random.Random) -> bytes:
    """Flipped, cut off, cut out, repeated, erased, or a number that claims too much."""
    at, n, size = rng.randrange(len(data)), rng.choice([1, 4, 100, 5000]), rng.choice([2, 4, 8])
    before, part, after = data[:at], data[at : at + n], data[at + n :]
    number = (rng.choice(NUMBERS) % (1 << (8 * size))).to_bytes(size, "little")
    flipped = bytearray(data)
    for _ in range(min(n, 64)):
        flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    others = (
        before,
        before + after,
        before + 10 * part + data[at:],
        before + bytes(len(part)) + after,
        before + number + data[at + size :],
    )
    return rng.choice((bytes(flipped), *others))


def with_other_records(data: bytes, rng: random.Random) -> bytes:
    """Of MCAP: one left out, repeated, of another kind, or with a size or offset that claims too much; half of the time without index."""
    records, at = [], 8
    while at + 9 <= len(data) - 8:
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        records.append(data[at:end])
        at = end
    k, how = rng.randrange(len(records)), rng.randrange(4)
    one = records[k]
    number, place = rng.choice(NUMBERS).to_bytes(8, "little"), 9 + rng.randrange(56)
    records[k : k + 1] = ([], [one] * 10, [bytes([rng.randrange(256)]) + one[1:]], [one[:place] + number + one[place + 8 :]])[how]
    if rng.random() < 0.5:
        records = [record for record in records if record[0] < 0x07] + [b"\x0f" + (4).to_bytes(8, "little") + bytes(4)]
        records.append(b"\x02" + (20).to_bytes(8, "little") + bytes(20))
    return data[:8] + b"".join(records) + data[:8]


def damage_storage(file: Path, how: str, rng: random.Random) -> None:
    """Change the file that holds the messages; what does not apply to its format changes nothing."""
    if how == "bytes":
        file.write_bytes(with_other_bytes(file.read_bytes(), rng))
    elif how == "records" and file.suffix == ".mcap":
        file.write_bytes(with_other_records(file.read_bytes(), rng))
    elif how == "tables" and file.suffix == ".db3":
        with closing(sqlite3.connect(file)) as database, suppress(sqlite3.Error):
            database.executescript(rng.choice(STATEMENTS))
            database.commit()


def damage_metadata(file: Path, rng: random.Random) -> None:
    if rng.random() < 0.3:
        file.write_text(rng.choice(METADATA))
        return
    content = yaml.safe_load(file.read_text())
    inner = content["rosbag2_bagfile_information"]
    owner, key = rng.choice([(inner, key) for key in inner] + [(inner["relative_file_paths"], 0), (content, "rosbag2_bagfile_information")])
    owner[key] = rng.choice(VALUES)
    file.write_text(yaml.safe_dump(content, sort_keys=False))


# ---- bags

OF_MESSAGES = (shifted, without_topic, repeated, reordered, renamed, retyped, of_many_objects)
OF_STORAGE = ("bytes", "records", "tables")


@st.composite
def bags(draw: st.DrawFn, messages: Messages) -> Callable[[Path], None]:
    """What writes a changed bag of these messages into a new folder."""
    rng = draw(st.randoms(use_true_random=False))
    for change in draw(st.lists(st.sampled_from([None, None, *OF_MESSAGES]), max_size=2)):
        messages = draw(with_changed_content(messages)) if change is None else change(messages, rng)
    is_mcap, other_metadata = draw(st.booleans()), draw(st.booleans())
    other_storage = draw(st.sampled_from([None, *OF_STORAGE]))

    def write(folder: Path) -> None:
        (write_mcap if is_mcap else write_sqlite)(folder, messages)
        if other_storage is not None:
            (file,) = folder.glob("*.mcap" if is_mcap else "*.db3")
            damage_storage(file, other_storage, rng)
        if other_metadata:
            damage_metadata(folder / "metadata.yaml", rng)

    return write


def write_mcap(folder: Path, messages: Messages) -> None:
    with BagWriter(folder, chunk_size=8192) as writer:
        for m in messages:
            writer.write_raw(m.topic, m.msgtype, m.stamp_ns, m.data)


def write_sqlite(folder: Path, messages: Messages) -> None:
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        links: dict[tuple[str, str], Any] = {}
        for m in messages:
            key = (m.topic, m.msgtype)
            if key not in links:
                links[key] = writer.add_connection(*key, typestore=jazzy_typestore())
            writer.write(links[key], m.stamp_ns, m.data)


# ---- reading


def limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def read_both_ways(bag: Path, out: Path) -> list[str]:
    """What was refused, in words: loading its pushes, and its salvage. Anything else that is raised is a failure."""
    refused = []
    try:
        for record in load_pushes([bag]).records:
            values = (record.poses.pose, record.poses.covariance, record.pusher.position, record.shape.cells.centres)
            assert all(np.isfinite(value).all() for value in values)
            assert (np.diff(record.poses.time) > 0).all() and (np.diff(record.pusher.time) > 0).all()
            assert all(np.linalg.eigvalsh(covariance)[0] > 0 for covariance in record.poses.covariance)
    except (PushIdentError, MemoryError) as error:
        refused.append(str(error))
    try:
        salvage(bag, out)
        with open_bag(out) as opened:  # what was salvaged can be read
            assert sum(1 for _ in opened.raw_messages())
    except (PushIdentError, MemoryError) as error:
        refused.append(str(error))
    return refused
