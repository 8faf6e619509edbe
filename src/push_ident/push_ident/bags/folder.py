"""A bag folder of rosbag2: what its metadata.yaml says, checked."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

import yaml

from push_ident.errors import BagError
from push_ident.files import read_regular
from push_ident.limits import LIMITS

_SUFFIXES: Final = {"mcap": ".mcap", "sqlite3": ".db3"}
_VERSIONS: Final = range(1, 10)
_REMEDY: Final = "remove metadata.yaml, and name the storage file"


@dataclass(frozen=True, slots=True)
class BagFolder:
    """Storage files of one recording."""

    files: list[Path]
    """In order of time."""
    suffix: str
    """Of a storage file that is not compressed: .mcap or .db3."""
    compression: str
    """What is compressed in zstd: `file`, `message`, or empty."""
    promised: dict[str, int]
    """Number of messages by topic."""


def read_folder(folder: Path) -> BagFolder:
    """Read metadata.yaml. Raises BagError for impossible content, files outside the folder or missing, and unknown formats."""
    try:
        text = read_regular(folder / "metadata.yaml", LIMITS.METADATA.value).decode("utf-8")
        _check_depth(text)
        content = yaml.load(text, Loader=yaml.CSafeLoader)
    except (OSError, yaml.YAMLError, ValueError, OverflowError) as error:
        raise BagError(f"metadata.yaml cannot be read ({str(error).splitlines()[0][:100]}); {_REMEDY}.") from None
    information = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(information, dict):
        raise BagError(f"metadata.yaml has no `rosbag2_bagfile_information`; {_REMEDY}.")
    if (version := information.get("version")) not in _VERSIONS:
        raise BagError(f"metadata.yaml has version {str(version)[:20]}, expected 1 to {_VERSIONS[-1]}.")
    if (storage := information.get("storage_identifier")) not in _SUFFIXES:
        raise BagError(f"storage is {str(storage)[:40]!r}, expected one of {', '.join(_SUFFIXES)}.")
    return BagFolder(_files(folder, information), _SUFFIXES[storage], _compression(information), _promised(information))


def _check_depth(text: str, most: int = 32) -> None:
    """Raise BagError for a deeper nesting; rosbag2 writes 7, and the parser of libyaml ends the process at some thousands."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        # Aliases of aliases can make a document of gigabytes; recorders write none.
        if isinstance(event, yaml.AliasEvent) or depth > most:
            raise BagError(f"metadata.yaml has aliases or is nested deeper than {most}; {_REMEDY}.")


def _files(folder: Path, information: dict[str, Any]) -> list[Path]:
    names = information.get("relative_file_paths")
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        raise BagError("metadata.yaml lists no storage files in `relative_file_paths`.")
    LIMITS.FILES.check(len(names), "metadata.yaml", error=BagError)
    for name in names:
        parts = PurePosixPath(name).parts
        # Up to version 3, names began with that of the folder.
        if not 1 <= len(parts) <= 2 or name.startswith("/") or ".." in parts or "\0" in name or len(name) > LIMITS.STRING.value:
            raise BagError(f"metadata.yaml lists the storage file {name[:100]!r}, which is not in the folder; expected a bare name.")
    paths = [folder / PurePosixPath(name).name for name in names]
    if len(set(paths)) < len(paths):
        raise BagError("metadata.yaml lists a storage file twice; remove one of them.")
    if missing := [path.name for path in paths if not path.exists()]:
        raise BagError(f"storage file {missing[0]} is missing; metadata.yaml lists {len(paths)} files.")
    return paths


def _compression(information: dict[str, Any]) -> str:
    mode, form = str(information.get("compression_mode") or "").lower(), information.get("compression_format")
    if mode in ("", "none"):
        return ""
    if mode not in ("file", "message") or form != "zstd":
        raise BagError(f"compression is {mode[:20]!r} in {str(form)[:20]!r}, expected file or message in zstd.")
    return mode


def _promised(information: dict[str, Any]) -> dict[str, int]:
    promised: Counter[str] = Counter()
    topics = information.get("topics_with_message_count")
    for entry in topics if isinstance(topics, list) else ():
        match entry:
            case {"topic_metadata": {"name": str(name)}, "message_count": int(count)}:
                promised[name] += count
            case _:
                raise BagError(f"metadata.yaml has a topic without name or number of messages; {_REMEDY}.")
    return dict(promised)
