"""Records of an MCAP file in the order of the file (https://mcap.dev/spec), for files that rosbags cannot read for want of an index."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from push_ident.bags.compression import check_expansion, zstd_claim
from push_ident.errors import BagError
from push_ident.limits import LIMITS

MAGIC: Final[bytes] = MCAP0_MAGIC
_HEAD: Final = struct.Struct("<BQ")
"""Operation code and length of the content."""


def record_heads(file: IO[bytes], start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Operation code, start and end of the content of each record from byte `start` to `end`; the contents are not read.

    Raises BagError where a record reaches beyond `end`.
    """
    while start < end:
        file.seek(start)
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise BagError("the file ends in the middle of a record.")
        operation, length = _HEAD.unpack(head)
        start += _HEAD.size
        if length > end - start:
            raise BagError(f"a record claims {length} bytes where the file has {max(end - start, 0)}; the file is cut or damaged.")
        yield operation, start, start + length
        start += length


def chunk_index_of(file: IO[bytes], start: int, end: int) -> ChunkIndex:
    """The entry of the index from byte `start` to `end`."""
    return ChunkIndex.read(_fields(file, start, end))


def chunk_of(file: IO[bytes], start: int, end: int) -> Chunk:
    """The chunk whose content starts at byte `start`, with its data up to byte `end`. Raises BagError for one that holds too much."""
    chunk = Chunk.read(_fields(file, start, end))
    LIMITS.CHUNK.check(chunk.uncompressed_size, "a chunk", error=BagError)
    if chunk.compression == "zstd" and zstd_claim(chunk.data) > chunk.uncompressed_size:
        raise BagError(f"a chunk has {zstd_claim(chunk.data)} bytes, expected {chunk.uncompressed_size}; the file is damaged.")
    return chunk


class IntactRecords:
    """Schemas, channels and messages of a file, those in chunks included, up to where the file is cut; damaged ones are left out."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.damaged_chunks = 0
        self.end = ""
        """Why reading stopped; empty for a file that is complete."""

    def __iter__(self) -> Iterator[Any]:
        """Each `Schema`, `Channel` and `Message`. Raises BagError for chunks that hold more than such a file can have."""
        size, total = self._path.stat().st_size, 0
        with self._path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                self.end = "the file does not begin as an MCAP file."
                return
            heads = record_heads(file, len(MAGIC), size)
            while True:
                try:
                    operation, start, end = next(heads)
                except StopIteration:
                    return
                except BagError as error:
                    self.end = str(error)
                    return
                if operation == Opcode.FOOTER:
                    return
                try:
                    records, uncompressed = _records(file, operation, start, end)
                except Exception:
                    # Parsers and decompressors raise almost any exception on damaged bytes; the whole record is lost.
                    self.damaged_chunks += operation == Opcode.CHUNK
                    continue
                total += uncompressed
                check_expansion(total, size, "its chunks")
                yield from records


def _fields(file: IO[bytes], start: int, end: int) -> ReadDataStream:
    LIMITS.RECORD.check(end - start, "a record", error=BagError)
    file.seek(start)
    return ReadDataStream(BytesIO(file.read(end - start)))


def _records(file: IO[bytes], operation: int, start: int, end: int) -> tuple[list[Any], int]:
    """The records that are wanted of one record, and how many bytes they have uncompressed."""
    match operation:
        case Opcode.CHUNK:
            chunk = chunk_of(file, start, end)
            return breakup_chunk(chunk, validate_crc=True), chunk.uncompressed_size
        case Opcode.MESSAGE:
            return [Message.read(_fields(file, start, end), end - start)], 0
        case Opcode.SCHEMA:
            return [Schema.read(_fields(file, start, end))], 0
        case Opcode.CHANNEL:
            return [Channel.read(_fields(file, start, end))], 0
    return [], 0
