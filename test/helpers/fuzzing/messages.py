"""Messages that are nearly right: a realistic one with one to three changed fields, found by their types and names.

Numbers that are not finite, denormal, huge or negative; arrays that are empty, of another length or giant; quaternions that are no
rotation; covariances that are none; stamps from another time; text with markup, control characters, or long.
"""

from __future__ import annotations

import copy
import importlib
import math
import struct
import sys
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st
from rosidl_parser.definition import AbstractNestedType, Array, BasicType, BoundedSequence, NamespacedType

Path = tuple[str | int, ...]
"""Names of fields and numbers of elements, from the message inwards."""
INTEGERS = {f"{sign}int{n}": (0, 2**n - 1) if sign else (-(2 ** (n - 1)), 2 ** (n - 1) - 1) for sign in ("", "u") for n in (8, 16, 32, 64)}
FLOATS = {"float": (2.0 - 2.0**-22) * 2.0**127, "double": sys.float_info.max}
"""Largest finite value that a message takes back: of 32 bits rclpy compares with a number below the largest."""
SPECIAL = (math.nan, math.inf, -math.inf, -0.0, 0.0, 5e-324, 1e-310, 1e-30, -1.0, 1e6, -1e6, 1e18, 1e38, 1e300, -1e300)
SECONDS = (-(2**31), -1, 0, 1, 2**31 - 1, 10**9, 2 * 10**9)
NANOSECONDS = (0, 1, 10**9 - 1, 10**9, 2**31, 2**32 - 1)
SHIFTS = (-1e6, -3600.0, -2.0, -0.5, -1e-3, 1e-3, 0.5, 2.0, 3600.0, 1e6)
"""Of stamps [s]."""
GIANT, MANY = 1 << 15, 300
"""Elements of a giant array of numbers, and of one of messages, each of which may hold giant ones."""
TEXTS = (
    *("", " ", "table", "map", "nan", "[/x]", "[link=http://x]y[/link]", "<script>alert(1)</script>", "{{ 7 * 7 }}", "%s%s%n%d"),
    *("\x1b[31mred\x1b[0m", "\r\n\t\v\f", "\u202etfel ot thgir", "a\u0301" * 40, "\U0010ffff", "1e999", "rgb8", "16UC99999999999"),
    "<?xml version='1.0'?><!DOCTYPE a [<!ENTITY b 'c'>]><robot>&b;</robot>",
    "<robot name='r'><link name='a'/><joint name='j' type='revolute'><parent link='a'/><child link='a'/></joint></robot>",
    "A" * 100_000,
)
"""Text that displays, parsers and lookups may stumble over."""
FILE_FIELDS = ("path", "file", "bag", "filename")
"""Fields that name files: their text has no slash or dot, so that nothing outside of the folder of a node is touched."""


def message_class(namespaces: list[str], name: str) -> Any:
    """Class of an interface, as the ROS graph and the fields of messages name it; of parts of an action, too."""
    module = importlib.import_module(".".join(namespaces))
    action, _, part = name.rpartition("_")
    if namespaces[-1] != "action" or not action:
        return getattr(module, name)
    owner = getattr(module, action)
    return getattr(owner.Impl, f"{part}Service" if part in ("SendGoal", "GetResult") else part, None) or getattr(owner, part)


