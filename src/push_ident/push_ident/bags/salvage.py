"""Recover the readable part of a damaged MCAP bag into a new bag."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from push_ident.bags.contract import role_of, size_limit
from push_ident.bags.mcap_records import Channel, IntactRecords, Message, Schema
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError
from push_ident.limits import LIMITS


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


def count_recoverable(path: Path) -> int | None:
    """Number of messages that `salvage` would recover from an .mcap file; None for one of too many bytes or records to be read for that."""
    try:
        if path.stat().st_size > 2**28:
            return None
        count = 0
        for number, record in enumerate(IntactRecords(path)):
            count += isinstance(record, Message)
            if number > 200_000:
                return None
        return count
    except (OSError, BagError):
        return 0


def salvage(path: Path, out: Path) -> SalvageReport:
    """Copy every complete, intact chunk of a damaged MCAP bag (file, or folder with one) into the new bag `out`.

    Raises BagError when `path` is not an MCAP bag, `out` exists, or nothing can be recovered (then `out` is not created).
    """
    source = _mcap_in(path)
    if count_recoverable(source) == 0:
        raise BagError(f"{path}: no message can be recovered; all chunks of the file are damaged, or it is not an MCAP bag.")
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    counts: Counter[str] = Counter()
    undecodable = 0
    records = IntactRecords(source)
    with BagWriter(out) as writer:
        for record in records:
            if isinstance(record, Schema):
                if len(record.data) <= LIMITS.SCHEMA.value:
                    schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
                LIMITS.TOPICS.check(len(channels), "the file", error=BagError, remedy="It is damaged.")
            elif (known := channels.get(record.channel_id)) is not None and (schema := schemas.get(known.schema_id)) is not None:
                if record.log_time >= 2**63 or not _decodes(known.topic, schema, record.data):
                    undecodable += 1
                    continue
                definition = (schema.encoding, schema.data)
                writer.write_raw(
                    known.topic, schema.name, record.log_time, record.data, publish_ns=record.publish_time, definition=definition
                )
                counts[known.topic] += 1
    if not counts:
        raise BagError(f"{path}: no message was found intact and with its type; {out} was left empty.")
    return SalvageReport(out, dict(sorted(counts.items())), records.damaged_chunks, undecodable, records.end)


def _decodes(topic: str, schema: Schema, data: bytes) -> bool:
    """Whether a message of the contract can be read; one that cannot would make the whole new bag unreadable."""
    role = role_of(topic)
    if role is None or role.role.msgtype != schema.name:
        return True
    if len(data) > size_limit(schema.name).value:
        return False  # the reader refuses it
    try:
        _typestore_of(schema.name, schema.encoding, schema.data).deserialize_cdr(data, schema.name)
    except Exception:
        # The generated decoder may raise any exception on damaged bytes.
        return False
    return True


@lru_cache(maxsize=64)
def _typestore_of(msgtype: str, encoding: str, definition: bytes) -> Typestore:
    """That of the file's own definition, which may be of another version of the type than the one installed."""
    if encoding != "ros2msg":
        return jazzy_typestore()
    store = get_typestore(Stores.EMPTY)
    store.register({**jazzy_typestore().fielddefs, **get_types_from_msg(definition.decode("utf-8"), msgtype)})
    return store


def _mcap_in(path: Path) -> Path:
    if not path.exists():
        raise BagError(f"{path}: there is no such bag; give the damaged .mcap file or its folder.")
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if len(files) != 1 or files[0].suffix != ".mcap":
        raise BagError(f"{path}: only MCAP bags can be salvaged, one file at a time; found {len(files)} such files.")
    if not files[0].is_file():
        raise BagError(f"{files[0]}: not a regular file; give the damaged .mcap file or its folder.")
    return files[0]
