"""Mutations of the files of a bag: records of MCAP, tables of sqlite3, metadata.yaml, bytes."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import lz4.frame  # type: ignore[import-untyped]
import yaml
from backports import zstd
from numpy.random import Generator

__all__ = ["BYTES", "MCAP", "METADATA", "SQLITE"]

_NUMBERS: Final = (0, 1, 2, 255, 65535, 2**16, 2**20, 2**28, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
_BOMB: Final = 60_000_000
"""Zeros in a bomb [bytes]."""
_DAMAGING: Final = (
    OSError,
    sqlite3.Error,
    yaml.YAMLError,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    struct.error,
    OverflowError,
    RecursionError,
)

Mutator = Callable[[Path, Generator], None]


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file())


def _on_data(change: Callable[[bytearray, Generator], None], *suffixes: str) -> Mutator:
    """A change of the bytes of one file of the bag."""

    def mutate(folder: Path, rng: Generator) -> None:
        files = [path for path in _files(folder) if not suffixes or path.suffix in suffixes]
        if not files:
            return
        # The storage file far more often than metadata.yaml.
        path = max(files, key=lambda file: file.stat().st_size) if rng.random() < 0.9 else files[int(rng.integers(len(files)))]
        data = bytearray(path.read_bytes())
        if data:
            change(data, rng)
            path.write_bytes(data)

    return mutate


# ---- bytes


def _flip(data: bytearray, rng: Generator) -> None:
    for _ in range(int(rng.choice([1, 1, 4, 64, 1000]))):
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))


def _truncate(data: bytearray, rng: Generator) -> None:
    del data[int(rng.integers(len(data))) :]


def _block(data: bytearray, rng: Generator) -> slice:
    start = int(rng.integers(len(data)))
    return slice(start, start + int(rng.choice([1, 4, 100, 5000])))


def _repeat(data: bytearray, rng: Generator) -> None:
    part = _block(data, rng)
    data[part.start : part.start] = data[part] * int(rng.choice([1, 10, 100]))


def _cut_out(data: bytearray, rng: Generator) -> None:
    del data[_block(data, rng)]


def _swap(data: bytearray, rng: Generator) -> None:
    a, b = _block(data, rng), _block(data, rng)
    size = min(len(data[a]), len(data[b]))
    first, second = bytes(data[a.start : a.start + size]), bytes(data[b.start : b.start + size])
    data[a.start : a.start + size] = second
    data[b.start : b.start + size] = first


def _erase(data: bytearray, rng: Generator) -> None:
    part = _block(data, rng)
    data[part] = bytes([int(rng.choice([0, 255]))]) * len(data[part])


def _number(data: bytearray, rng: Generator) -> None:
    size = int(rng.choice([1, 2, 4, 8]))
    at = int(rng.integers(max(1, len(data) - size)))
    value = int(_NUMBERS[int(rng.integers(len(_NUMBERS)))]) % (1 << (8 * size))
    data[at : at + size] = value.to_bytes(size, "little" if rng.random() < 0.8 else "big")


def _word(data: bytearray, rng: Generator) -> None:
    """A word of a text replaced."""
    words = data.split(b" ")
    words[int(rng.integers(len(words)))] = bytearray(rng.choice([b"nan", b"inf", b"-1", b"1e300", b"0", b"2147483648", b"x", b"99999999"]))
    data[:] = b" ".join(words)


BYTES: Final[dict[str, Mutator]] = {
    "flip": _on_data(_flip),
    "truncate": _on_data(_truncate),
    "repeat": _on_data(_repeat),
    "cut out": _on_data(_cut_out),
    "swap": _on_data(_swap),
    "erase": _on_data(_erase),
    "number": _on_data(_number),
    "word": _on_data(_word, ".txt"),
}

# ---- records of MCAP

_MAGIC: Final = 8
_CHUNK: Final = 6


def _records(data: bytes | bytearray) -> list[list[Any]]:
    """Operation code and content of all records, as far as they can be read."""
    found, at = [], _MAGIC
    while at + 9 <= len(data) - _MAGIC:
        size = int.from_bytes(data[at + 1 : at + 9], "little")
        if at + 9 + size > len(data):
            break
        found.append([data[at], bytearray(data[at + 9 : at + 9 + size])])
        at += 9 + size
    return found


def _join(records: list[list[Any]]) -> bytes:
    return b"".join(bytes([code]) + len(content).to_bytes(8, "little") + bytes(content) for code, content in records)


def _on_records(change: Callable[[list[list[Any]], Generator], None]) -> Mutator:
    """A change of the records; half of the time the index is removed, so that readers take the records as they are."""

    def mutate(data: bytearray, rng: Generator) -> None:
        records = _records(data)
        if not records:
            return
        change(records, rng)
        if rng.random() < 0.5:
            last = next((k for k, (code, _) in enumerate(records) if code == 0x0F), len(records) - 1)
            records = [*records[: last + 1], [2, bytearray(20)]]
        data[_MAGIC:] = _join(records) + data[:_MAGIC]

    return _on_data(mutate, ".mcap")


def _drop_record(records: list[list[Any]], rng: Generator) -> None:
    del records[int(rng.integers(len(records)))]


def _repeat_record(records: list[list[Any]], rng: Generator) -> None:
    k, times = int(rng.integers(len(records))), int(rng.choice([1, 10, 1000]))
    if times * len(records[k][1]) < 50_000_000:
        records[k:k] = [records[k]] * times


def _swap_records(records: list[list[Any]], rng: Generator) -> None:
    a, b = (int(rng.integers(len(records))) for _ in range(2))
    records[a], records[b] = records[b], records[a]


def _recode(records: list[list[Any]], rng: Generator) -> None:
    records[int(rng.integers(len(records)))][0] = int(rng.integers(256))


def _spoil_record(records: list[list[Any]], rng: Generator) -> None:
    """A number at the begin of a record, where sizes and offsets are."""
    content = records[int(rng.integers(len(records)))][1]
    if len(content) >= 8:
        size = int(rng.choice([2, 4, 8]))
        at = int(rng.integers(min(len(content), 64) - size + 1))
        content[at : at + size] = (_NUMBERS[int(rng.integers(len(_NUMBERS)))] % (1 << (8 * size))).to_bytes(size, "little")


def _chunk(start: int, end: int, size: int, compression: bytes, data: bytes) -> bytearray:
    return bytearray(
        struct.pack("<QQQI", start, end, size, 0) + struct.pack("<I", len(compression)) + compression + struct.pack("<Q", len(data)) + data
    )


def _bomb(records: list[list[Any]], rng: Generator) -> None:
    """Chunks of zeros, with a true or a false size."""
    kind = str(rng.choice(["zstd", "lz4"]))
    zeros = bytes(_BOMB)
    data = zstd.compress(zeros) if kind == "zstd" else lz4.frame.compress(zeros)
    claimed = int(rng.choice([_BOMB, 10, 2**32, 2**63]))
    where = next((k for k, (code, _) in enumerate(records) if code == _CHUNK), 1)
    records[where:where] = [[_CHUNK, _chunk(0, 2**62, claimed, kind.encode(), data)]] * int(rng.choice([1, 5, 50]))


def _messages_without_end(records: list[list[Any]], rng: Generator) -> None:
    """A chunk of many empty messages."""
    n = int(rng.choice([1000, 1_000_000]))
    message = b"\x05" + struct.pack("<QHIQQ", 22, int(rng.choice([1, 2, 65535])), 0, int(rng.choice([0, 2**63])), 0)
    data = zstd.compress(message * n)
    where = next((k for k, (code, _) in enumerate(records) if code == _CHUNK), 1)
    records.insert(where, [_CHUNK, _chunk(0, 2**62, 31 * n, b"zstd", data)])


def _schema(records: list[list[Any]], rng: Generator) -> None:
    """The text of a message type replaced."""
    name = b"geometry_msgs/msg/PoseStamped"
    texts = (
        b"PoseStamped x",
        b"float64[2147483647] x",
        b"E[] x\n" + b"=" * 80 + b"\nMSG: geometry_msgs/E\n",
        b"#" * 3_000_000,
        b"",
        b"uint8 a\n" * 30_000,
    )
    text = texts[int(rng.integers(len(texts)))]
    for code, content in records:
        if code == 3:
            at = 2
            fields = []
            for _ in range(3):
                size = int.from_bytes(content[at : at + 4], "little")
                fields.append(bytes(content[at + 4 : at + 4 + size]))
                at += 4 + size
            if fields[0] == name:
                fields[2] = text
                content[2:] = b"".join(len(f).to_bytes(4, "little") + f for f in fields)


MCAP: Final[dict[str, Mutator]] = {
    "drop record": _on_records(_drop_record),
    "repeat record": _on_records(_repeat_record),
    "swap records": _on_records(_swap_records),
    "recode record": _on_records(_recode),
    "spoil record": _on_records(_spoil_record),
    "spoil another record": _on_records(_spoil_record),
    "bomb": _on_records(_bomb),
    "many messages": _on_records(_messages_without_end),
    "schema": _on_records(_schema),
}

# ---- tables of sqlite3

_STATEMENTS: Final = (
    "UPDATE messages SET data = zeroblob(60000000) WHERE id = 1",
    "UPDATE messages SET data = NULL",
    "UPDATE messages SET data = 'text'",
    "UPDATE messages SET timestamp = 'soon' WHERE id = 3",
    "UPDATE messages SET timestamp = -timestamp",
    "UPDATE messages SET timestamp = 9223372036854775807 WHERE id % 7 = 0",
    "UPDATE messages SET topic_id = 999",
    "UPDATE messages SET topic_id = 1 + id % 3",
    "DELETE FROM messages",
    "DELETE FROM messages WHERE id % 2 = 0",
    "DELETE FROM topics WHERE id = 1",
    "UPDATE topics SET name = '[/x]' WHERE id = 1",
    "UPDATE topics SET name = printf('%.100000c', 'x') WHERE id = 2",
    "UPDATE topics SET type = 'std_msgs/msg/String'",
    "UPDATE topics SET serialization_format = 'json'",
    "UPDATE topics SET id = id + 1000",
    "INSERT INTO topics SELECT id + 100000, name, type, serialization_format, offered_qos_profiles, type_description_hash FROM topics",
    "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS SELECT * FROM m",
    "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS WITH RECURSIVE c(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM c) "
    "SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(1000) AS data FROM c",
    "ALTER TABLE messages RENAME TO m; CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
    "ALTER TABLE messages ADD COLUMN more GENERATED ALWAYS AS (zeroblob(100000000))",
    "DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data AS (zeroblob(500000000))); "
    "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1), (2, 2)",
    "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM messages; END",
    "UPDATE message_definitions SET encoded_message_definition = 'PoseStamped x'",
    "UPDATE message_definitions SET encoded_message_definition = printf('%.3000000c', '#')",
    "UPDATE message_definitions SET encoding = 'x'",
    "DROP TABLE topics",
    "DROP TABLE message_definitions",
    "PRAGMA writable_schema = ON; UPDATE sqlite_master SET rootpage = 2 WHERE name = 'messages'",
    "PRAGMA journal_mode = WAL; UPDATE messages SET timestamp = timestamp + 1",
)


def _statement(folder: Path, rng: Generator) -> None:
    for path in folder.glob("*.db3"):
        try:
            database = sqlite3.connect(path)
            database.executescript(_STATEMENTS[int(rng.integers(len(_STATEMENTS)))])
            database.commit()
            database.close()
        except sqlite3.Error:
            # An earlier mutation took away what this one needs.
            continue


def _pages(data: bytearray, rng: Generator) -> None:
    """Pages swapped, repeated, or linked to one another."""
    size = 4096
    n = len(data) // size
    if n < 3:
        return
    a, b = (int(rng.integers(1, n)) for _ in range(2))
    kind = int(rng.integers(4))
    if kind == 0:
        data[a * size : (a + 1) * size] = data[b * size : (b + 1) * size]
    elif kind == 1:
        for page in range(1, n):
            if data[page * size] == 5:
                for at in range(page * size + 12, page * size + 12 + 400, 2):
                    data[at : at + 2] = data[page * size + 12 : page * size + 14]
                data[page * size + 3 : page * size + 5] = (200).to_bytes(2, "big")
    elif kind == 2:
        # An inner page becomes its own child.
        for page in range(1, n):
            if data[page * size] in (2, 5):
                data[page * size + 8 : page * size + 12] = (page + 1).to_bytes(4, "big")
    else:
        data[28:32] = int(rng.choice([0, 1, n * 1000, 2**31])).to_bytes(4, "big")


SQLITE: Final[dict[str, Mutator]] = {
    "statement": _statement,
    "another statement": _statement,
    "pages": _on_data(_pages, ".db3"),
    "flip": _on_data(_flip, ".db3"),
    "number": _on_data(_number, ".db3"),
}

# ---- metadata.yaml

_VALUES: Final[tuple[Any, ...]] = (
    None,
    0,
    -1,
    10**30,
    "",
    "../../etc/passwd",
    "/etc/passwd",
    [],
    {},
    ["x"] * 20_000,
    "x" * 100_000,
    True,
    float("nan"),
    "zstd",
    "FILE",
)
_TEXTS: Final = (
    "[" * 100_000,
    "- " * 100_000,
    "a: &a [x, x]\n" + "".join(f"b{k}: &b{k} [{', '.join(['*a'] * 9)}]\n" for k in range(9)),
    "a: &a {x: 1}\nb: &b {<<: [*a, *a, *a]}\nc: {<<: [*b, *b, *b]}\n",
    "x: " * 1000,
    "#" * 3_000_000,
    "!!python/object/apply:os.system ['true']",
    "\0\x01\x02",
)


def _on_metadata(change: Callable[[Path, Generator], None]) -> Mutator:
    def mutate(folder: Path, rng: Generator) -> None:
        path = folder / "metadata.yaml"
        if path.exists():
            try:
                change(path, rng)
            except _DAMAGING:
                return

    return mutate


def _value(path: Path, rng: Generator) -> None:
    content = yaml.safe_load(path.read_text())
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        keys = list(node) if isinstance(node, dict) else list(range(len(node))) if isinstance(node, list) else []
        for key in keys:
            places.append((node, key))
            walk(node[key])

    walk(content)
    container, key = places[int(rng.integers(len(places)))]
    container[key] = _VALUES[int(rng.integers(len(_VALUES)))]
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def _text(path: Path, rng: Generator) -> None:
    text = _TEXTS[int(rng.integers(len(_TEXTS)))]
    path.write_text(text if rng.random() < 0.5 else path.read_text() + text)


def _paths(path: Path, rng: Generator) -> None:
    content = yaml.safe_load(path.read_text())
    names = content["rosbag2_bagfile_information"]["relative_file_paths"]
    extra = ("../x.mcap", "/dev/zero", "/etc/passwd", names[0], "a/" + names[0], "..", "", "x" * 5000, "metadata.yaml", "\0")
    names[:] = [extra[int(rng.integers(len(extra)))], *(names if rng.random() < 0.5 else [])] * int(rng.choice([1, 1, 1000]))
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def _compressed(path: Path, rng: Generator) -> None:
    """The storage file compressed, as it should be, cut, or replaced by a bomb."""
    content = yaml.safe_load(path.read_text())
    information = content["rosbag2_bagfile_information"]
    mode = str(rng.choice(["file", "message"]))
    information["compression_format"], information["compression_mode"] = "zstd", mode
    if mode == "file":
        storage = path.parent / information["relative_file_paths"][0]
        kind = int(rng.integers(3))
        data = zstd.compress(storage.read_bytes() if kind < 2 else bytes(_BOMB)) * (1 if kind < 2 else 50)
        (path.parent / f"{storage.name}.zstd").write_bytes(data[: len(data) // 2] if kind == 1 else data)
        information["relative_file_paths"] = [f"{storage.name}.zstd"]
    path.write_text(yaml.safe_dump(content, sort_keys=False))


METADATA: Final[dict[str, Mutator]] = {
    "value": _on_metadata(_value),
    "text": _on_metadata(_text),
    "paths": _on_metadata(_paths),
    "compressed": _on_metadata(_compressed),
}
