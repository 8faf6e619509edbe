"""Serialised messages of a bag, for playing them on live topics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from push_ident.bags.contract import Role
from push_ident.bags.decode import depth_of
from push_ident.bags.opening import open_bag
from push_ident.bags.read_options import ReadOptions, message_types
from push_ident.bags.typestore import jazzy_typestore
from push_ident.errors import BagError, FrameError


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


def options_for(path: Path, options: ReadOptions) -> ReadOptions:
    """As `options.with_camera_info` of the bag. Raises BagError when there is no such bag."""
    with open_bag(path) as bag:
        return options.with_camera_info(bag)


def raw_messages(path: Path, options: ReadOptions | None = None) -> Iterator[RawMessage]:
    """All messages in order of log time, one at a time. Raises BagError, also for ROS 1 bags, which have another serialisation.

    With `options`, depth images that are compressed or of another unit come as those of the contract, in metres.
    """
    with open_bag(path) as bag:
        for c, stamp, data in bag.raw_messages():
            role = options.role_of(c.topic) if options else None
            is_depth = role is not None and role.role is Role.DEPTH and c.msgtype in message_types(Role.DEPTH)
            if is_depth and options and (options.depth_unit or c.msgtype != Role.DEPTH.msgtype):
                yield RawMessage(c.topic, Role.DEPTH.msgtype, stamp, _in_metres(data, c.msgtype, options.depth_unit))
            else:
                yield RawMessage(c.topic, c.msgtype, stamp, bytes(data))


def _in_metres(data: bytes, msgtype: str, unit: float | None) -> bytes:
    """A depth image (CDR) as Image of metres; one that cannot be used has no pixels, and whoever gets it refuses it."""
    store = jazzy_typestore()
    image = store.deserialize_cdr(data, msgtype)
    try:
        pixels = depth_of(image, unit).astype("<f4")
    except FrameError:
        pixels = np.zeros((0, 0), dtype="<f4")
    height, width = pixels.shape
    fields = height, width, "32FC1", 0, 4 * width, np.frombuffer(pixels.tobytes(), dtype=np.uint8)
    played = store.types[Role.DEPTH.msgtype](image.header, *fields)  # type: ignore[attr-defined]
    return bytes(store.serialize_cdr(played, Role.DEPTH.msgtype))
