"""Structure-aware mutation of any ROS message, and of its serialised bytes.

A mutation changes one to three fields of a realistic message, found by their types and names: numbers that are not finite, denormal, huge
or negative; arrays that are empty, of another length or giant; sizes that contradict each other; quaternions that are no rotation;
covariances that are none; stamps from another time; frames and encodings of something else; text with markup, control characters, or long.
"""

from __future__ import annotations

import copy
import math
import random
import struct
from collections.abc import Callable, Sequence
from typing import Any, Final

from push_ident_sim.fuzz.fields import FLOATS, INTEGERS, FieldType, Path, field_types, get_at, leaves, make_default, set_at

__all__ = ["PATH_FIELDS", "TEXTS", "mutate_bytes", "mutate_message"]

_MAX_EDITS: Final = 3
_GIANT: Final = 1 << 20
"""Elements of a giant array of numbers."""
_MANY: Final = 1500
"""Elements of a giant array of messages: each costs some microseconds to read."""
PATH_FIELDS: Final = frozenset({"path", "file", "bag", "filename"})
"""Fields that name files: they get text without a slash or dots in front, so that nothing outside of the sandbox is touched."""
TEXTS: Final = (
    "",
    " ",
    "table",
    "object_o1",
    "map",
    "camera_depth_optical_frame",
    "nan",
    "[/x]",
    "[bold red]",
    "[link=http://x]y[/link]",
    "<script>alert(1)</script>",
    "<b>&amp;",
    "{{ 7 * 7 }}",
    "${HOME}",
    "%s%s%n%d",
    "{0}{name}",
    "';--",
    "\x1b[31mred\x1b[0m",
    "\x1b]0;title\x07",
    "\r\n\t\v\f",
    "line\nline",
    "\x7f\x01\x02",
    "\u202etfel ot thgir",
    "\u00e9\u4e2d\u6587\U0001f600",
    "a\u0301" * 40,
    "\ufeff\u200b\ufffd",
    "\U0010ffff",
    "-1",
    "1e999",
    "#",
    ":",
    "rgb8",
    "mono16",
    "16UC1",
    "32FC1",
    "64FC1",
    "bayer_rggb8",
    "16UC99999999999",
    "<robot/>",
    "<?xml version='1.0'?><!DOCTYPE a [<!ENTITY b 'c'>]><robot>&b;</robot>",
    "<robot name='r'><link name='a'/><joint name='j' type='revolute'><parent link='a'/><child link='a'/></joint></robot>",
)
"""Text that displays, parsers and lookups may stumble over."""
_LONG: Final = (300, 5_000, 100_000, 1_000_000)
_FLOATS: Final = (math.nan, math.inf, -math.inf, -0.0, 0.0, 5e-324, -5e-324, 1e-310, 1e-30, 1e6, -1e6, 1e18, -1e18, 1e38, 1e300, -1e300)
_SECONDS: Final = (-(2**31), -1, 0, 1, 2**31 - 1, 10**9, 2 * 10**9)
_NANOSECONDS: Final = (0, 1, 10**9 - 1, 10**9, 2**31, 2**32 - 1)
_SHIFTS: Final = (-1e6, -3600.0, -10.0, -2.0, -0.5, -1e-3, 1e-3, 0.5, 2.0, 10.0, 3600.0, 1e6)
"""Of stamps [s]."""
_COUNTS: Final = (0, 1, 2, 3, 7, 8, 9, 64, 1000)


def mutate_message(msg: Any, rng: random.Random) -> tuple[Any, list[Path]]:
    """A copy of a message with one to three changes, and the paths of the changed fields."""
    mutated = copy.deepcopy(msg)
    changed: list[Path] = []
    for _ in range(rng.choice((1, 1, 1, 2, _MAX_EDITS))):
        candidates = list(leaves(mutated))
        if not candidates:
            break
        # Small messages within a message count as often as its other fields: a pose is not half of all edits.
        groups = sorted({path[0] for path, _ in candidates}, key=str)
        group = rng.choice(groups)
        path, kind = rng.choice([(path, kind) for path, kind in candidates if path[0] == group])
        set_at(mutated, path, _other_value(get_at(mutated, path), path, kind, rng))
        changed.append(path)
    return mutated, changed


def _other_value(value: Any, path: Path, kind: FieldType, rng: random.Random) -> Any:
    if kind.is_array:
        return _other_array(value, path, kind, rng)[: kind.bound]
    if not kind.is_message:
        return _other_primitive(value, path, kind.element, rng)
    for names, change in _STRUCTURES:
        if names == set(field_types(value)):
            return change(value, rng)
    return make_default(kind.element)


