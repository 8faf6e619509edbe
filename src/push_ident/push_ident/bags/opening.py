"""Open a bag of any format; every failure becomes a BagError of one line."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, Final
from urllib.parse import quote

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2 import storage_mcap
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from push_ident.bags.compression import uncompress_file, uncompressed_message
from push_ident.bags.contract import size_limit
from push_ident.bags.folder import read_folder
from push_ident.bags.mcap_records import IntactRecords, Message
from push_ident.bags.migration import Migration, migration_of
from push_ident.bags.preflight import check_claims
from push_ident.bags.typestore import jazzy_typestore
from push_ident.errors import BagError, ContentError, PushIdentError
from push_ident.limits import LIMITS

SUFFIXES: Final = (".mcap", ".db3", ".bag")
"""Of the files of a bag."""
_SPLIT: Final = re.compile(r"_\d+$")
"""Number at the end of the names of the files of one recording."""
_CAPITAL_PACKAGE: Final = re.compile(r"\b[A-Z]\w*(?=/\w)")

_KNOWN_DEFINITION: Final = storage_mcap.get_msgdef


def _definition_of(schema: Any) -> MessageDefinition:
    """As rosbags has it; none for the schema of a channel that is no ROS message, as JSON or protobuf, for which it refuses the file."""
    try:
        return _KNOWN_DEFINITION(schema)
    except KeyError:
        return MessageDefinition(MessageDefinitionFormat.NONE, "")


def _text_of(bio: BinaryIO) -> str:
    """As rosbags has it, but for the schema of a protobuf channel, which is no text and which nobody reads."""
    return storage_mcap.read_bytes(bio).decode(errors="replace")


storage_mcap.get_msgdef, storage_mcap.read_string = _definition_of, _text_of

_Reader = Rosbag1Reader | Rosbag2Reader
_Decompressor = Callable[[bytes], bytes]


class OpenBag:
    """A bag opened for reading, ROS 1 or ROS 2."""

    def __init__(self, path: Path, readers: list[_Reader], promised: dict[str, int], decompress: _Decompressor | None) -> None:
        """
        Args:
            path: Of the bag.
            readers: Of its storage files, open, in order of time.
            promised: Number of messages by topic that its metadata.yaml lists.
            decompress: Of a message that is compressed.
        """
        self.path = path
        self._readers, self._decompress = readers, decompress
        self.files = [Path(str(reader.path)) for reader in readers]
        """Its storage files, uncompressed, in order of time; those of a compressed bag are there as long as it is open."""
        self.start_ns = min(reader.start_time for reader in readers)
        """Log time of its first message [ns]."""
        self.is_message_compressed = decompress is not None
        self._is_ros1 = any(isinstance(reader, Rosbag1Reader) for reader in readers)
        self._store = get_typestore(Stores.EMPTY)
        self._store.max_sequence_length = LIMITS.MESSAGE.value
        self.topics = [connection for reader in readers for connection in _checked(reader)]
        """Every recorded topic, once for each publisher and storage file."""
        counts = self.counts()
        self.lacking = {topic: count - counts.get(topic, 0) for topic, count in promised.items() if count > counts.get(topic, 0)}
        """Number of messages by topic that metadata.yaml lists and the files do not have."""

    def counts(self) -> dict[str, int]:
        """Number of messages by topic, from the index of the bag."""
        counts: Counter[str] = Counter()
        for topic in self.topics:
            counts[topic.topic] += topic.msgcount
        return dict(sorted(counts.items()))

    def register(self, topics: Iterable[Connection]) -> None:
        """Register the message types of these topics, from the schema in the bag where it has one.

        Only these types are registered, so that an unknown type elsewhere in the bag does no harm.
        """
        for topic in topics:
            _check_serialisation(topic)
            if _lower_package(topic.msgtype) not in self._store.fielddefs:
                types = _definitions(topic, self._store)
                _check_definitions({**self._store.fielddefs, **types}, topic.topic)
                self._store.register(types)

    def messages(self, topics: Iterable[Connection]) -> Iterator[tuple[Connection, int, Any]]:
        """Messages of these (registered) topics with their log time [ns], decoded one at a time."""
        decode = self._store.deserialize_ros1 if self._is_ros1 else self._store.deserialize_cdr
        for topic, log_time, raw in self._raw(topics):
            size_limit(topic.msgtype).check(len(raw), topic.topic, error=ContentError)
            yield topic, log_time, decode(raw, _lower_package(topic.msgtype))

    def raw_messages(self) -> Iterator[tuple[Connection, int, bytes]]:
        """All messages with their log time [ns], serialised (CDR) as the installed definitions have it.

        Raises BagError for a ROS 1 bag, which has another serialisation.
        """
        if self._is_ros1:
            raise BagError(f"{self.path}: a ROS 1 bag cannot be played directly; convert it first, with `rosbags-convert`.")
        for topic in self.topics:
            _check_serialisation(topic)
        migrations = {(topic.msgtype, topic.msgdef): _migration(topic) for topic in self.topics}
        for topic, log_time, raw in self._raw(self.topics):
            migrate = migrations[topic.msgtype, topic.msgdef]
            yield topic, log_time, raw if migrate is None else migrate(raw)

    def _raw(self, topics: Iterable[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Messages file after file, each in order of log time."""
        wanted = set(map(id, topics))
        for reader in self._readers:
            chosen = [topic for topic in reader.connections if id(topic) in wanted]
            for topic, log_time, raw in _messages(reader, chosen) if chosen else ():
                data = self._decompress(raw) if self._decompress else raw
                LIMITS.MESSAGE.check(len(data), topic.topic, error=BagError)
                yield topic, log_time, data


