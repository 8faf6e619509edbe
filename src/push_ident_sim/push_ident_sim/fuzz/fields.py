"""The fields of a ROS message as a tree: types, paths to its leaves, values at them."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

__all__ = ["FLOATS", "INTEGERS", "FieldType", "Path", "field_types", "get_at", "interface_class", "leaves", "make_default", "set_at"]

Path = tuple[str | int, ...]
"""Names of fields and numbers of elements, from the message inwards."""

INTEGERS: Final = {
    **{f"int{n}": (-(2 ** (n - 1)), 2 ** (n - 1) - 1) for n in (8, 16, 32, 64)},
    **{f"uint{n}": (0, 2**n - 1) for n in (8, 16, 32, 64)},
}
"""Smallest and largest value of each type of integers."""
FLOATS: Final = {"float": (2.0 - 2.0**-22) * 2.0**127, "double": sys.float_info.max}
"""Largest finite value of each type of floating-point numbers that a message holds and takes back.

The largest of 32 bits is one step more: rclpy compares with 3.402823466e38, which is below what a message returns after it was set.
"""

_ARRAY: Final = re.compile(r"(?P<element>[^\[\]]+)\[(?P<size>\d+)\]")
_SEQUENCE: Final = re.compile(r"sequence<(?P<element>.+?)(?:, (?P<bound>\d+))?>")
_ACTION_PARTS: Final = ("_Goal", "_Result", "_Feedback")


@dataclass(frozen=True, slots=True)
class FieldType:
    """Type of one field."""

    element: str
    """A primitive type, `string`, or `package/Name` of a message; of each element for an array."""
    is_array: bool = False
    size: int | None = None
    """Number of elements of an array of fixed size."""
    bound: int | None = None
    """Largest number of elements of an array of bounded size."""

    @property
    def is_message(self) -> bool:
        """Whether an element is itself a message."""
        return "/" in self.element

    @property
    def is_number(self) -> bool:
        """Whether an element is an integer or a floating-point number."""
        return self.element in INTEGERS or self.element in FLOATS


def field_types(msg: Any) -> dict[str, FieldType]:
    """Type of each field of a message, or of its class."""
    return {name: _parse(text) for name, text in msg.get_fields_and_field_types().items()}


def _parse(text: str) -> FieldType:
    text = text.replace("boolean", "bool")
    if found := _SEQUENCE.fullmatch(text):
        return FieldType(_plain(found["element"]), is_array=True, bound=int(found["bound"]) if found["bound"] else None)
    if found := _ARRAY.fullmatch(text):
        return FieldType(_plain(found["element"]), is_array=True, size=int(found["size"]))
    return FieldType(_plain(text))


def _plain(element: str) -> str:
    return "string" if element.startswith(("string", "wstring")) else element


def interface_class(name: str) -> Any:
    """Class of `package/msg/Name`, `package/srv/Name`, or `package/action/Name_SendGoal` and the like, as the ROS graph names them.

    Raises ImportError or AttributeError where it is not installed.
    """
    package, kind, name = name.split("/")
    module = importlib.import_module(f"{package}.{kind}")
    action, _, part = name.rpartition("_")
    if kind == "action" and part in ("SendGoal", "GetResult"):
        return getattr(getattr(module, action).Impl, f"{part}Service")
    if kind == "action" and part == "FeedbackMessage":
        return getattr(module, action).Impl.FeedbackMessage
    return getattr(getattr(module, action), part) if kind == "action" and action else getattr(module, name)


def make_default(element: str) -> Any:
    """The default value of one element of a type."""
    if "/" in element:
        package, name = element.split("/")[0], element.split("/")[-1]
        kind = "action" if name.endswith(_ACTION_PARTS) else "msg"
        return interface_class(f"{package}/{kind}/{name}")()
    others: dict[str, Any] = {"string": "", "bool": False, "octet": b"\0"}
    return 0.0 if element in FLOATS else others.get(element, 0)


def get_at(msg: Any, path: Path) -> Any:
    """Value at a path."""
    for step in path:
        msg = getattr(msg, step) if isinstance(step, str) else msg[step]
    return msg


def set_at(msg: Any, path: Path, value: Any) -> None:
    """Set the value at a path that ends in a field, or in an element of an array."""
    owner = get_at(msg, path[:-1])
    step = path[-1]
    if isinstance(step, str):
        setattr(owner, step, value)
    else:
        owner[step] = value


def leaves(msg: Any, prefix: Path = (), *, n_elements: int = 4) -> Iterator[tuple[Path, FieldType]]:
    """Every field below a message with its path; of an array of messages the first `n_elements` are entered."""
    for name, kind in field_types(msg).items():
        path = (*prefix, name)
        yield path, kind
        value = getattr(msg, name)
        if kind.is_message and kind.is_array:
            for i in range(min(len(value), n_elements)):
                yield from leaves(value[i], (*path, i), n_elements=n_elements)
        elif kind.is_message:
            yield from leaves(value, path, n_elements=n_elements)