# ---- primitives


def _other_primitive(value: Any, path: Path, element: str, rng: random.Random) -> Any:
    if element == "bool":
        return not value
    if element == "string":
        return _other_text(value, path, rng)
    if element in FLOATS:
        return _other_float(value, FLOATS[element], rng)
    if element == "octet":
        return bytes([rng.randrange(256)])
    return _other_integer(value, path, element, rng)


def _other_float(value: float, largest: float, rng: random.Random) -> float:
    value = float(value)
    new = rng.choice(
        (
            rng.choice(_FLOATS),
            rng.choice(_FLOATS),
            value * rng.choice((-1.0, 1e-6, 0.5, 2.0, 1e3, 1e9, 1.0 + 1e-9)),
            value + rng.choice((-1.0, -1e-3, 1e-9, 0.1, 3.0)),
            rng.choice((largest, -largest)),
        )
    )
    # Beyond the type only infinity can be held.
    return new if not math.isfinite(new) else max(-largest, min(largest, new))


def _other_integer(value: int, path: Path, element: str, rng: random.Random) -> int:
    low, high = INTEGERS[element]
    value = int(value)
    if path[-1] == "nanosec":
        choices: Sequence[int] = _NANOSECONDS
    elif path[-1] == "sec":
        choices = (*_SECONDS, value - 1, value + 1, value + 100)
    else:
        choices = (low, high, 0, 1, low + 1, high - 1, value - 1, value + 1, 2 * value, -value, value ^ 1, 1 << rng.randrange(31), 65536)
    return max(low, min(high, rng.choice(choices)))


def _other_text(value: str, path: Path, rng: random.Random) -> str:
    if path[-1] in PATH_FIELDS:
        return "".join(c for c in rng.choice(TEXTS) if c not in "/.~\0")
    how = rng.randrange(10)
    if how < 7 or not value:
        return rng.choice(TEXTS)
    if how == 7:
        return value + rng.choice(TEXTS)
    if how == 8:
        at = rng.randrange(len(value))
        return value[:at] + rng.choice(("", "\x00", "\u00e9", value)) + value[at + 1 :]
    return rng.choice("A\u00e9[<") * rng.choice(_LONG[: 4 if rng.randrange(20) == 0 else 3])


# ---- arrays


