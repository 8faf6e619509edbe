"""A group of commands each of which is imported when it runs: importing all of them takes most of the time of a short command."""

from __future__ import annotations

import importlib
from typing import Any, ClassVar, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup


class LazyCommand(NamedTuple):
    """Where a command stands, and its line in the list of commands."""

    place: str
    """`module:name` of its function, or of the `typer.Typer` of a group."""
    summary: str


class LazyGroup(TyperGroup):
    """Click's lazily loaded subcommands (https://click.palletsprojects.com/en/stable/complex/#lazily-loading-subcommands).

    Help, completion and suggestions read names and summaries only, and so import nothing.

    Attributes:
        lazy_subcommands: by name, in the order of the list.
    """

    lazy_subcommands: ClassVar[dict[str, LazyCommand]] = {}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = {name: TyperCommand(name, short_help=command.summary) for name, command in self.lazy_subcommands.items()}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """See `click.Group.resolve_command`."""
        if args[0] in self.commands:
            self.commands[args[0]] = _load(args[0], self.lazy_subcommands[args[0]].place)
        return super().resolve_command(ctx, args)


def _load(name: str, place: str) -> Any:
    module, _, attribute = place.partition(":")
    command = getattr(importlib.import_module(module), attribute)
    if isinstance(command, typer.Typer):
        return typer.main.get_group(command)
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command(name)(command)
    return typer.main.get_command(app)
