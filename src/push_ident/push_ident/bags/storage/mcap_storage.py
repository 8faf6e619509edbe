"""An MCAP file as a storage: through its index, or where it has none through all its records."""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final

from push_ident.bags.storage import mcap_records as records
from push_ident.bags.storage.chunks import Chunk, in_order, messages_of_chunk
from push_ident.bags.storage.storage import Expansion, RawMessage, RecordedTopic, open_regular
from push_ident.errors import BagError
from push_ident.limits import LIMITS

__all__ = ["McapStorage"]

_TAIL: Final = struct.Struct("<BQQQI8s")
"""Footer record and magic at the end of a file."""


class McapStorage:
    """An MCAP file that is open for reading. Raises BagError for a file that is cut, damaged, or claims what it cannot have."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = open_regular(path)
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, records.Channel] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[Chunk] = []
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._open()
        except BaseException:
            self._file.close()
            raise
        self.topics: list[RecordedTopic] = [
            records.topic_of_channel(key, channel, self._schemas, self._counts[key]) for key, channel in sorted(self._channels.items())
        ]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, wanted: Collection[int]) -> Iterator[RawMessage]:
        """Messages of these topics, in order of log time."""
        wanted = frozenset(wanted)
        if not self._chunks:
            contents = (content for operation, content in self._records() if operation == records.MESSAGE)
            yield from (message for message in map(records.message_of, contents) if message[0] in wanted)
            return
        expansion = Expansion("its chunks", self._size)
        chosen = (chunk for chunk in self._chunks if chunk.channels is None or chunk.channels & wanted)
        yield from in_order(chosen, lambda chunk: self._messages_of(self._read_chunk(chunk), wanted, expansion))

    def _open(self) -> None:
        self._file.seek(0)
        if (magic := self._file.read(len(records.MAGIC))) != records.MAGIC:
            raise BagError("the file is empty." if not magic else "the file does not begin as an MCAP file.")
        if self._size < len(records.MAGIC) + _TAIL.size:
            raise BagError("the file ends in the middle of a record.")
        self._file.seek(self._size - _TAIL.size)
        operation, length, summary, _, _, magic = _TAIL.unpack(self._file.read(_TAIL.size))
        if (operation, length, magic) != (records.FOOTER, 20, records.MAGIC):
            raise BagError("the file has no end; its recorder was killed, or it was cut.")
        self._data_end = self._size - _TAIL.size
        if summary:
            if not len(records.MAGIC) < summary <= self._data_end:
                raise BagError(f"the index lies at byte {summary} of {self._size}; the file is damaged.")
            LIMITS.SUMMARY.check(self._data_end - summary, "the index", error=BagError)
            self._read_summary(summary, self._data_end)
            self._data_end = summary
        if not self._counts or not self._channels:
            self._count()

    def _read_summary(self, start: int, end: int) -> None:
        self._file.seek(start)
        lengths: list[tuple[int, int]] = []
        while self._file.tell() < end:
            operation, content = records.read_record(self._file, end, limit=LIMITS.RECORD.value)
            if operation == records.CHUNK_INDEX:
                chunk, length = records.chunk_of_index(content)
                self._chunks.append(chunk)
                lengths.append((chunk.offset, length))
            elif operation == records.STATISTICS:
                self._counts.update(records.message_counts_of(content))
            else:
                self._declare(operation, content)
        self._check_chunks(lengths, start)

    def _check_chunks(self, lengths: list[tuple[int, int]], end: int) -> None:
        """Chunks must lie one after the other: one that is listed often would be read often."""
        before = len(records.MAGIC)
        for offset, length in sorted(lengths):
            if not before <= offset <= offset + length <= end:
                raise BagError(f"the index lists a chunk of {length} bytes at byte {offset}, which overlaps others; the file is damaged.")
            before = offset + length
        expansion = Expansion("its chunks", self._size)
        for chunk in self._chunks:
            LIMITS.CHUNK.check(chunk.size, "a chunk", error=BagError)
            expansion.add(chunk.size)

    def _declare(self, operation: int, content: bytes | memoryview) -> None:
        """Take a schema or channel record; the first of each identifier counts."""
        if operation == records.SCHEMA:
            key, schema = records.schema_of(content)
            self._schemas.setdefault(key, schema)
        elif operation == records.CHANNEL:
            key, channel = records.channel_of(content)
            self._channels.setdefault(key, channel)
            LIMITS.TOPICS.check(len(self._channels), "the file", error=BagError)

    def _count(self) -> None:
        """Topics and number of messages of a file whose summary lacks them."""
        self._counts.clear()
        for operation, content in self._records():
            if operation == records.MESSAGE:
                self._counts[records.message_of(content)[0]] += 1
            else:
                self._declare(operation, content)

    def _read_chunk(self, chunk: Chunk) -> bytes:
        self._file.seek(chunk.offset)
        operation, content = records.read_record(self._file, self._data_end, limit=LIMITS.RECORD.value)
        if operation != records.CHUNK or not content or records.chunk_of_header(content, 0).size != chunk.size:
            raise BagError(f"the index lists a chunk at byte {chunk.offset}, where there is another; the file is damaged.")
        return content

    def _messages_of(self, content: bytes, wanted: Collection[int], expansion: Expansion) -> Iterator[RawMessage]:
        data = records.chunk_content(content)
        yield from messages_of_chunk(records.chunk_messages(data, expansion), data, wanted)

    def _records(self) -> Iterator[tuple[int, bytes | memoryview]]:
        """Operation code and content of all records before the summary, those in chunks included, in the order of the file."""
        expansion = Expansion("its chunks", self._size)
        at = len(records.MAGIC)
        while at < self._data_end:
            self._file.seek(at)
            operation, content = records.read_record(self._file, self._data_end, limit=LIMITS.RECORD.value)
            at = self._file.tell()
            if operation != records.CHUNK:
                yield operation, content
                continue
            data = memoryview(records.chunk_content(content))
            expansion.add(len(data))
            for inner, start, end in records.chunk_records(data, expansion):
                yield inner, data[start:end]
