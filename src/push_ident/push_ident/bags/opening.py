"""Open a bag of any format; every failure becomes a BagError of one line."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from push_ident.bags.salvage import count_recoverable
from push_ident.bags.typestore import jazzy_typestore
from push_ident.errors import BagError, PushIdentError

__all__ = ["OpenBag", "open_bag", "storage_of"]

_STORAGE: Final = (".mcap", ".db3", ".bag")
_CAPITAL_PACKAGE: Final = re.compile(r"\b[A-Z]\w*(?=/\w)")
_MAX_SEQUENCE: Final = 2**28
"""Longest array accepted in a message: far above any image, far below what would exhaust the memory."""


class OpenBag:
    """A bag opened for reading, ROS 1 or ROS 2."""

    def __init__(self, path: Path, reader: Rosbag1Reader | Rosbag2Reader) -> None:
        self.path = path
        self._reader = reader
        self._is_ros1 = isinstance(reader, Rosbag1Reader)
        self._store = get_typestore(Stores.EMPTY)
        self._store.max_sequence_length = _MAX_SEQUENCE

    @property
    def connections(self) -> list[Connection]:
        """Every recorded topic, once per recorded publisher."""
        return list(self._reader.connections)

    def counts(self) -> dict[str, int]:
        """Number of messages by topic, from the index of the bag."""
        counts: Counter[str] = Counter()
        for connection in self._reader.connections:
            counts[connection.topic] += connection.msgcount
        return dict(sorted(counts.items()))

    def register(self, connections: Iterable[Connection]) -> None:
        """Register the message types of these topics, from the schema in the bag where it has one.

        Only these types are registered, so that an unknown type elsewhere in the bag does no harm.
        """
        for connection in connections:
            if _lower_package(connection.msgtype) not in self._store.fielddefs:
                self._store.register(_definitions(connection, self._store))

    def messages(self, connections: list[Connection]) -> Iterator[tuple[Connection, int, Any]]:
        """Messages of these (registered) topics with their log time [ns], decoded one at a time."""
        for connection, log_time, raw in self._reader.messages(connections=connections) if connections else ():
            decode = self._store.deserialize_ros1 if self._is_ros1 else self._store.deserialize_cdr
            yield connection, log_time, decode(raw, _lower_package(connection.msgtype))

    def raw_messages(self) -> Iterator[tuple[Connection, int, bytes | memoryview]]:
        """All messages in serialised form (CDR) with their log time [ns].

        Raises BagError for a ROS 1 bag, which has another serialisation.
        """
        if self._is_ros1:
            raise BagError(f"{self.path}: a ROS 1 bag cannot be played directly; convert it first, with `rosbags-convert`.")
        yield from self._reader.messages()


def _lower_package(text: str) -> str:
    """Package names in lower case; ROS 1 accepted capitals (`Mocap/marker_set`), the parser does not."""
    return _CAPITAL_PACKAGE.sub(lambda match: match.group().lower(), text)


def _definitions(connection: Connection, known: Typestore) -> dict[str, Any]:
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        types = get_types_from_msg(_lower_package(connection.msgdef.data), _lower_package(connection.msgtype))
    else:
        types = jazzy_typestore().fielddefs
        if connection.msgtype not in types:
            raise BagError(f"type {connection.msgtype} of topic {connection.topic} is neither described in the bag nor known.")
    return {name: fields for name, fields in types.items() if name not in known.fielddefs}


def storage_of(path: Path) -> Path:
    """Path for a reader: a bag folder with metadata, or a storage file.

    Raises BagError when there is no bag at `path`.
    """
    if not path.exists():
        raise BagError(f"{path}: there is no such bag; give a bag folder or a {', '.join(_STORAGE)} file.")
    if path.name == "metadata.yaml":
        path = path.parent
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            return path
        files = sorted(file for file in path.iterdir() if file.suffix in _STORAGE)
        if not files:
            raise BagError(f"{path}: the folder holds no bag (no metadata.yaml, no {', '.join(_STORAGE)} file).")
        if len(files) > 1:
            raise BagError(f"{path}: the folder holds {len(files)} storage files and no metadata.yaml; name one of them.")
        path = files[0]
    if path.suffix not in _STORAGE:
        raise BagError(f"{path}: not the name of a bag; expected a bag folder or a {', '.join(_STORAGE)} file.")
    return path


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag for reading: a folder, an MCAP or sqlite3 file, or a ROS 1 bag.

    Every failure while it is open, unexpected exceptions of the readers included, becomes a BagError of one line.
    """
    try:
        storage = storage_of(path)
        reader = Rosbag1Reader(storage) if storage.is_file() and storage.suffix == ".bag" else Rosbag2Reader(storage)
        with reader:
            yield OpenBag(path, reader)
    except PushIdentError:
        raise
    except Exception as error:
        # Damaged bags make the readers raise almost any exception (assertions, struct, overflow, compression, database errors).
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")[:200]
        raise BagError(f"{path}: cannot be read ({type(error).__name__}: {reason}){_remedy(path)}") from error


def _remedy(path: Path) -> str:
    """Remedy for a bag that cannot be read."""
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if len(files) == 1 and files[0].suffix == ".mcap":
        count = count_recoverable(files[0])
        if count:
            return f"; {count} messages can be recovered: `push-ident salvage {path} --out NEW`."
        if count == 0:
            return "; no message in it can be recovered; it is damaged, or not a bag. Record again."
        return f"; `push-ident salvage {path} --out NEW` recovers the readable part."
    return "; it is damaged, or not a bag. Record again, in MCAP, which survives a kill."
