"""A sqlite3 file of rosbag2 as a storage.

Rows are counted against the size of the file: in a damaged one, pages can be their own children, and a table has no end. A view, a virtual
table or a computed column could be a program without end, so only plain tables are read.
"""

from __future__ import annotations

import os
import sqlite3
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np

from push_ident.bags.storage.storage import RawMessage, RecordedTopic, check_name, open_regular
from push_ident.errors import BagError
from push_ident.limits import LIMITS

__all__ = ["SqliteStorage"]

_ROW: Final = 12
"""Least size of a row of `messages` in the file, with its page's share [bytes]."""
_STEPS_PER_BYTE: Final = 4
"""Steps of the database's machine for one byte of the file: a row takes some ten."""
_FREE_STEPS: Final = 10_000_000
_STEPS: Final = 100_000
"""Steps between two looks at their number."""


class SqliteStorage:
    """A sqlite3 file that is open for reading. Raises BagError for a file that is damaged or is no bag."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with open_regular(path) as file:
            self._size = os.fstat(file.fileno()).st_size
        for suffix in ("-wal", "-journal"):
            beside = path.with_name(path.name + suffix)
            if beside.is_file() and beside.stat().st_size:
                raise BagError(
                    f"messages are still in {beside.name}, as the recorder was killed; move them into the bag with "
                    f'`sqlite3 {path.name} "PRAGMA wal_checkpoint(TRUNCATE)"`.'
                )
        # Immutable: the file may be on a read-only disk, and nothing is ever written beside it.
        self._database = sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True, check_same_thread=False)
        try:
            self._open()
        except BaseException:
            self._database.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def messages(self, wanted: Collection[int]) -> Iterator[RawMessage]:
        """Messages of these topics, in order of log time."""
        chosen = np.flatnonzero(np.isin(self._topic_ids, np.array(sorted(wanted), dtype=np.int64)))
        for k in chosen[np.argsort(self._times[chosen], kind="stable")].tolist():
            row = self._database.execute("SELECT data FROM messages WHERE rowid = ?", (int(self._rows[k]),)).fetchone()
            if row is None or not isinstance(row[0], bytes):
                raise BagError(
                    f"message {self._rows[k]} is {type(row[0]).__name__ if row else 'missing'}, expected bytes; the file is damaged."
                )
            yield int(self._topic_ids[k]), int(self._times[k]), row[0]

    def _open(self) -> None:
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LIMITS.MESSAGE.value)
        self._database.execute("PRAGMA trusted_schema = OFF")
        steps = iter(range((_FREE_STEPS + _STEPS_PER_BYTE * self._size) // _STEPS))
        # A true result interrupts the statement.
        self._database.set_progress_handler(lambda: next(steps, None) is None, _STEPS)
        columns = {table: self._plain_columns(table) for table in ("topics", "messages", "message_definitions")}
        for table, needed in (("topics", {"id", "name", "type", "serialization_format"}), ("messages", {"topic_id", "timestamp", "data"})):
            if missing := needed - columns[table]:
                raise BagError(f"table `{table}` lacks {', '.join(sorted(missing))}; not a bag of rosbag2, or it is damaged.")
        counts = self._read_index()
        definitions = self._definitions() if columns["message_definitions"] else {}
        self.topics: list[RecordedTopic] = [self._topic(row, counts, definitions) for row in self._topic_rows()]
        # What is read from here on is bounded by the index.
        self._database.set_progress_handler(None, 0)

    def _plain_columns(self, table: str) -> frozenset[str]:
        """Names of the stored columns of a plain table; empty where there is no such table."""
        found = self._database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchmany(2)
        if not found:
            return frozenset()
        kind, text = found[0]
        if len(found) > 1 or kind != "table" or "VIRTUAL" in str(text)[:40].upper():
            raise BagError(f"`{table}` is a {kind} that computes its rows, expected a plain table; not a bag of rosbag2.")
        rows = self._database.execute(f"PRAGMA table_xinfo({table})").fetchmany(100)
        return frozenset(str(name) for _, name, _, _, _, _, hidden in rows if not hidden)

    def _read_index(self) -> Counter[int]:
        """Read row, topic and time of every message; returns the number of messages by topic."""
        rows, topics, times = array("q"), array("q"), array("q")
        most = self._size // _ROW
        for row, topic, time in self._database.execute("SELECT rowid, topic_id, timestamp FROM messages NOT INDEXED"):
            if len(rows) >= most:
                raise BagError(f"more than {most} messages in a file of {self._size} bytes; its pages are linked in a circle.")
            if not (isinstance(topic, int) and isinstance(time, int)):
                raise BagError(
                    f"message {row} has topic {str(topic)[:20]!r} and time {str(time)[:20]!r}, expected integers; the file is damaged."
                )
            rows.append(row)
            topics.append(topic)
            times.append(time)
        self._rows, self._topic_ids, self._times = (
            np.frombuffer(a, dtype=np.int64) if a else np.empty(0, np.int64) for a in (rows, topics, times)
        )
        return Counter(topics)

    def _topic_rows(self) -> list[tuple[Any, ...]]:
        rows = self._database.execute("SELECT id, name, type, serialization_format FROM topics").fetchmany(LIMITS.TOPICS.value + 1)
        LIMITS.TOPICS.check(len(rows), "the file", error=BagError)
        return rows

    def _topic(self, row: tuple[Any, ...], counts: Counter[int], definitions: dict[str, tuple[str, str]]) -> RecordedTopic:
        identifier, name, msgtype, serialization = row
        if not (isinstance(identifier, int) and isinstance(name, str) and isinstance(msgtype, str)):
            raise BagError("table `topics` has a row without number, name or type; the file is damaged.")
        if serialization != "cdr":
            raise BagError(f"topic {name[:100]} is serialised as {str(serialization)[:40]!r}, expected 'cdr'.")
        encoding, text = definitions.get(msgtype, ("", ""))
        return RecordedTopic(
            identifier, check_name(name, "a topic"), check_name(msgtype, "a message type"), counts[identifier], text, encoding
        )

    def _definitions(self) -> dict[str, tuple[str, str]]:
        """Encoding and text of the message definitions, by type."""
        rows = self._database.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        found: dict[str, tuple[str, str]] = {}
        for name, encoding, text in rows.fetchmany(LIMITS.TOPICS.value):
            LIMITS.SCHEMA.check(len(text), str(name)[:100], error=BagError)
            found[str(name)] = (str(encoding), str(text))
        return found
