"""Serialised messages of a bag, for playing them on live topics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from push_ident.bags.opening import open_bag
from push_ident.errors import BagError


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One recorded message."""

    topic: str
    msgtype: str
    stamp_ns: int
    """Log time [ns]."""
    data: bytes
    """CDR, with its encapsulation header."""


def bag_topics(path: Path) -> dict[str, str]:
    """Message type of every topic that has messages. Raises BagError when there is no such bag, or it has none."""
    with open_bag(path) as bag:
        topics = {c.topic: c.msgtype for c in bag.topics if c.msgcount}
    if not topics:
        raise BagError(f"{path}: the bag holds no message; record again, or recover the original with `push-ident salvage`.")
    return topics


def raw_messages(path: Path) -> Iterator[RawMessage]:
    """All messages in order of log time, one at a time. Raises BagError, also for ROS 1 bags, which have another serialisation."""
    with open_bag(path) as bag:
        yield from (RawMessage(c.topic, c.msgtype, stamp, bytes(data)) for c, stamp, data in bag.raw_messages())
