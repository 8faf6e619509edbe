"""Commands that are imported when they are asked for: most of the time of a short command would be spent on importing all others."""

from __future__ import annotations

import ast
import gc
import importlib
import importlib.util
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import typer
from typer.core import TyperGroup

__all__ = ["LazyGroup"]

_SUMMARY: Final = 62
"""Width of the line about each command in the list of all [characters]."""


class LazyGroup(TyperGroup):
    """A group whose commands stand in modules of their own; `places` are set by the program.

    Attributes:
        places: `module:name` of each command's function, or of the `typer.Typer` of a group of commands, by the command's name.
    """

    places: dict[str, str] = {}  # noqa: RUF012 (set once, before any command runs)

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = _Commands(self.places, self.commands)

    def list_commands(self, ctx: Any) -> list[str]:
        """In the order of `places`."""
        return list(self.commands)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """The list of all commands, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, _summary(place)) for name, place in self.places.items()])


class _Commands(dict[str, Any]):
    """Commands by name, each imported at its first use."""

    def __init__(self, places: dict[str, str], known: Mapping[str, Any]) -> None:
        super().__init__(known)
        self._places = places

    def __getitem__(self, name: str) -> Any:
        if not super().__contains__(name):
            self[name] = _command(name, self._places[name])
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        known = name in self
        return self[name] if known else default

    def __contains__(self, name: object) -> bool:
        return name in self._places or super().__contains__(name)

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys([*self._places, *super().__iter__()]))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def keys(self) -> Any:
        return list(self)

    def values(self) -> Any:
        return [self[name] for name in self]

    def items(self) -> Any:
        return [(name, self[name]) for name in self]


def _command(name: str, place: str) -> Any:
    module, _, attribute = place.partition(":")
    gc.disable()  # what an import makes stays: to look for garbage in it again and again takes a twentieth of the time
    try:
        found = getattr(importlib.import_module(module), attribute)
    finally:
        gc.freeze()
        gc.enable()
    if isinstance(found, typer.Typer):
        group = typer.main.get_group(found)
        group.name = name
        return group
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    alone.command(name)(found)
    return typer.main.get_command(alone)


def _summary(place: str) -> str:
    """First sentence of a command, from the source of its module: its docstring, or the help of a group."""
    module, _, attribute = place.partition(":")
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        return ""
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and node.name == attribute:
            return _shortened(ast.get_docstring(node) or "")
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and getattr(node.targets[0], "id", "") == attribute:
            texts = [word.value.value for word in node.value.keywords if word.arg == "help" and isinstance(word.value, ast.Constant)]
            return _shortened(str(*texts))
    return ""


def _shortened(text: str) -> str:
    """As many words of the first sentence as fit into one line."""
    sentence = " ".join(text.split()).split(". ")[0].rstrip(".")
    return textwrap.shorten(sentence, _SUMMARY, placeholder=" ...")
