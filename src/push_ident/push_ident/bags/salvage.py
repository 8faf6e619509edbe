"""Recover the readable part of a damaged MCAP bag into a new bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from push_ident.bags.contract import role_of
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError

__all__ = ["SalvageReport", "count_recoverable", "salvage"]

_MAX_RECORD: Final = 2**30
"""Longest record accepted [bytes]: a damaged length must not exhaust the memory."""
_CHEAP: Final = 2**28
"""Largest file that is read only to count the recoverable messages [bytes]."""


@dataclass(frozen=True, slots=True)
class SalvageReport:
    """Result of recovering a damaged bag."""

    bag: Path
    messages: dict[str, int]
    """Recovered messages by topic."""
    damaged_chunks: int
    """Number of chunks left out because their content is damaged."""
    undecodable: int
    """Number of messages of the contract left out because they do not match their type."""
    end: str
    """Why reading stopped; empty for a file that is intact to its end."""

    @property
    def total(self) -> int:
        """Number of recovered messages."""
        return sum(self.messages.values())


class _Records:
    """Intact records of a file, chunk by chunk, up to the point where it is truncated."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.damaged_chunks = 0
        self.end = ""

    def __iter__(self) -> Iterator[McapRecord]:
        with self._path.open("rb") as file:
            records = StreamReader(file, emit_chunks=True, record_size_limit=_MAX_RECORD).records
            while True:
                try:
                    record = next(records)
                except StopIteration:
                    return
                except Exception as error:
                    # The parser may raise any exception at the damaged place.
                    reason = (str(error).strip().splitlines() or ["the file ends in the middle of a record"])[0]
                    self.end = f"{type(error).__name__}: {reason[:200]}"
                    return
                if isinstance(record, Chunk):
                    yield from self._intact(record)
                else:
                    yield record

    def _intact(self, chunk: Chunk) -> list[McapRecord]:
        try:
            if chunk.uncompressed_size > _MAX_RECORD:
                raise ValueError("impossible size of a chunk")
            return breakup_chunk(chunk, validate_crc=True)
        except Exception:
            # Decompressor and parser may raise any exception on damaged bytes; the whole chunk is lost.
            self.damaged_chunks += 1
            return []


def count_recoverable(path: Path) -> int | None:
    """Number of messages that `salvage` would recover from an .mcap file; None for a file too large to be read for that."""
    try:
        if path.stat().st_size > _CHEAP:
            return None
        return sum(isinstance(record, Message) for record in _Records(path))
    except OSError:
        return 0


def salvage(path: Path, out: Path) -> SalvageReport:
    """Copy every complete, intact chunk of a damaged MCAP bag (file, or folder with one) into the new bag `out`.

    Raises BagError when `path` is not an MCAP bag, `out` exists, or nothing can be recovered (then `out` is not created).
    """
    source = _mcap_in(path)
    total = count_recoverable(source)
    if total == 0:
        raise BagError(f"{path}: no message can be recovered; all chunks of the file are damaged, or it is not an MCAP bag.")
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    counts: Counter[str] = Counter()
    undecodable = 0
    records = _Records(source)
    with BagWriter(out) as writer:
        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and (channel := channels.get(record.channel_id)):
                schema = schemas.get(channel.schema_id)
                if schema is None:
                    continue
                if not _decodes(channel.topic, schema.name, record.data):
                    undecodable += 1
                    continue
                writer.write_raw(
                    channel.topic,
                    schema.name,
                    record.log_time,
                    record.data,
                    publish_ns=record.publish_time,
                    definition=(schema.encoding, schema.data),
                )
                counts[channel.topic] += 1
    if not counts:
        raise BagError(f"{path}: no message was found intact and with its type; {out} was left empty.")
    return SalvageReport(out, dict(sorted(counts.items())), records.damaged_chunks, undecodable, records.end)


def _decodes(topic: str, msgtype: str, data: bytes) -> bool:
    """Whether a message of the contract can be read; one that cannot would make the whole new bag unreadable."""
    role = role_of(topic)
    if role is None or role.role.msgtype != msgtype or msgtype not in jazzy_typestore().fielddefs:
        return True
    try:
        jazzy_typestore().deserialize_cdr(data, msgtype)
    except Exception:
        # The generated decoder may raise any exception on damaged bytes.
        return False
    return True


def _mcap_in(path: Path) -> Path:
    if not path.exists():
        raise BagError(f"{path}: there is no such bag; give the damaged .mcap file or its folder.")
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if len(files) != 1 or files[0].suffix != ".mcap":
        raise BagError(f"{path}: only MCAP bags can be salvaged, one file at a time; found {len(files)} such files.")
    return files[0]
