"""Open a bag of any format; every failure becomes a BagError of one line."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from push_ident.bags.contract import size_limit
from push_ident.bags.definitions import check_definitions
from push_ident.bags.migration import Migration, migration_of
from push_ident.bags.storage.folder_storage import FolderStorage
from push_ident.bags.storage.mcap_storage import McapStorage
from push_ident.bags.storage.rosbag1_storage import Rosbag1Storage
from push_ident.bags.storage.sqlite_storage import SqliteStorage
from push_ident.bags.storage.storage import RecordedTopic, Storage
from push_ident.bags.typestore import jazzy_typestore
from push_ident.errors import BagError, PushIdentError
from push_ident.limits import LIMITS

__all__ = ["OpenBag", "open_bag", "storage_of"]

_STORAGE: Final[dict[str, Callable[[Path], Storage]]] = {".mcap": McapStorage, ".db3": SqliteStorage, ".bag": Rosbag1Storage}
_CAPITAL_PACKAGE: Final = re.compile(r"\b[A-Z]\w*(?=/\w)")


class OpenBag:
    """A bag opened for reading, ROS 1 or ROS 2."""

    def __init__(self, path: Path, storage: Storage) -> None:
        self.path = path
        self._storage = storage
        self._is_ros1 = isinstance(storage, Rosbag1Storage)
        self._store = get_typestore(Stores.EMPTY)
        self._store.max_sequence_length = LIMITS.MESSAGE.value

    @property
    def topics(self) -> list[RecordedTopic]:
        """Every recorded topic, once per recorded publisher."""
        return list(self._storage.topics)

    def counts(self) -> dict[str, int]:
        """Number of messages by topic, from the index of the bag."""
        counts: Counter[str] = Counter()
        for topic in self._storage.topics:
            counts[topic.topic] += topic.msgcount
        return dict(sorted(counts.items()))

    def register(self, topics: Iterable[RecordedTopic]) -> None:
        """Register the message types of these topics, from the schema in the bag where it has one.

        Only these types are registered, so that an unknown type elsewhere in the bag does no harm.
        """
        for topic in topics:
            if _lower_package(topic.msgtype) not in self._store.fielddefs:
                types = _definitions(topic, self._store)
                check_definitions({**self._store.fielddefs, **types}, topic.topic)
                self._store.register(types)

    def messages(self, topics: list[RecordedTopic]) -> Iterator[tuple[RecordedTopic, int, Any]]:
        """Messages of these (registered) topics with their log time [ns], decoded one at a time."""
        decode = self._store.deserialize_ros1 if self._is_ros1 else self._store.deserialize_cdr
        types = {topic.id: _lower_package(topic.msgtype) for topic in topics}
        limits = {topic.id: size_limit(topic.msgtype) for topic in topics}
        for topic, log_time, raw in self._raw(topics):
            limits[topic.id].check(len(raw), topic.topic, error=BagError)
            yield topic, log_time, decode(raw, types[topic.id])

    def raw_messages(self) -> Iterator[tuple[RecordedTopic, int, bytes | memoryview]]:
        """All messages with their log time [ns], serialised (CDR) as the installed definitions have it.

        Raises BagError for a ROS 1 bag, which has another serialisation.
        """
        if self._is_ros1:
            raise BagError(f"{self.path}: a ROS 1 bag cannot be played directly; convert it first, with `rosbags-convert`.")
        migrations = {topic.id: _migration(topic) for topic in self._storage.topics}
        for topic, log_time, raw in self._raw(self._storage.topics):
            migrate = migrations[topic.id]
            yield topic, log_time, raw if migrate is None else migrate(raw)

    def _raw(self, topics: list[RecordedTopic]) -> Iterator[tuple[RecordedTopic, int, bytes | memoryview]]:
        by_id = {topic.id: topic for topic in topics}
        for identifier, log_time, raw in self._storage.messages(by_id.keys()) if by_id else ():
            LIMITS.MESSAGE.check(len(raw), by_id[identifier].topic, error=BagError)
            yield by_id[identifier], log_time, raw


def _lower_package(text: str) -> str:
    """Package names in lower case; ROS 1 accepted capitals (`Mocap/marker_set`), the parser does not."""
    return _CAPITAL_PACKAGE.sub(lambda match: match.group().lower(), text)


def _migration(topic: RecordedTopic) -> Migration | None:
    """How its messages become those of the installed definition; None where nothing is to be done, or the definition cannot be read."""
    try:
        types = get_types_from_msg(topic.definition, topic.msgtype) if topic.definition and topic.encoding == "ros2msg" else {}
        check_definitions(types, topic.topic)
    except Exception:  # A foreign definition: the parser raises almost anything. Played as it is, as before.
        return None
    return migration_of(topic.msgtype, types)


def _definitions(topic: RecordedTopic, known: Typestore) -> dict[str, Any]:
    if topic.definition and topic.encoding == "ros2msg":
        types = get_types_from_msg(_lower_package(topic.definition), _lower_package(topic.msgtype))
    else:
        types = jazzy_typestore().fielddefs
        if topic.msgtype not in types:
            raise BagError(f"type {topic.msgtype} of topic {topic.topic} is neither described in the bag nor known.")
    return {name: fields for name, fields in types.items() if name not in known.fielddefs}


def storage_of(path: Path) -> Path:
    """Path for a reader: a bag folder with metadata, or a storage file.

    Raises BagError when there is no bag at `path`.
    """
    if not os.path.exists(path):  # unlike that of Path it raises for no name
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

    Every failure while it is open, unexpected exceptions of the decoders included, becomes a BagError of one line.
    """
    try:
        place = storage_of(path)
        opened: Storage = FolderStorage(place) if place.is_dir() else _STORAGE[place.suffix](place)
        with closing(opened) as storage:
            yield OpenBag(path, storage)
    except BagError as error:
        text = str(error)
        raise error if text.startswith(str(path)) else BagError(f"{path}: cannot be read ({text.rstrip('.')}){_remedy(path)}") from None
    except PushIdentError:
        raise
    except Exception as error:
        # Damaged bags make decoders and decompressors raise almost any exception (struct, overflow, recursion, database errors).
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")[:200]
        raise BagError(f"{path}: cannot be read ({type(error).__name__}: {reason}){_remedy(path)}") from error


def _remedy(path: Path) -> str:
    """Remedy for a bag that cannot be read."""
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if len(files) == 1 and files[0].suffix == ".mcap":
        from push_ident.bags.salvage import count_recoverable  # only damaged bags need what writes bags

        count = count_recoverable(files[0])
        if count:
            return f"; {count} messages can be recovered: `push-ident salvage {path} --out NEW`."
        if count == 0:
            return "; no message in it can be recovered; it is damaged, or not a bag. Record again."
        return f"; `push-ident salvage {path} --out NEW` recovers the readable part."
    return "; it is damaged, or not a bag. Record again, in MCAP, which survives a kill."