def leaves(msg: Any, prefix: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Path and type of every field below a message; of an array of messages the first four elements are entered."""
    for name, kind in zip(msg.get_fields_and_field_types(), msg.SLOT_TYPES, strict=True):
        yield (*prefix, name), kind
        value = getattr(msg, name)
        if isinstance(kind, NamespacedType):
            yield from leaves(value, (*prefix, name))
        elif isinstance(kind, AbstractNestedType) and isinstance(kind.value_type, NamespacedType):
            for i, element in enumerate(value[:4]):
                yield from leaves(element, (*prefix, name, i))


@st.composite
def messages_like(draw: st.DrawFn, base: Any) -> Any:
    msg = copy.deepcopy(base)
    for _ in range(draw(st.integers(1, 3))):
        fields = list(leaves(msg))
        if not fields:
            break
        # Small messages within a message count as often as its other fields: a pose is not half of all changes.
        group = draw(st.sampled_from(list(dict.fromkeys(path[0] for path, _ in fields))))
        path, kind = draw(st.sampled_from([field for field in fields if field[0][0] == group]))
        owner = msg
        for step in path[:-1]:
            owner = getattr(owner, step) if isinstance(step, str) else owner[step]
        setattr(owner, str(path[-1]), draw(values(kind, getattr(owner, str(path[-1])), str(path[-1]))))
    return msg


def values(kind: Any, value: Any, name: str) -> st.SearchStrategy[Any]:
    """Any value of a field that is of a type, has a value now, and a name."""
    if isinstance(kind, AbstractNestedType):
        return arrays(kind, value, name)
    if isinstance(kind, NamespacedType):
        fields = set(value.get_fields_and_field_types())
        return stamps(value) if fields == {"sec", "nanosec"} else quaternions(value) if fields == set("xyzw") else st.just(type(value)())
    if not isinstance(kind, BasicType):
        texts = st.sampled_from(TEXTS) | st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)
        return (
            texts.map(lambda text: "".join(c for c in text if c not in "/.~")) if name in FILE_FIELDS else texts | st.just(value + "\u00e9")
        )
    if kind.typename in FLOATS:
        return floats(value, FLOATS[kind.typename])
    if kind.typename in ("boolean", "octet"):
        return st.booleans() if kind.typename == "boolean" else st.binary(min_size=1, max_size=1)
    low, high = INTEGERS[kind.typename]
    likely = SECONDS if name == "sec" else NANOSECONDS if name == "nanosec" else (low, high, 0, 1, value - 1, value + 1, 2 * value, 65536)
    return st.sampled_from([max(low, min(high, int(number))) for number in likely]) | st.integers(low, high)


def floats(value: float, largest: float) -> st.SearchStrategy[float]:
    near = [value * factor for factor in (-1.0, 1e-6, 0.5, 2.0, 1e3, 1e9, 1.0 + 1e-9)] + [value + step for step in (-1.0, -1e-3, 0.1, 3.0)]
    drawn = st.sampled_from([*SPECIAL, *SPECIAL, largest, -largest]) | st.sampled_from(near) | st.floats()
    # Beyond the type only infinity can be held.
    return drawn.map(lambda number: number if not math.isfinite(number) else max(-largest, min(largest, number)))


@st.composite
def arrays(draw: st.DrawFn, kind: Any, value: Any, name: str) -> Any:
    """Of the same or another length; square matrices that are no covariance, or no intrinsics."""
    items = list(value.tolist() if hasattr(value, "tolist") else value)
    element = kind.value_type
    fill = message_class(element.namespaces, element.name)() if isinstance(element, NamespacedType) else (items or [default(element)])[0]
    other = messages_like(fill) if isinstance(element, NamespacedType) else values(element, fill, name)
    if isinstance(kind, Array) and len(items) in (9, 36) and draw(st.booleans()):
        return draw(matrices([float(x) for x in items], math.isqrt(len(items))))
    if isinstance(kind, Array) or (items and draw(st.booleans())):
        for i in draw(st.lists(st.integers(0, len(items) - 1), min_size=1, max_size=3)):
            items[i] = draw(other)
        return [items[0]] * len(items) if draw(st.integers(0, 4)) == 0 else items
    n = draw(st.sampled_from([0, 1, len(items) // 2, max(0, len(items) - 1), len(items) + 1, 2 * len(items), 7, 64, 1000, GIANT]))
    if isinstance(element, NamespacedType):
        n = min(n, MANY)
    extra = draw(other) if draw(st.booleans()) else fill
    longer = [*items[:n], *[extra] * (n - len(items))]
    return longer[: kind.maximum_size] if isinstance(kind, BoundedSequence) else longer


def default(element: Any) -> Any:
    """Of a type that is no message."""
    if not isinstance(element, BasicType):
        return ""
    return 0.0 if element.typename in FLOATS else {"boolean": False, "octet": b"\0"}.get(element.typename, 0)


@st.composite
def matrices(draw: st.DrawFn, flat: list[float], n: int) -> list[float]:
    """Not finite, not symmetric, indefinite, zero, huge or tiny."""
    i, j = draw(st.integers(0, n - 1)), draw(st.integers(0, n - 1))
    how = draw(st.integers(0, 4))
    if how == 0:
        return [draw(st.sampled_from(SPECIAL))] * (n * n)
    if how == 1:
        factor = draw(st.sampled_from([1e300, 1e-300, -1.0, 1e12, 0.0]))
        return [x * factor for x in flat]
    if how == 2:
        flat[i * n + i] = -abs(flat[i * n + i]) - draw(st.sampled_from([0.0, 1.0]))
    elif how == 3:  # a correlation beyond one
        flat[i * n + j] = flat[j * n + i] = 10.0 * max(abs(flat[i * n + i]), abs(flat[j * n + j]), 1e-3)
    else:
        flat[i * n + j] = draw(st.sampled_from(SPECIAL))
    return flat


def stamps(stamp: Any) -> st.SearchStrategy[Any]:
    """Shifted, or any."""

    def shifted(by: float) -> Any:
        seconds = stamp.sec + 1e-9 * stamp.nanosec + by
        whole = max(-(2**31), min(2**31 - 1, math.floor(seconds)))
        return type(stamp)(
            sec=max(whole, 0) if "uint" in stamp.get_fields_and_field_types()["sec"] else whole, nanosec=int(seconds % 1 * 1e9)
        )

    low = INTEGERS[stamp.get_fields_and_field_types()["nanosec"]]
    any_one = st.tuples(st.sampled_from([*SECONDS, stamp.sec]), st.sampled_from([min(n, low[1]) for n in NANOSECONDS]))
    return st.sampled_from(SHIFTS).map(shifted) | any_one.map(lambda pair: type(stamp)(sec=pair[0], nanosec=pair[1]))


def quaternions(turn: Any) -> st.SearchStrategy[Any]:
    """Of no length, of another length, tilted, or any."""
    now = [turn.x, turn.y, turn.z, turn.w]
    scaled = [[value * factor for value in now] for factor in (0.0, 2.0, -1.0, 1.0 + 1e-4, 1e200, 1e-200)]
    tilted = [[math.sin(0.04), 0.0, 0.0, math.cos(0.04)], [0.5, 0.5, 0.5, 0.5], [1.0, 0.0, 0.0, 0.0]]
    drawn = st.sampled_from([*scaled, *tilted]) | st.permutations(now) | st.lists(st.sampled_from(SPECIAL), min_size=4, max_size=4)
    return drawn.map(lambda parts: type(turn)(**dict(zip("xyzw", parts, strict=True))))


@st.composite
def bytes_like(draw: st.DrawFn, data: bytes) -> bytes:
    """Serialised bytes (CDR) with flipped bits, lengths that claim too much, a wrong header, or of another length.

    Never none: a message without a byte does not reach a reader of another process, and Fast DDS then holds back what the same writer
    sends later. That is the writer's loss alone.
    """
    changed, how = bytearray(data), draw(st.integers(0, 5))
    if how == 0:
        return bytes(changed[: draw(st.integers(1, len(changed)))])
    if how == 1:
        return bytes(changed) + draw(st.binary(min_size=1, max_size=100))
    if how == 2:
        return bytes(changed[:4]) + draw(st.binary(max_size=1000))
    if how == 3:
        return draw(st.binary(min_size=4, max_size=4)) + bytes(changed[4:])
    if how == 4 and len(changed) >= 8:  # lengths stand at multiples of four after the header
        for at in draw(st.lists(st.integers(1, len(changed) // 4 - 1), min_size=1, max_size=3)):
            struct.pack_into("<I", changed, 4 * at, draw(st.sampled_from([2**32 - 1, 2**31, 2**31 - 1, 2**28, 2**20, 65536, 0, 1])))
        return bytes(changed)
    for at in draw(st.lists(st.integers(0, 8 * len(changed) - 1), min_size=1, max_size=64)):
        changed[at // 8] ^= 1 << at % 8
    return bytes(changed)
