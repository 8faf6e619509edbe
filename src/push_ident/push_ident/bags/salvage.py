"""Recover the readable part of a damaged MCAP bag into a new bag."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from push_ident.bags.contract import role_of, size_limit
from push_ident.bags.storage import mcap_records as records
from push_ident.bags.storage.storage import Expansion, open_regular
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError
from push_ident.limits import LIMITS

__all__ = ["SalvageReport", "count_recoverable", "salvage"]

_CHEAP: Final = 2**28
"""Largest file that is read only to count the recoverable messages [bytes]."""
_COUNTED: Final = 200_000
"""Largest number of records that are read only to count."""


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

    def __iter__(self) -> Iterator[tuple[int, bytes | memoryview]]:
        """Operation code and content of each."""
        with open_regular(self._path) as file:
            size = os.fstat(file.fileno()).st_size
            expansion = Expansion(str(self._path), size)
            if file.read(len(records.MAGIC)) != records.MAGIC:
                self.end = "the file does not begin as an MCAP file."
                return
            while file.tell() < size:
                try:
                    operation, content = records.read_record(file, size, limit=LIMITS.RECORD.value)
                except BagError as error:
                    self.end = str(error)
                    return
                if operation == records.FOOTER:
                    return
                if operation == records.CHUNK:
                    yield from self._intact(content, expansion)
                else:
                    yield operation, content

    def _intact(self, content: bytes, expansion: Expansion) -> Iterator[tuple[int, bytes | memoryview]]:
        try:
            data = memoryview(records.chunk_content(content))
        except Exception:
            # A decompressor may raise any exception on damaged bytes; the whole chunk is lost.
            self.damaged_chunks += 1
            return
        expansion.add(len(data))
        try:
            for _ in records.chunk_records(data, expansion):
                pass
        except BagError:
            self.damaged_chunks += 1
            return
        again = Expansion(expansion.what, expansion.file_size)
        yield from ((operation, data[start:end]) for operation, start, end in records.chunk_records(data, again))


def count_recoverable(path: Path) -> int | None:
    """Number of messages that `salvage` would recover from an .mcap file; None for one too large to be read for that."""
    try:
        if path.stat().st_size > _CHEAP:
            return None
        count = 0
        for number, (operation, _) in enumerate(_Records(path)):
            count += operation == records.MESSAGE
            if number > _COUNTED:
                return None
        return count
    except (OSError, BagError):
        return 0


def salvage(path: Path, out: Path) -> SalvageReport:
    """Copy every complete, intact chunk of a damaged MCAP bag (file, or folder with one) into the new bag `out`.

    Raises BagError when `path` is not an MCAP bag, `out` exists, or nothing can be recovered (then `out` is not created).
    """
    source = _mcap_in(path)
    total = count_recoverable(source)
    if total == 0:
        raise BagError(f"{path}: no message can be recovered; all chunks of the file are damaged, or it is not an MCAP bag.")
    schemas: dict[int, records.Schema] = {}
    channels: dict[int, records.Channel] = {}
    counts: Counter[str] = Counter()
    undecodable = 0
    found = _Records(source)
    with BagWriter(out) as writer:
        for operation, content in found:
            if operation in (records.SCHEMA, records.CHANNEL):
                _declare(operation, content, schemas, channels)
            elif operation == records.MESSAGE:
                number, log_time, data = records.message_of(content)
                if (known := channels.get(number)) is None or known.schema_id not in schemas:
                    continue
                schema = schemas[known.schema_id]
                if log_time >= 2**63 or not _decodes(known.topic, schema.name, data):
                    undecodable += 1
                    continue
                publish_ns, definition = records.publish_time_of(content), (schema.encoding, schema.text.encode())
                writer.write_raw(known.topic, schema.name, log_time, data, publish_ns=publish_ns, definition=definition)
                counts[known.topic] += 1
    if not counts:
        raise BagError(f"{path}: no message was found intact and with its type; {out} was left empty.")
    return SalvageReport(out, dict(sorted(counts.items())), found.damaged_chunks, undecodable, found.end)


def _declare(operation: int, content: bytes | memoryview, schemas: dict[int, records.Schema], channels: dict[int, records.Channel]) -> None:
    """Take a schema or channel record; of a damaged one, the messages are lost."""
    try:
        if operation == records.SCHEMA:
            key, schema = records.schema_of(content)
            schemas[key] = schema
        else:
            key, channel = records.channel_of(content)
            channels[key] = channel
    except BagError:
        return
    LIMITS.TOPICS.check(len(channels), "the file", error=BagError, remedy="It is damaged.")


def _decodes(topic: str, msgtype: str, data: memoryview) -> bool:
    """Whether a message of the contract can be read; one that cannot would make the whole new bag unreadable."""
    role = role_of(topic)
    if role is None or role.role.msgtype != msgtype or msgtype not in jazzy_typestore().fielddefs:
        return True
    if len(data) > size_limit(msgtype).value:
        return False  # the reader refuses it
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
