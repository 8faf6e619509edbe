"""A bag folder with metadata.yaml as a storage: one or more storage files, compressed or not."""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

import yaml

from push_ident.bags.storage.chunks import decompressed, zstd_decompressor
from push_ident.bags.storage.mcap_storage import McapStorage
from push_ident.bags.storage.sqlite_storage import SqliteStorage
from push_ident.bags.storage.storage import Expansion, RawMessage, RecordedTopic, Storage, check_name, open_regular
from push_ident.errors import BagError
from push_ident.limits import LIMITS

__all__ = ["FolderStorage", "read_metadata"]

_FORMATS: Final[dict[str, type[McapStorage] | type[SqliteStorage]]] = {"mcap": McapStorage, "sqlite3": SqliteStorage}
_VERSIONS: Final = range(1, 10)
_DEPTH: Final = 32
"""Deepest nesting of metadata.yaml; rosbag2 writes 7. The parser of libyaml ends the process at some thousands."""
_BLOCK: Final = 1 << 20


class FolderStorage:
    """A bag folder that is open for reading. Raises BagError for a folder that is damaged or names files outside of it."""

    def __init__(self, folder: Path) -> None:
        information = read_metadata(folder / "metadata.yaml")
        self._by_message = _compression(information) == "message"
        self._storages: list[Storage] = []
        self._stack = ExitStack()
        try:
            for path in self._storage_files(folder, information):
                storage = _FORMATS[information["storage_identifier"]](path)
                self._stack.callback(storage.close)
                self._storages.append(storage)
        except BaseException:
            self._stack.close()
            raise
        self.topics = self._all_topics(_promised(information))

    def close(self) -> None:
        """Close all files, and remove what was uncompressed."""
        self._stack.close()

    def messages(self, wanted: Collection[int]) -> Iterator[RawMessage]:
        """Messages of these topics, file after file, each in order of log time."""
        for storage, numbers in zip(self._storages, self._numbers, strict=True):
            chosen = [inner for inner, number in numbers.items() if number in wanted]
            for inner, time, data in storage.messages(chosen) if chosen else ():
                yield numbers[inner], time, decompressed(data, "zstd") if self._by_message else data

    def _storage_files(self, folder: Path, information: dict[str, Any]) -> list[Path]:
        paths = [_inside(folder, name) for name in information["relative_file_paths"]]
        if len(set(paths)) < len(paths):
            raise BagError("metadata.yaml lists a storage file twice; remove one of them.")
        if missing := [path.name for path in paths if not path.exists()]:
            raise BagError(f"storage file {missing[0]} is missing; metadata.yaml lists {len(paths)} files.")
        if _compression(information) != "file":
            return paths
        temporary = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="push_ident_")))
        return [_uncompressed(path, temporary / f"{number}_{path.stem}") for number, path in enumerate(paths)]

    def _all_topics(self, promised: dict[str, int]) -> list[RecordedTopic]:
        """Topics of all files; one that metadata.yaml promises more messages of keeps that number, so that what lacks is noticed."""
        merged: dict[tuple[str, str], RecordedTopic] = {}
        self._numbers: list[dict[int, int]] = []
        for storage in self._storages:
            numbers = {}
            for topic in storage.topics:
                known = merged.setdefault((topic.topic, topic.msgtype), replace(topic, id=len(merged), msgcount=0))
                merged[topic.topic, topic.msgtype] = replace(
                    known,
                    msgcount=known.msgcount + topic.msgcount,
                    definition=known.definition or topic.definition,
                    encoding=known.encoding or topic.encoding,
                )
                numbers[topic.id] = known.id
            self._numbers.append(numbers)
            LIMITS.TOPICS.check(len(merged), "the bag", error=BagError)
        counts: dict[str, int] = defaultdict(int)
        for topic in merged.values():
            counts[topic.topic] += topic.msgcount
        # Several publishers of one topic share its number in metadata.yaml.
        return [replace(t, msgcount=t.msgcount + max(0, promised.get(t.topic, 0) - counts.pop(t.topic, 1 << 63))) for t in merged.values()]


