"""What every storage file of a bag gives: topics, and messages in order of time."""

from __future__ import annotations

import os
import stat
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final, Protocol

from push_ident.errors import BagError
from push_ident.limits import LIMITS

__all__ = ["Expansion", "RawMessage", "RecordedTopic", "Storage", "check_name", "open_regular"]

RawMessage = tuple[int, int, bytes | memoryview]
"""Identifier of its topic in this storage, log time [ns], serialised message."""
_FREE_EXPANSION: Final = 1_000_000_000
"""Uncompressed content that any file may have [bytes]."""
_FREE_RECORDS: Final = 1_000_000
"""Number of records that any file may have."""
_RECORD: Final = 40
"""Size of a message in a compressed file that is not smaller in the mean [bytes]; a pose takes 50."""


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A recorded topic of one publisher."""

    id: int
    topic: str
    msgtype: str
    """As `package/msg/Name`."""
    msgcount: int
    """Number of messages that the file claims to have."""
    definition: str = ""
    """Text of the message type and of those it uses; empty where the file has none."""
    encoding: str = ""
    """Of `definition`: `ros2msg` (also for ROS 1), or another."""


class Storage(Protocol):
    """A storage file that is open for reading."""

    topics: list[RecordedTopic]

    def messages(self, wanted: Collection[int]) -> Iterator[RawMessage]:
        """Messages of the topics with these identifiers, in order of log time as far as `LIMITS.OPEN_CHUNKS` allows."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


@dataclass(slots=True)
class Expansion:
    """Counts the uncompressed content of one file, and refuses a decompression bomb."""

    what: str
    file_size: int
    """[bytes]"""
    total: int = field(default=0, init=False)
    records: int = field(default=0, init=False)

    def add(self, size: int) -> None:
        """Count so many bytes; raises BagError where they are more than an honest file of this size can have."""
        self.total += size
        if self.total > _FREE_EXPANSION + LIMITS.EXPANSION.value * self.file_size:
            raise BagError(
                f"{self.what}: {LIMITS.EXPANSION.meaning} over {self.total / 1e9:.2g} GB in a file of {self.file_size / 1e6:.3g} MB, "
                f"expected at most {LIMITS.EXPANSION.value} {LIMITS.EXPANSION.unit}. Record without compression, or split the bag."
            )

    def count(self, records: int) -> None:
        """Count so many records of chunks, each of which costs time however short it is; raises BagError for too many."""
        self.records += records
        most = _FREE_RECORDS + self.file_size // _RECORD
        if self.records > most:
            raise BagError(f"{self.what}: over {self.records:,} records in a file of {self.file_size:,} bytes, expected at most {most:,}.")


def open_regular(path: Path) -> IO[bytes]:
    """Open a file for reading; raises BagError for a pipe, device or folder, which could be endless, or a file that cannot be opened."""
    try:
        # Without O_NONBLOCK, opening a pipe would wait for its writer.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise BagError(f"{path}: cannot be opened ({error.strerror}); check its name and permissions.") from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise BagError(f"{path}: not a regular file; give a bag folder or the storage file of a bag.")
    return os.fdopen(descriptor, "rb")


def check_name(text: str, what: str) -> str:
    """The name of a topic or type. Raises BagError where it is too long to be one."""
    LIMITS.STRING.check(len(text), what, error=BagError)
    return text
