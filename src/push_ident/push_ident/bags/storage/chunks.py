"""Chunks of messages: bounded decompression, and messages of many chunks in order of time."""

from __future__ import annotations

import bz2
import heapq
from array import array
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import lz4.frame  # type: ignore[import-untyped]
import numpy as np

from push_ident.bags.storage.storage import RawMessage
from push_ident.errors import BagError
from push_ident.limits import LIMITS

try:
    from compression import zstd  # type: ignore[import-not-found]
except ImportError:
    from backports import zstd

__all__ = ["Chunk", "decompressed", "in_order", "messages_of_chunk", "zstd_decompressor"]

_WINDOW_LOG: Final = 26
"""Largest window of zstd: 64 MiB, as the largest chunk; that of level 19 has 8 MiB."""
_MAX_OPEN: Final = 10_000
"""Number of chunks open at once; they are small if there are many."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk, as its index or its header claims it to be."""

    start: int
    """Earliest log time [ns]."""
    size: int
    """Uncompressed [bytes]."""
    offset: int
    """Of its record in the file."""
    channels: frozenset[int] | None = None
    """Topics in it; None where that is unknown."""


def zstd_decompressor() -> Any:
    """A decompressor with a bounded window."""
    return zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: _WINDOW_LOG})


_DECOMPRESSORS: Final[dict[str, Callable[[], Any]]] = {
    "zstd": zstd_decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}
_UNCOMPRESSED: Final = ("", "none")


def decompressed(data: bytes | memoryview, compression: str, size: int | None = None) -> bytes | memoryview:
    """Uncompressed bytes: `size` of them, or where it is None at most those of the largest message.

    Raises BagError for another size or an unknown compression; the decompressors raise their own exceptions for damaged data. Never takes
    more memory than `size` and a window.
    """
    if compression in _UNCOMPRESSED:
        if size is not None and len(data) != size:
            raise BagError(f"a chunk has {len(data)} bytes, expected {size}; it is damaged.")
        return data
    if compression not in _DECOMPRESSORS:
        raise BagError(f"compression {compression[:40]!r} is unknown, expected one of {', '.join(_DECOMPRESSORS)}.")
    if size is not None:
        LIMITS.CHUNK.check(size, "a chunk", error=BagError)
    most = LIMITS.MESSAGE.value if size is None else size
    decompressor = _DECOMPRESSORS[compression]()
    raw: bytes = decompressor.decompress(bytes(data), max_length=most + 1)
    # Output may come in blocks although there is room for more.
    parts = [raw]
    got = len(raw)
    while got <= most and not decompressor.eof and (more := decompressor.decompress(b"", max_length=most + 1 - got)):
        parts.append(more)
        got += len(more)
    if got > most or not decompressor.eof or (size is not None and got != size):
        raise BagError(f"compressed data has {'over ' if got > most else ''}{min(got, most)} bytes, expected {most}; it is damaged.")
    return raw if len(parts) == 1 else b"".join(parts)


def messages_of_chunk(
    records: Iterable[tuple[int, int, int, int]], data: bytes | memoryview, wanted: Collection[int]
) -> Iterator[RawMessage]:
    """Messages of the wanted topics in one chunk, in order of log time.

    `records`: topic, log time, start and end in `data` of every message. They are kept as numbers, 24 bytes each: a chunk can
    hold two million empty messages.
    """
    view = memoryview(data)
    topics, times, starts, ends = array("Q"), array("Q"), array("I"), array("I")
    for topic, time, start, end in records:
        if topic in wanted:
            topics.append(topic)
            times.append(time)
            starts.append(start)
            ends.append(end)
    order = np.argsort(np.frombuffer(times, dtype=np.uint64), kind="stable") if len(times) else ()
    for k in order:
        yield topics[k], times[k], view[starts[k] : ends[k]]


def in_order(chunks: Iterable[Chunk], read: Callable[[Chunk], Iterator[RawMessage]]) -> Iterator[RawMessage]:
    """Messages of all chunks in order of log time.

    Chunks that overlap in time are open together, up to `LIMITS.OPEN_CHUNKS`: beyond, and where chunks claim false times, the order is only
    approximate.
    """
    waiting = sorted(chunks, key=lambda chunk: (chunk.start, chunk.offset), reverse=True)
    opened: list[tuple[int, int, RawMessage, Iterator[RawMessage], int]] = []
    size = 0

    def push(number: int, messages: Iterator[RawMessage], claimed: int) -> None:
        nonlocal size
        if (message := next(messages, None)) is None:
            size -= claimed
        else:
            heapq.heappush(opened, (message[1], number, message, messages, claimed))

    while opened or waiting:
        while waiting and (not opened or (waiting[-1].start <= opened[0][0] and _has_room(size + waiting[-1].size, len(opened)))):
            chunk = waiting.pop()
            size += chunk.size
            push(chunk.offset, read(chunk), chunk.size)
        if opened:
            _, number, message, messages, claimed = heapq.heappop(opened)
            yield message
            push(number, messages, claimed)


def _has_room(size: int, n_open: int) -> bool:
    return size <= LIMITS.OPEN_CHUNKS.value and n_open < _MAX_OPEN