def _other_array(value: Any, path: Path, kind: FieldType, rng: random.Random) -> Any:
    # `tolist`, as a message refuses the integers of numpy.
    plain = value.tolist if hasattr(value, "tolist") else lambda: list(value)
    items = plain() if len(value) < 4096 or kind.size is not None else value
    if kind.size is not None or (len(items) and rng.randrange(2)):
        return _other_elements(items, path, kind, rng)
    how = rng.randrange(8)
    if how == 0 or (how in (1, 2) and not len(items)):
        return []
    if how == 1:
        return items[:-1]
    if how == 2:
        return items[: len(items) // 2]
    if how == 3:
        return list(reversed(items))
    if how == 4:
        return [_fill(kind, path, rng)] * rng.choice(_COUNTS)
    if how == 5 and rng.randrange(8) == 0:
        return _giant(kind, path, rng)
    extra = items[-1] if len(items) else _fill(kind, path, rng)
    return [*items, *[extra] * rng.choice((1, 1, 2, 50))]


def _fill(kind: FieldType, path: Path, rng: random.Random) -> Any:
    """An element that differs from the default."""
    default = make_default(kind.element)
    if kind.is_message:
        return mutate_message(default, rng)[0]
    return _other_primitive(default, path, kind.element, rng)


def _giant(kind: FieldType, path: Path, rng: random.Random) -> Any:
    if kind.is_number:
        return [_fill(kind, path, rng)] * (_GIANT // rng.choice((1, 4, 16)))
    return [_fill(kind, path, rng)] * _MANY


def _other_elements(items: Any, path: Path, kind: FieldType, rng: random.Random) -> Any:
    """An array of the same length with other elements."""
    if not len(items):
        return items
    if kind.element in FLOATS and kind.size in (9, 36):
        return _other_matrix([float(x) for x in items], round(math.sqrt(kind.size)), rng)
    items = items if isinstance(items, list) else copy.copy(items)
    if kind.is_message:
        items[rng.randrange(len(items))] = _fill(kind, path, rng)
        return items
    if rng.randrange(4) == 0:
        return [_fill(kind, path, rng)] * len(items)
    for _ in range(rng.choice((1, 1, 3, 20))):
        i = rng.randrange(len(items))
        items[i] = _other_primitive(items[i], path, kind.element, rng)
    return items


def _other_matrix(values: list[float], n: int, rng: random.Random) -> list[float]:
    """A square matrix, such as a covariance or intrinsics, that is not finite, not symmetric, indefinite, zero, huge or tiny."""
    i, j = rng.randrange(n), rng.randrange(n)
    how = rng.randrange(8)
    if how == 0:
        return [0.0] * (n * n)
    if how == 1:
        return [rng.choice(_FLOATS)] * (n * n)
    if how == 2:
        return [x * rng.choice((1e300, 1e-300, -1.0, 1e12)) for x in values]
    if how == 3:
        values[i * n + i] = -abs(values[i * n + i]) - rng.choice((0.0, 1.0))
    elif how == 4:
        # Indefinite: a correlation beyond one.
        values[i * n + j] = values[j * n + i] = 10.0 * max(abs(values[i * n + i]), abs(values[j * n + j]), 1e-3)
    elif how == 5:
        values[i * n + j] += rng.choice((1.0, -1e3, 1e-9))
    else:
        values[i * n + j] = rng.choice(_FLOATS)
    return values


# ---- structures


def _other_stamp(stamp: Any, rng: random.Random) -> Any:
    new = type(stamp)()
    if rng.randrange(2):
        shifted = stamp.sec + 1e-9 * stamp.nanosec + rng.choice(_SHIFTS)
        new.sec = int(max(-(2**31), min(2**31 - 1, math.floor(shifted))))
        new.nanosec = int((shifted - math.floor(shifted)) * 1e9) % 10**9
    else:
        new.sec, new.nanosec = rng.choice((*_SECONDS, stamp.sec)), rng.choice(_NANOSECONDS)
    low, high = INTEGERS[type(new).get_fields_and_field_types()["nanosec"]]
    new.nanosec = max(low, min(high, new.nanosec))
    return new


def _other_quaternion(turn: Any, rng: random.Random) -> Any:
    values = [turn.x, turn.y, turn.z, turn.w]
    how = rng.randrange(6)
    if how == 0:
        values = [0.0] * 4
    elif how == 1:
        values = [value * rng.choice((2.0, 0.5, -1.0, 1.0 + 1e-4, 1e200, 1e-200)) for value in values]
    elif how == 2:
        values[rng.randrange(4)] = rng.choice(_FLOATS)
    elif how == 3:
        values = [rng.gauss(0.0, 1.0) for _ in values]
        norm = math.sqrt(sum(value * value for value in values))
        values = [value / norm for value in values]
    elif how == 4:
        values = [math.sin(0.04), 0.0, 0.0, math.cos(0.04)]
    else:
        values = rng.sample(values, 4)
    return type(turn)(**dict(zip("xyzw", values, strict=True)))


_STRUCTURES: Final[tuple[tuple[set[str], Callable[[Any, random.Random], Any]], ...]] = (
    ({"sec", "nanosec"}, _other_stamp),
    ({"x", "y", "z", "w"}, _other_quaternion),
)
"""Messages that mean one thing together: their fields, and how they are changed."""


# ---- bytes


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """Serialised bytes (CDR) with flipped bits, lengths that claim too much, a wrong header, or of another length.

    Never none: a message without a byte does not reach a reader of another process, and Fast DDS then holds back what the same writer
    sends later. That is the writer's loss alone.
    """
    changed = bytearray(data)
    how = rng.randrange(8)
    if how == 0:
        return bytes(changed[: rng.randrange(1, len(changed) + 1)])
    if how == 1:
        return bytes(changed + rng.randbytes(rng.choice((1, 3, 4, 100))))
    if how == 2:
        return bytes(changed[:4]) + rng.randbytes(rng.choice((0, 1, 8, 64, 1000)))
    if how == 3:
        changed[: min(4, len(changed))] = rng.randbytes(min(4, len(changed)))
        return bytes(changed)
    if how in (4, 5) and len(changed) >= 8:
        # Lengths stand at multiples of four after the header.
        for _ in range(rng.choice((1, 1, 3))):
            at = 4 * rng.randrange(1, len(changed) // 4)
            struct.pack_into("<I", changed, at, rng.choice((2**32 - 1, 2**31, 2**31 - 1, 2**28, 2**20, 65536, 0, 1)))
        return bytes(changed)
    for _ in range(rng.choice((1, 2, 8, 64))):
        if changed:
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)
