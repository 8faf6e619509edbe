"""Records of an MCAP file (https://mcap.dev/spec), read one at a time with bounded sizes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Final

from push_ident.bags.storage.chunks import Chunk, decompressed
from push_ident.bags.storage.storage import Expansion, RecordedTopic, check_name
from push_ident.errors import BagError
from push_ident.limits import LIMITS

__all__ = [
    "CHANNEL",
    "CHUNK",
    "CHUNK_INDEX",
    "FOOTER",
    "MAGIC",
    "MESSAGE",
    "SCHEMA",
    "STATISTICS",
    "Channel",
    "Fields",
    "Schema",
    "channel_of",
    "chunk_content",
    "chunk_messages",
    "chunk_of_header",
    "chunk_of_index",
    "chunk_records",
    "message_counts_of",
    "message_of",
    "publish_time_of",
    "read_record",
    "schema_of",
    "topic_of_channel",
]

MAGIC: Final = b"\x89MCAP0\r\n"
FOOTER: Final = 0x02
SCHEMA: Final = 0x03
CHANNEL: Final = 0x04
MESSAGE: Final = 0x05
CHUNK: Final = 0x06
CHUNK_INDEX: Final = 0x08
STATISTICS: Final = 0x0B
_LENGTH: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
"""Topic, sequence number, log time, publish time."""
_CHUNK: Final = struct.Struct("<QQQI")
"""Earliest and latest log time, uncompressed size, check sum."""
_COUNTED: Final = 1000
"""Records after which their number is looked at."""


@dataclass(slots=True)
class Fields:
    """Reads the fields of a record one after the other; raises BagError where the record ends."""

    data: bytes | memoryview
    at: int = 0

    def take(self, size: int) -> bytes:
        """So many bytes."""
        if size > len(self.data) - self.at:
            raise BagError(f"a record has {len(self.data)} bytes, expected {size} more at byte {self.at}; the file is damaged.")
        self.at += size
        return bytes(self.data[self.at - size : self.at])

    def number(self, size: int) -> int:
        """Unsigned integer of so many bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """String with its length before it."""
        return _decoded(self.take(self.number(4)))

    def counts(self, key: int, value: int) -> dict[int, int]:
        """Map from integers to integers, of so many bytes each."""
        inner = Fields(self.take(self.number(4)))
        return {inner.number(key): inner.number(value) for _ in range(len(inner.data) // (key + value))}


def _decoded(raw: bytes) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        raise BagError(f"a name or text has bytes that are no UTF-8: {raw[:20]!r}; the file is damaged.") from None


@dataclass(frozen=True, slots=True)
class Schema:
    """A message type."""

    name: str
    encoding: str
    text: str


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic of one publisher."""

    schema_id: int
    topic: str
    encoding: str


def read_record(file: IO[bytes], end: int, *, limit: int) -> tuple[int, bytes]:
    """Operation code and content of the record at the position of `file`, which must lie before `end`.

    A record longer than `limit` is skipped, its content is empty. Raises BagError for a record that reaches beyond `end`.
    """
    header = file.read(_LENGTH.size)
    if len(header) < _LENGTH.size:
        raise BagError("the file ends in the middle of a record.")
    operation, size = _LENGTH.unpack(header)
    if size > end - file.tell():
        raise BagError(f"a record claims {size} bytes where the file has {max(end - file.tell(), 0)}; the file is cut or damaged.")
    if size > limit:
        file.seek(size, 1)
        return operation, b""
    content = file.read(size)
    if len(content) != size:
        raise BagError("the file ends in the middle of a record.")
    return operation, content


def schema_of(content: bytes | memoryview) -> tuple[int, Schema]:
    """Identifier and content of a schema record."""
    fields = Fields(content)
    identifier, name, encoding = fields.number(2), check_name(fields.text(), "a message type"), fields.text()
    size = fields.number(4)
    LIMITS.SCHEMA.check(size, name, error=BagError)
    return identifier, Schema(name, encoding, _decoded(fields.take(size)))


def channel_of(content: bytes | memoryview) -> tuple[int, Channel]:
    """Identifier and content of a channel record; its metadata are not needed."""
    fields = Fields(content)
    return fields.number(2), Channel(fields.number(2), check_name(fields.text(), "a topic"), fields.text())


def topic_of_channel(identifier: int, channel: Channel, schemas: dict[int, Schema], count: int) -> RecordedTopic:
    """A channel as a recorded topic. Raises BagError for another serialisation than CDR."""
    if channel.encoding != "cdr":
        raise BagError(f"topic {channel.topic} is serialised as {channel.encoding[:40]!r}, expected 'cdr'; record with ROS 2.")
    schema = schemas.get(channel.schema_id, Schema("", "", ""))
    return RecordedTopic(identifier, channel.topic, schema.name, count, schema.text, schema.encoding)


def chunk_of_index(content: bytes) -> tuple[Chunk, int]:
    """Chunk of a chunk index record, and the length of its record."""
    fields = Fields(content)
    start, _, offset, length = (fields.number(8) for _ in range(4))
    channels = frozenset(fields.counts(2, 8))
    fields.number(8)
    fields.text()
    fields.number(8)
    return Chunk(start, fields.number(8), offset, channels or None), length


def chunk_of_header(content: bytes | memoryview, offset: int) -> Chunk:
    """Chunk of the first bytes of a chunk record."""
    if len(content) < _CHUNK.size:
        raise BagError("a chunk is shorter than its header; the file is damaged.")
    start, _, size, _ = _CHUNK.unpack_from(content)
    return Chunk(start, size, offset)


def chunk_content(content: bytes) -> bytes | memoryview:
    """Uncompressed records of a chunk record. Raises BagError where size or check sum are wrong."""
    if len(content) < _CHUNK.size:
        raise BagError("a chunk is shorter than its header; the file is damaged.")
    _, _, size, check_sum = _CHUNK.unpack_from(content)
    LIMITS.CHUNK.check(size, "a chunk", error=BagError)
    fields = Fields(content, _CHUNK.size)
    compression, length = fields.text(), fields.number(8)
    if length > len(content) - fields.at:
        raise BagError(f"a chunk claims {length} bytes where its record has {len(content) - fields.at}; the file is damaged.")
    data = decompressed(memoryview(content)[fields.at : fields.at + length], compression, size)
    if check_sum and zlib.crc32(data) != check_sum:
        raise BagError("a chunk has another check sum than recorded; the file is damaged.")
    return data


def chunk_records(data: bytes | memoryview, expansion: Expansion) -> Iterator[tuple[int, int, int]]:
    """Operation code, start and end of the content of every record in an uncompressed chunk.

    Raises BagError where they do not fit, or `expansion` counts more records than the file can have.
    """
    at, end, unpack, number = 0, len(data), _LENGTH.unpack_from, 0
    while at < end:
        number += 1
        if number % _COUNTED == 0:
            expansion.count(_COUNTED)
        if at + _LENGTH.size > end:
            raise BagError("a chunk ends in the middle of a record; the file is damaged.")
        operation, size = unpack(data, at)
        at += _LENGTH.size
        if size > end - at:
            raise BagError(f"a record in a chunk claims {size} bytes where the chunk has {end - at}; the file is damaged.")
        yield operation, at, at + size
        at += size
    expansion.count(number % _COUNTED)


def message_of(content: bytes | memoryview) -> tuple[int, int, memoryview]:
    """Topic, log time [ns] and serialised message of a message record."""
    if len(content) < _MESSAGE.size:
        raise BagError("a message record is shorter than its header; the file is damaged.")
    topic, _, time, _ = _MESSAGE.unpack_from(content)
    return topic, time, memoryview(content)[_MESSAGE.size :]


def publish_time_of(content: bytes | memoryview) -> int:
    """Publish time [ns] of a message record that is long enough for `message_of`."""
    return int(_MESSAGE.unpack_from(content)[3])


def chunk_messages(data: bytes | memoryview, expansion: Expansion) -> Iterator[tuple[int, int, int, int]]:
    """Topic, log time, start and end of every message in an uncompressed chunk."""
    unpack, header = _MESSAGE.unpack_from, _MESSAGE.size
    for operation, start, end in chunk_records(data, expansion):
        if operation == MESSAGE:
            if end - start < header:
                raise BagError("a message record is shorter than its header; the file is damaged.")
            topic, _, time, _ = unpack(data, start)
            yield topic, time, start + header, end


def message_counts_of(content: bytes) -> dict[int, int]:
    """Number of messages by channel, from a statistics record."""
    fields = Fields(content)
    fields.take(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)
    return fields.counts(2, 8)