def read_metadata(path: Path) -> dict[str, Any]:
    """The checked content of a metadata.yaml. Raises BagError for another content, or one of impossible size or depth."""
    with open_regular(path) as file:
        raw = file.read(LIMITS.METADATA.value + 1)
    LIMITS.METADATA.check(len(raw), path.name, error=BagError)
    try:
        text = raw.decode("utf-8")
        _check_depth(text)
        content = yaml.load(text, Loader=yaml.CSafeLoader)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise BagError(
            f"metadata.yaml cannot be read ({str(error).splitlines()[0][:100]}); remove it, and name the storage file."
        ) from None
    information = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(information, dict):
        raise BagError("metadata.yaml has no `rosbag2_bagfile_information`; remove it, and name the storage file.")
    if (version := information.get("version")) not in _VERSIONS:
        raise BagError(f"metadata.yaml has version {str(version)[:20]}, expected 1 to {_VERSIONS[-1]}.")
    if information.get("storage_identifier") not in _FORMATS:
        raise BagError(f"storage is {str(information.get('storage_identifier'))[:40]!r}, expected one of {', '.join(_FORMATS)}.")
    names = information.get("relative_file_paths")
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        raise BagError("metadata.yaml lists no storage files in `relative_file_paths`.")
    LIMITS.FILES.check(len(names), path.name, error=BagError)
    return information


def _check_depth(text: str) -> None:
    depth = 0
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        if isinstance(event, yaml.AliasEvent):
            # Aliases of aliases can make a document of gigabytes; recorders write none.
            raise BagError("metadata.yaml refers to itself by aliases, which recorders never write; remove it, and name the storage file.")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEPTH:
            raise BagError(f"metadata.yaml is nested deeper than {_DEPTH}; remove it, and name the storage file.")


def _compression(information: dict[str, Any]) -> str:
    """`file`, `message`, or empty."""
    mode = str(information.get("compression_mode") or "").lower()
    if mode in ("", "none"):
        return ""
    if mode not in ("file", "message") or information.get("compression_format") != "zstd":
        raise BagError(
            f"compression is {mode[:20]!r} in {str(information.get('compression_format'))[:20]!r}, expected file or message in zstd."
        )
    return mode


def _promised(information: dict[str, Any]) -> dict[str, int]:
    """Number of messages by topic."""
    topics = information.get("topics_with_message_count")
    promised: dict[str, int] = defaultdict(int)
    for entry in topics if isinstance(topics, list) else ():
        metadata = entry.get("topic_metadata") if isinstance(entry, dict) else None
        if not (isinstance(metadata, dict) and isinstance(metadata.get("name"), str) and isinstance(entry.get("message_count"), int)):
            raise BagError("metadata.yaml has a topic without name or number of messages; remove it, and name the storage file.")
        promised[check_name(metadata["name"], "a topic")] += entry["message_count"]
    return promised


def _inside(folder: Path, name: str) -> Path:
    """Path of a storage file. Up to version 3, names began with that of the folder."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or len(parts) > 2 or "\0" in name or len(name) > LIMITS.STRING.value:
        raise BagError(f"metadata.yaml lists the storage file {name[:100]!r}, which is not in the folder; expected a bare name.")
    return folder / parts[-1]


def _uncompressed(path: Path, target: Path) -> Path:
    """Uncompress a storage file to `target`."""
    with open_regular(path) as file, target.open("xb") as out:
        expansion = Expansion(path.name, path.stat().st_size)
        decompressor = zstd_decompressor()
        while not decompressor.eof:
            block = file.read(_BLOCK) if decompressor.needs_input else b""
            if decompressor.needs_input and not block:
                raise BagError(f"{path.name} is cut short.")
            data = decompressor.decompress(block, max_length=_BLOCK)
            expansion.add(len(data))
            out.write(data)
    return target
