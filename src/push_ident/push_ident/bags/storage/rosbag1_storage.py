"""A ROS 1 bag (format 2.0, http://wiki.ros.org/Bags/Format/2.0) as a storage.

Its index is not used: it may list a chunk or a message any number of times. The records are walked once from the begin of the file.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final

from push_ident.bags.storage.chunks import Chunk, decompressed, in_order, messages_of_chunk
from push_ident.bags.storage.storage import Expansion, RawMessage, RecordedTopic, check_name, open_regular
from push_ident.errors import BagError
from push_ident.limits import LIMITS

__all__ = ["Rosbag1Storage"]

_MAGIC: Final = b"#ROSBAG V2.0\n"
_MESSAGE, _HEADER, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_U32: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")
_HEADER_LIMIT: Final = 1 << 20
"""Longest header of a record [bytes]; that of a connection holds its message definition."""


class Rosbag1Storage:
    """A ROS 1 bag that is open for reading. Raises BagError for a file that is cut, damaged, or claims what it cannot have."""

    def __init__(self, path: Path) -> None:
        self._file = open_regular(path)
        self._connections: dict[int, RecordedTopic] = {}
        self._chunks: dict[int, tuple[int, str, int, int]] = {}
        """By offset of its record: uncompressed size, compression, offset and size of the data."""
        self._starts: dict[int, int] = {}
        """Earliest log time by offset of the chunk [ns]."""
        self._counts: Counter[int] = Counter()
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._open()
        except BaseException:
            self._file.close()
            raise
        self.topics: list[RecordedTopic] = [
            RecordedTopic(c.id, c.topic, c.msgtype, self._counts[c.id], c.definition, c.encoding) for c in self._connections.values()
        ]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, wanted: Collection[int]) -> Iterator[RawMessage]:
        """Messages of these topics, in order of log time."""
        wanted = frozenset(wanted)
        self._records = Expansion("its chunks", self._size)
        chunks = [Chunk(self._starts.get(offset, 0), chunk[0], offset) for offset, chunk in self._chunks.items()]
        return in_order(chunks, lambda chunk: self._messages_of(chunk.offset, wanted))

    def _open(self) -> None:
        if (magic := self._file.read(len(_MAGIC))) != _MAGIC:
            raise BagError("the file is empty." if not magic else "the file does not begin as a ROS 1 bag of version 2.0.")
        expansion = Expansion("its chunks", self._size)
        at, is_first = len(_MAGIC), True
        while at < self._size:
            offset = at
            header, start, end = self._record(at)
            at = end
            operation = header.get(b"op", b"")
            if is_first and (operation != bytes([_HEADER]) or not any(header.get(b"index_pos", b""))):
                raise BagError("the bag has no index: its recorder was killed; run `rosbag reindex` on it.")
            is_first = False
            if operation == bytes([_CHUNK]):
                size = _number(header, b"size")
                LIMITS.CHUNK.check(size, "a chunk", error=BagError)
                expansion.add(size)
                self._chunks[offset] = (size, header.get(b"compression", b"").decode("ascii"), start, end - start)
            elif operation == bytes([_CONNECTION]):
                self._connect(header, self._data(start, end))
            elif operation == bytes([_CHUNK_INFO]):
                self._take_chunk_info(header, self._data(start, end))

    def _record(self, at: int) -> tuple[dict[bytes, bytes], int, int]:
        """Header of the record at a place in the file, and where its data start and end."""
        self._file.seek(at)
        size = self._length(self._size - at - 4)
        if size > _HEADER_LIMIT:
            raise BagError(f"the header of a record claims {size} bytes, expected at most {_HEADER_LIMIT}; the file is damaged.")
        header = _fields(self._file.read(size))
        length = self._length(self._size - at - 8 - size)
        return header, at + 8 + size, at + 8 + size + length

    def _length(self, most: int) -> int:
        raw = self._file.read(4)
        length = _U32.unpack(raw)[0] if len(raw) == 4 else most + 1
        if length > most:
            raise BagError(f"a record claims {length} bytes where the file has {max(most, 0)}; the file is cut or damaged.")
        return int(length)

    def _data(self, start: int, end: int) -> bytes:
        LIMITS.RECORD.check(end - start, "a record", error=BagError)
        self._file.seek(start)
        return self._file.read(end - start)

    def _connect(self, header: dict[bytes, bytes], data: bytes) -> None:
        fields = _fields(data)
        key, topic = _number(header, b"conn"), check_name(_text(header, b"topic"), "a topic")
        definition = _text(fields, b"message_definition")
        LIMITS.SCHEMA.check(len(definition), topic, error=BagError)
        package, _, name = check_name(_text(fields, b"type"), "a message type").partition("/")
        self._connections.setdefault(key, RecordedTopic(key, topic, f"{package}/msg/{name.removeprefix('msg/')}", 0, definition, "ros2msg"))
        LIMITS.TOPICS.check(len(self._connections), "the file", error=BagError)

    def _take_chunk_info(self, header: dict[bytes, bytes], data: bytes) -> None:
        offset = int.from_bytes(header.get(b"chunk_pos", b""), "little")
        start = header.get(b"start_time", bytes(8))
        if len(start) == 8:
            self._starts[offset] = _nanoseconds(start)
        for at in range(0, len(data) - 7, 8):
            self._counts[_U32.unpack_from(data, at)[0]] += _U32.unpack_from(data, at + 4)[0]

    def _messages_of(self, offset: int, wanted: Collection[int]) -> Iterator[RawMessage]:
        size, compression, start, length = self._chunks[offset]
        data = decompressed(self._data(start, start + length), compression, size)
        yield from messages_of_chunk(_chunk_messages(data, self._records), data, wanted)


def _chunk_messages(data: bytes | memoryview, expansion: Expansion) -> Iterator[tuple[int, int, int, int]]:
    """Connection, log time, start and end of every message in an uncompressed chunk."""
    view, at = memoryview(data), 0
    while at < len(view):
        header, start, end = _inner_record(view, at)
        at = end
        expansion.count(1)
        if header.get(b"op") == bytes([_MESSAGE]):
            yield _number(header, b"conn"), _nanoseconds(header.get(b"time", b"")), start, end


def _inner_record(view: memoryview, at: int) -> tuple[dict[bytes, bytes], int, int]:
    """As `Rosbag1Storage._record`, in an uncompressed chunk."""
    places = []
    for _ in range(2):
        length = _U32.unpack_from(view, at)[0] if at + 4 <= len(view) else len(view)
        places.append((at + 4, at + 4 + length))
        at += 4 + length
        if at > len(view):
            raise BagError("a chunk ends in the middle of a record; the file is damaged.")
    (start, end), (data_start, data_end) = places
    return _fields(bytes(view[start:end])), data_start, data_end


def _fields(raw: bytes) -> dict[bytes, bytes]:
    """Fields of a header: each with its length, as `name=value`."""
    fields, at = {}, 0
    while at < len(raw):
        end = at + 4 + (_U32.unpack_from(raw, at)[0] if at + 4 <= len(raw) else len(raw))
        name, separator, value = raw[at + 4 : end].partition(b"=")
        if end > len(raw) or not separator:
            raise BagError("the header of a record cannot be read; the file is damaged.")
        fields[name] = value
        at = end
    return fields


def _number(fields: dict[bytes, bytes], name: bytes) -> int:
    value = fields.get(name, b"")
    if len(value) != 4:
        raise BagError(f"a record lacks the number `{name.decode()}`; the file is damaged.")
    return int(_U32.unpack(value)[0])


def _text(fields: dict[bytes, bytes], name: bytes) -> str:
    if name not in fields:
        raise BagError(f"a connection lacks `{name.decode()}`; the file is damaged.")
    return fields[name].decode("utf-8")


def _nanoseconds(raw: bytes) -> int:
    if len(raw) != 8:
        raise BagError("a record lacks its time; the file is damaged.")
    seconds, nanoseconds = _TIME.unpack(raw)
    return int(seconds) * 10**9 + int(nanoseconds)
