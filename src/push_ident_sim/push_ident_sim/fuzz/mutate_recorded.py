"""Mutations of the messages of a bag: their fields, times, order, topics and types."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from push_ident.bags.contract import role_of
from push_ident.bags.typestore import jazzy_typestore
from push_ident_sim.fuzz.bag_sources import Message

__all__ = ["MUTATIONS"]

_FLOATS: Final = (0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e-300, 1e300, -1e300, 1e9, 1e3, -1.0, 1e-9)
_FACTORS: Final = (-1.0, 0.0, 0.5, 2.0, 10.0, 1e3, 1e6, 1e-3)
_INTEGERS: Final = (0, 1, -1, 2, 127, 255, 65535, 10_000, 10**6, 2**31 - 1, -(2**31), 2**32 - 1, 2**63 - 1)
_STRINGS: Final = ("", "x" * 5000, "[/x]", "[bold]", "<b>&", "../../x", "a\nb", "\x1b[31m", "\u202etable", "o1", "0", "base_link", "'\"")
_TOPICS: Final = ("/objects/[x]/pose", "/objects/2/cells", "/b/pusher/pose", "/x", "/objects/<b>/outline", "pusher/pose", "/push_record")
_SECOND: Final = 10**9
_MOST_ADDED: Final = 500_000_000
"""Content of added messages; compressed to a tenth, as depth images are, the bag stays below the 100 MB that limits are for [bytes]."""

Place = tuple[Any, Any]
"""A container and the name, or number, of one value in it."""


def _get(place: Place) -> Any:
    container, key = place
    return getattr(container, key) if isinstance(key, str) else container[key]


def _set(place: Place, value: Any) -> None:
    container, key = place
    if isinstance(key, str):
        object.__setattr__(container, key, value)
    else:
        container[key] = value


def _places(container: Any) -> list[Place]:
    """All values below a message that are no messages: numbers, strings and arrays."""
    found: list[Place] = []
    keys: Any = (
        [f.name for f in fields(container) if f.name != "__msgtype__"] if is_dataclass(container) else range(min(len(container), 50))
    )
    for key in keys:
        value = _get((container, key))
        if is_dataclass(value) or (isinstance(value, list) and value and is_dataclass(value[0])):
            found += _places(value)
        if not is_dataclass(value):
            found.append((container, key))
    return found


def _changed(value: Any, rng: Generator) -> Any:
    if isinstance(value, str):
        return str(rng.choice(_STRINGS))
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return int(rng.choice(_INTEGERS)) if rng.random() < 0.8 else value + 1
    if isinstance(value, float):
        return float(rng.choice(_FLOATS)) if rng.random() < 0.6 else value * float(rng.choice(_FACTORS))
    if isinstance(value, np.ndarray):
        return _changed_array(value, rng)
    return _resized(value, rng)


def _changed_array(value: np.ndarray[Any, Any], rng: Generator) -> np.ndarray[Any, Any]:
    if not len(value):
        return value
    value = value.copy()
    where = slice(None) if rng.random() < 0.3 else int(rng.integers(len(value)))
    with np.errstate(all="ignore"):
        if value.dtype.kind == "f":
            value[where] = value[where] * rng.choice(_FACTORS) if rng.random() < 0.4 else rng.choice(_FLOATS)
        else:
            limits = np.iinfo(value.dtype)
            value[where] = rng.choice([limits.min, limits.max, 0, 1, 100 % (int(limits.max) + 1)])
    return value


def _resized(value: list[Any], rng: Generator) -> list[Any]:
    size = int(rng.choice([0, 1, 2, len(value) + 1, 10 * len(value), 5000]))
    order = rng.permutation(len(value)) if rng.random() < 0.3 else np.arange(len(value))
    return [value[order[k % len(value)]] for k in range(size)] if value else value


def _edit(message: Message, change: Callable[[Any], None]) -> None:
    """Change a message; one whose new values its type cannot hold stays as it is."""
    store = jazzy_typestore()
    try:
        content = store.deserialize_cdr(message.data, message.msgtype)
        change(content)
        with np.errstate(all="ignore"):
            message.data = bytes(store.serialize_cdr(content, message.msgtype))
    except Exception:
        # The encoder raises any exception for values out of the range of their fields.
        return


def _some(messages: list[Message], rng: Generator) -> list[Message]:
    """One message, some, or all of one topic."""
    topics = sorted({message.topic for message in messages})
    if not topics:
        return []
    topic = str(rng.choice(topics))
    own = [message for message in messages if message.topic == topic]
    share = float(rng.choice([0.0, 0.1, 1.0], p=[0.4, 0.2, 0.4]))
    return [m for m in own if rng.random() < share] or [own[int(rng.integers(len(own)))]]


def _change_field(messages: list[Message], rng: Generator) -> None:
    """The same field of some messages of a topic."""
    chosen = _some(messages, rng)
    which, seed = rng.random(), int(rng.integers(1 << 31))
    for message in chosen:

        def change(content: Any) -> None:
            places = _places(content)
            place = places[int(which * len(places))]
            _set(place, _changed(_get(place), np.random.default_rng(seed)))

        _edit(message, change)


def _scale_lengths(messages: list[Message], rng: Generator) -> None:
    """All numbers of one latched message or one topic by one factor."""
    factor = float(rng.choice(_FACTORS))

    def change(content: Any) -> None:
        for place in _places(content):
            if isinstance(_get(place), float):
                _set(place, _get(place) * factor)

    for message in _some(messages, rng):
        _edit(message, change)


def _giant_grid(messages: list[Message], rng: Generator) -> None:
    """A grid of many cells, with or without its data."""
    width, height = int(rng.choice([100, 1000, 2000, 65535, 2**31])), int(rng.choice([10, 100, 1000, 2**31]))
    value = int(rng.choice([100, 0, 100, -1]))

    def change(content: Any) -> None:
        content.info.width, content.info.height = width, height
        if width * height <= 4_000_000 and rng.random() < 0.8:
            content.data = np.full(width * height, value, dtype=np.int8)
        content.info.resolution = float(rng.choice([content.info.resolution, 1e-3, 1e-6, 10.0]))

    for message in messages:
        if message.msgtype == "nav_msgs/msg/OccupancyGrid":
            _edit(message, change)


def _giant_outline(messages: list[Message], rng: Generator) -> None:
    """An outline of many vertices: a circle, a star that crosses itself, noise."""
    n = int(rng.choice([3, 5, 500, 1999, 5000, 100_000]))
    step = int(rng.choice([1, 1, 2, 7]))
    angle = 2 * np.pi * step * np.arange(n) / n
    radius = float(rng.choice([0.05, 1e-6, 1.0, 50.0])) * (1 + float(rng.choice([0, 0.3])) * rng.random(n))

    def change(content: Any) -> None:
        point = type(content.polygon.points[0])
        content.polygon.points = [point(float(r * np.cos(a)), float(r * np.sin(a)), 0.0) for r, a in zip(radius, angle, strict=True)]

    for message in messages:
        if message.msgtype == "geometry_msgs/msg/PolygonStamped":
            _edit(message, change)


def _shift_stamps(messages: list[Message], rng: Generator) -> None:
    """Header stamps, log times, or both, of some messages: a shift, a stretch, all the same, or zero."""
    chosen = _some(messages, rng)
    kind = str(rng.choice(["shift", "stretch", "same", "zero", "century"]))
    shift = int(rng.choice([-1, 1, 60, 3600, 10**6, -(10**6)])) * _SECOND
    start = min(message.stamp_ns for message in chosen) if chosen else 0

    def moved(stamp: int) -> int:
        within = stamp - start
        return {"shift": stamp + shift, "stretch": start + 1000 * within, "same": start, "zero": 0, "century": stamp + within * 10**7}[kind]

    def change(content: Any) -> None:
        stamp = content.header.stamp if hasattr(content, "header") else content.start
        now = moved(stamp.sec * _SECOND + stamp.nanosec)
        stamp.sec, stamp.nanosec = divmod(now, _SECOND)

    logged, stamped = rng.random() < 0.6, rng.random() < 0.6
    for message in chosen:
        if logged:
            message.stamp_ns = moved(message.stamp_ns)
        if stamped:
            _edit(message, change)


def _drop(messages: list[Message], rng: Generator) -> None:
    gone = {id(message) for message in _some(messages, rng)}
    messages[:] = [message for message in messages if id(message) not in gone]


def _duplicate(messages: list[Message], rng: Generator) -> None:
    times = int(rng.choice([1, 10, 500]))
    extra = _some(messages, rng)[: max(1, 20_000 // times)]
    while times * sum(len(m.data) for m in extra) > _MOST_ADDED:
        extra = extra[: len(extra) // 2]
    messages += [Message(m.topic, m.msgtype, m.stamp_ns, m.data) for _ in range(times) for m in extra]


def _reorder(messages: list[Message], rng: Generator) -> None:
    messages[:] = [messages[k] for k in rng.permutation(len(messages))]


def _swap_times(messages: list[Message], rng: Generator) -> None:
    chosen = _some(messages, rng)
    for message, k in zip(chosen, rng.permutation(len(chosen)), strict=True):
        message.stamp_ns = chosen[k].stamp_ns


def _rename(messages: list[Message], rng: Generator) -> None:
    topics = sorted({message.topic for message in messages})
    new = str(rng.choice([*_TOPICS, *topics])) if rng.random() < 0.7 else "/objects/" + str(rng.choice(_STRINGS))[:200] + "/pose"
    for message in _some(messages, rng):
        message.topic = new


def _many_objects(messages: list[Message], rng: Generator) -> None:
    n = int(rng.choice([3, 60, 1000]))
    own = [m for m in messages if (role := role_of(m.topic)) and role.object_id][:300]
    for k in range(n):
        some = own if n == 3 else own[:3]
        messages += [Message(m.topic.replace("/objects/", f"/objects/x{k}"), m.msgtype, m.stamp_ns, m.data) for m in some]


def _retype(messages: list[Message], rng: Generator) -> None:
    kinds = sorted({message.msgtype for message in messages} | {"std_msgs/msg/String", "sensor_msgs/msg/PointCloud2"})
    new = str(rng.choice(kinds))
    for message in _some(messages, rng):
        message.msgtype = new


def _spoil(messages: list[Message], rng: Generator) -> None:
    """Bytes of serialised messages: changed, cut, or a length that claims all."""
    for message in _some(messages, rng):
        data = bytearray(message.data)
        if not data:
            continue
        at = int(rng.integers(len(data)))
        kind = int(rng.integers(4))
        if kind == 0:
            data[at] = int(rng.integers(256))
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            at &= ~3
            data[at : at + 4] = int(rng.choice([0, 1, 2**16, 2**28, 2**31 - 1, 2**32 - 1])).to_bytes(4, "little")
        else:
            data += bytes(int(rng.choice([1, 4, 1000, 2_000_000])))
        message.data = bytes(data)


MUTATIONS: Final[dict[str, Callable[[list[Message], Generator], None]]] = {
    "field": _change_field,
    "another field": _change_field,
    "fields": _change_field,
    "lengths": _scale_lengths,
    "grid": _giant_grid,
    "outline": _giant_outline,
    "stamps": _shift_stamps,
    "more stamps": _shift_stamps,
    "drop": _drop,
    "duplicate": _duplicate,
    "reorder": _reorder,
    "swap times": _swap_times,
    "rename": _rename,
    "objects": _many_objects,
    "retype": _retype,
    "spoil": _spoil,
}