def _checked(reader: _Reader) -> list[Connection]:
    """Topics of a storage file. Raises BagError for impossible ones."""
    LIMITS.TOPICS.check(len(reader.connections), str(reader.path), error=BagError)
    for topic in reader.connections:
        for name, what in ((topic.topic, "a topic"), (topic.msgtype, "a message type")):
            LIMITS.STRING.check(len(name), what, error=BagError)
        LIMITS.SCHEMA.check(len(topic.msgdef.data), topic.topic, error=BagError)
    return reader.connections


def _check_serialisation(topic: Connection) -> None:
    """Raise BagError for a topic that is to be read and is not CDR; others may be anything."""
    if isinstance(topic.ext, ConnectionExtRosbag2) and topic.ext.serialization_format != "cdr":
        form = topic.ext.serialization_format[:40]
        raise ContentError(f"topic {topic.topic} is serialised as {form!r}, expected 'cdr'; record with ROS 2.")


def _messages(reader: _Reader, topics: list[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
    storage = reader.storage if isinstance(reader, Rosbag2Reader) else None
    if not isinstance(storage, McapReader) or (storage.chunks and all(chunk.message_index_offsets for chunk in storage.chunks)):
        yield from reader.messages(topics)
        return
    # rosbags reads a file without an index only if its messages are in order of time, which recorders do not promise.
    by_id = {topic.id: topic for topic in topics}
    records = IntactRecords(Path(str(reader.path)))
    for record in records:
        if isinstance(record, Message) and record.channel_id in by_id:
            yield by_id[record.channel_id], record.log_time, record.data
    if records.end or records.damaged_chunks:
        raise BagError(records.end or f"{records.damaged_chunks} chunks of the file are damaged.")


def _lower_package(text: str) -> str:
    """Package names in lower case; ROS 1 accepted capitals (`Mocap/marker_set`), the parser does not."""
    return _CAPITAL_PACKAGE.sub(lambda match: match.group().lower(), text)


def _migration(topic: Connection) -> Migration | None:
    """How its messages become those of the installed definition; None where nothing is to be done, or the definition cannot be read."""
    try:
        has_text = topic.msgdef.format is MessageDefinitionFormat.MSG
        types = get_types_from_msg(topic.msgdef.data, topic.msgtype) if has_text else {}
        _check_definitions(types, topic.topic)
    except Exception:  # A foreign definition: the parser raises almost anything. Played as it is, as before.
        return None
    return migration_of(topic.msgtype, types)


def _definitions(topic: Connection, known: Typestore) -> dict[str, Any]:
    if topic.msgdef.format is MessageDefinitionFormat.MSG:
        types = get_types_from_msg(_lower_package(topic.msgdef.data), _lower_package(topic.msgtype))
    else:
        types = jazzy_typestore().fielddefs
        if topic.msgtype not in types:
            raise ContentError(
                f"type {topic.msgtype} of topic {topic.topic} is neither described in the bag nor known; record in MCAP, which has it."
            )
    return {name: fields for name, fields in types.items() if name not in known.fielddefs}


def _check_definitions(types: dict[str, Any], topic: str) -> None:
    """Raise BagError for types that would cost without bound: recursive ones, giant arrays, arrays of what takes no byte."""
    sizes: dict[str, int] = {}
    for name in types:
        _least_size(name, types, sizes, 0, topic)
    if (total := sum(len(fields) for _, fields in types.values())) > LIMITS.FIELDS.value:
        raise BagError(f"the message types of {topic} have {total} fields, expected at most {LIMITS.FIELDS.value}; the bag is damaged.")


def _least_size(name: str, types: dict[str, Any], sizes: dict[str, int], depth: int, topic: str) -> int:
    """Least serialised size of a message [bytes]."""
    if depth > (most := LIMITS.NESTING.value):
        raise BagError(f"type {name[:100]} of {topic} is nested deeper than {most}, or contains itself; the bag is damaged.")
    if name not in sizes:
        fields = types[name][1] if name in types else ()
        sizes[name] = sum(_field_size(kind, types, sizes, depth, topic) for _, kind in fields)
    return sizes[name]


def _field_size(kind: Any, types: dict[str, Any], sizes: dict[str, int], depth: int, topic: str) -> int:
    node, argument = kind
    if node == Nodetype.BASE:
        return 1
    if node == Nodetype.NAME:
        return _least_size(argument, types, sizes, depth + 1, topic)
    element, count = argument
    size = _field_size(element, types, sizes, depth + 1, topic)
    if size == 0:
        raise BagError(f"a type of {topic} has an array of messages without content, which could be endless; the bag is damaged.")
    if node == Nodetype.SEQUENCE:
        return 4
    most = LIMITS.ARRAY.value if element[0] == Nodetype.NAME else LIMITS.MESSAGE.value
    if not 0 < count <= most or count * size > LIMITS.MESSAGE.value:
        raise BagError(f"a type of {topic} has an array of {count} elements, expected 1 to {most}; the bag is damaged.")
    return int(count * size)


def _storage_of(path: Path) -> Path:
    """A bag folder with metadata or with the files of one split recording, or a storage file. Raises BagError for no bag at `path`."""
    if not os.path.exists(path):  # unlike that of Path it raises for no name
        raise BagError(f"{path}: there is no such bag; give a bag folder or a {', '.join(SUFFIXES)} file.")
    if path.name == "metadata.yaml":
        path = path.parent
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            return path
        files = sorted(file for file in path.iterdir() if file.suffix in SUFFIXES)
        if not files:
            raise BagError(f"{path}: the folder holds no bag (no metadata.yaml, no {', '.join(SUFFIXES)} file).")
        if len(files) > 1 and len({_SPLIT.sub("", file.stem) for file in files}) > 1:
            raise BagError(f"{path}: the folder holds {len(files)} storage files and no metadata.yaml; name one of them.")
        if len(files) > 1:
            return path
        path = files[0]
    if path.suffix not in SUFFIXES:
        raise BagError(f"{path}: not the name of a bag; expected a bag folder or a {', '.join(SUFFIXES)} file.")
    return path


def _opened(path: Path, stack: ExitStack) -> OpenBag:
    storage = _storage_of(path)
    if not storage.is_dir():
        return OpenBag(path, [_reader(storage, stack)], {}, None)
    if not (storage / "metadata.yaml").exists():
        split = [file for file in storage.iterdir() if file.suffix in SUFFIXES]
        return OpenBag(path, _in_time([_reader(file, stack) for file in split]), {}, None)
    folder = read_folder(storage)
    files = folder.files
    if folder.compression == "file":
        temporary = Path(stack.enter_context(TemporaryDirectory(prefix="push_ident_")))
        files = [temporary / f"{number}{folder.suffix}" for number in range(len(folder.files))]
        for compressed, file in zip(folder.files, files, strict=True):
            uncompress_file(compressed, file)
    decompress = uncompressed_message if folder.compression == "message" else None
    return OpenBag(path, _in_time([_reader(file, stack) for file in files]), folder.promised, decompress)


def _in_time(readers: list[_Reader]) -> list[_Reader]:
    """Readers of the files of one recording in order of time: scripts that write metadata.yaml sort 10 before 2."""
    return sorted(readers, key=lambda reader: reader.start_time)


def _reader(file: Path, stack: ExitStack) -> _Reader:
    check_claims(file)
    if file.suffix == ".bag":
        return stack.enter_context(Rosbag1Reader(file))
    reader = Rosbag2Reader(file)
    if isinstance(reader.storage, Sqlite3Reader):
        # rosbags puts the path into a URI as it is.
        reader.storage.path = Path(quote(str(file)))
    return stack.enter_context(reader)


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag for reading: a folder, an MCAP or sqlite3 file, or a ROS 1 bag.

    Every failure while it is open, unexpected exceptions of the decoders included, becomes a BagError of one line.
    """
    try:
        with ExitStack() as stack:
            yield _opened(path, stack)
    except BagError as error:
        text = str(error)
        if text.startswith(str(path)):
            raise
        if isinstance(error, ContentError):
            raise ContentError(f"{path}: {text}") from None
        raise BagError(f"{path}: cannot be read ({text.rstrip('.')}){_remedy(path)}") from None
    except PushIdentError:
        raise
    except MemoryError:
        raise BagError(
            f"{path}: reading it takes more memory than there is, or than this command may take; it is damaged, or split it."
        ) from None
    except Exception as error:
        # Damaged bags make decoders and decompressors raise almost any exception (struct, overflow, recursion, database errors).
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")[:200]
        raise BagError(f"{path}: cannot be read ({type(error).__name__}: {reason}){_remedy(path)}") from error


def _remedy(path: Path) -> str:
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
