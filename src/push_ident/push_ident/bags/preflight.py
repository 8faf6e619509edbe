"""Claims of a storage file, compared with its size before rosbags reads it.

rosbags takes sizes, offsets and numbers from a file at their word: what an index lists a thousand times is read a thousand times. A chunk
that holds more than it claims ends at the memory limit of the command line (`cli/memory.py`).
"""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import BinaryIO, Final
from urllib.parse import quote

from mcap.records import ChunkIndex
from rosbags.rosbag1.reader import Header, RecordType, read_uint32

from push_ident.bags.compression import check_expansion
from push_ident.bags.mcap_records import MAGIC, Opcode, chunk_index_of, chunk_of, record_heads
from push_ident.errors import BagError
from push_ident.limits import LIMITS

_TAIL: Final = struct.Struct("<BQQQI8s")
"""Footer and magic at the end of an MCAP file."""
_ROSBAG1: Final = b"#ROSBAG V2.0\n"
_TABLES: Final = ("schema", "metadata", "topics", "messages", "message_definitions")
"""Of sqlite3 bags."""

_Chunk = tuple[int, int, int]
"""Where a chunk starts and ends in the file, and its uncompressed size [bytes]."""


def check_claims(path: Path) -> None:
    """Raise BagError for a storage file (.mcap, .db3, .bag) that is cut, is no such file, or claims what it cannot have."""
    if not path.is_file():
        raise BagError(f"{path}: not a regular file; give a bag folder or the storage file of a bag.")
    size = path.stat().st_size
    if path.suffix == ".db3":
        _check_sqlite(path, size)
        return
    with path.open("rb") as file:
        chunks = _mcap_chunks(file, size) if path.suffix == ".mcap" else _rosbag1_chunks(file)
    before = total = 0
    for start, end, uncompressed in sorted(chunks):
        # One that is listed often would be read often.
        if not before <= start <= end <= size:
            raise BagError(f"the index lists a chunk of {end - start} bytes at byte {start}, which overlaps others; the file is damaged.")
        before = end
        LIMITS.CHUNK.check(uncompressed, "a chunk", error=BagError)
        total += uncompressed
    check_expansion(total, size, "its chunks")


def _mcap_chunks(file: BinaryIO, size: int) -> list[_Chunk]:
    """Of the index, or of the whole file where it has none."""
    if (magic := file.read(len(MAGIC))) != MAGIC:
        raise BagError("the file does not begin as an MCAP file." if magic else "the file is empty.")
    end = max(size - _TAIL.size, len(MAGIC))
    file.seek(end)
    operation, length, summary, _, _, magic = _TAIL.unpack(file.read().ljust(_TAIL.size))
    if (operation, length, magic) != (Opcode.FOOTER, 20, MAGIC):
        raise BagError("the file has no end; its recorder was killed, or it was cut.")
    summary = summary or end
    if not len(MAGIC) <= summary <= end:
        raise BagError(f"the index lies at byte {summary} of {size}; the file is damaged.")
    LIMITS.SUMMARY.check(end - summary, "the index", error=BagError)
    listed = [chunk_index_of(file, start, stop) for kind, start, stop in record_heads(file, summary, end) if kind == Opcode.CHUNK_INDEX]
    if listed:
        return [_listed_chunk(file, entry, summary) for entry in listed]
    chunks = ((start, stop) for kind, start, stop in record_heads(file, len(MAGIC), summary) if kind == Opcode.CHUNK)
    return [(start, stop, _claimed_by_chunk(file, start, stop)) for start, stop in chunks]


def _listed_chunk(file: BinaryIO, entry: ChunkIndex, end: int) -> _Chunk:
    start, stop = entry.chunk_start_offset, entry.chunk_start_offset + entry.chunk_length
    if len(MAGIC) <= start < stop <= end:
        for kind, first, last in record_heads(file, start, stop):
            if kind == Opcode.CHUNK and last == stop and _claimed_by_chunk(file, first, last) == entry.uncompressed_size:
                return start, stop, entry.uncompressed_size
            break
    raise BagError(f"the index lists a chunk of {stop - start} bytes at byte {start}, where there is none; the file is damaged.")


def _claimed_by_chunk(file: BinaryIO, start: int, end: int) -> int:
    """Uncompressed size [bytes], from the first 128 bytes of a chunk: its header and that of zstd have 62."""
    return int(chunk_of(file, start, min(end, start + 128)).uncompressed_size)


def _rosbag1_chunks(file: BinaryIO) -> list[_Chunk]:
    """Of the index; a file without one is refused by rosbags."""
    if (magic := file.read(len(_ROSBAG1))) != _ROSBAG1:
        raise BagError("the file does not begin as a ROS 1 bag of version 2.0." if magic else "the file is empty.")
    header = Header.read(file, RecordType.BAGHEADER)
    if not (index := header.get_uint64("index_pos")):
        return []
    file.seek(index)
    positions = []
    for kind, number in (
        (RecordType.CONNECTION, header.get_uint32("conn_count")),
        (RecordType.CHUNK_INFO, header.get_uint32("chunk_count")),
    ):
        for _ in range(number):
            entry = Header.read(file, kind)
            file.seek(read_uint32(file), 1)
            if kind is RecordType.CHUNK_INFO:
                positions.append(entry.get_uint64("chunk_pos"))
    chunks = []
    for start in positions:
        file.seek(start)
        uncompressed = Header.read(file, RecordType.CHUNK).get_uint32("size")
        length = read_uint32(file)
        chunks.append((start, file.tell() + length, uncompressed))
    return chunks


def _check_sqlite(path: Path, size: int) -> None:
    """Only plain tables are read: a view, a virtual table or a computed column could be a program without end."""
    for suffix in ("-wal", "-journal"):
        beside = path.with_name(path.name + suffix)
        if beside.is_file() and beside.stat().st_size:
            raise BagError(
                f"messages are still in {beside.name}, as the recorder was killed; move them into the bag with "
                f'`sqlite3 {path.name} "PRAGMA wal_checkpoint(TRUNCATE)"`.'
            )
    with closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)) as database:
        for table in _TABLES:
            kinds = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchmany(2)
            computed = database.execute("SELECT 1 FROM pragma_table_xinfo(?) WHERE hidden", (table,)).fetchone()
            if computed or any(kind != "table" or "VIRTUAL" in str(text).upper() for kind, text in kinds):
                raise BagError(f"`{table}` computes its rows or columns, expected a plain table; not a bag of rosbag2.")
        # Steps of sqlite's machine between two looks at their number; a row has at least 12 bytes and takes some 10 steps.
        steps = 100_000
        looks = iter(range(1 + 4 * size // steps))
        # A true result interrupts the statement. In a damaged file, pages can be their own children, and a table or its index has no end.
        database.set_progress_handler(lambda: next(looks, None) is None, steps)
        (largest,) = database.execute("SELECT max(length(data)) FROM messages NOT INDEXED").fetchone()
        LIMITS.MESSAGE.check(largest or 0, "a message", error=BagError)
        database.execute("SELECT count(timestamp) FROM messages").fetchone()
