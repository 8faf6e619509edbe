"""Message definitions of a bag, checked before they become a decoder."""

from __future__ import annotations

from typing import Any

from rosbags.interfaces import Nodetype

from push_ident.errors import BagError
from push_ident.limits import LIMITS

__all__ = ["check_definitions"]


def check_definitions(types: dict[str, Any], topic: str) -> None:
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
