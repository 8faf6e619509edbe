"""Common parts of all commands: console, options, JSON files."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, ProgressColumn, SpinnerColumn, Task, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

from push_ident.cli.checks import writable_file, writable_folder
from push_ident.files import json_text, write_whole
from push_ident.limits import printable

_WORD: Final = 1_000
"""Longest word that is shown whole; rich takes minutes to break one of 100,000 characters into the lines of a table."""
_LONG: Final = re.compile(rf"\S{{{_WORD + 1},}}")


class PlainConsole(Console):
    """A console on which names and texts from outside are only text: no markup, no emoji codes, no control characters.

    Every command prints through one; rich passes each string here, those of tables and titles included.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """See `rich.console.Console.render_str`."""
        return super().render_str(_LONG.sub(lambda word: word[0][:_WORD] + "…", printable(text)), **options)


class Description(ProgressColumn):
    """What a task of a progress bar is doing, as plain text."""

    def render(self, task: Task) -> Text:
        """See `rich.progress.ProgressColumn.render`."""
        return Text(printable(task.description))


console: Final = PlainConsole()
_errors: Final = PlainConsole(stderr=True)

BagsArgument = Annotated[
    list[Path], typer.Argument(metavar="BAG...", help="Bags: folders, .mcap, .db3 or ROS 1 .bag files.", show_default=False)
]
JsonOption = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON.", callback=writable_file, show_default=False)
]
OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Write results into this folder.", callback=writable_folder, show_default=False)
]


def say(text: str, style: str | None = None) -> None:
    """Print one line, which the terminal wraps."""
    console.print(text, style=style, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """Print one line on standard error."""
    _errors.print(text, style="yellow", highlight=False, soft_wrap=True)


def millimetres(metres: float) -> str:
    """A length in a table; a dash for a value that is not finite."""
    return f"{1e3 * metres:.1f} mm" if math.isfinite(metres) else "-"


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Write JSON in which numbers that are not finite are null; nothing without a path. Raises PushIdentError where it cannot."""
    if path is not None:
        write_whole(path, json_text(content), "the result")


@contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """A line that says what is being done, as long as the context lasts: it is given to the function."""
    with Progress(SpinnerColumn(), Description(), TimeElapsedColumn(), console=console, transient=True) as shown:
        task = shown.add_task("reading")
        yield lambda text: shown.update(task, description=text)


@contextmanager
def status(text: str) -> Iterator[Callable[[str], None]]:
    """A line that says what is being done, as long as the context lasts: another text is given to the function. Where the output is no
    terminal, each text is a line of its own."""
    shown = ""
    with console.status("") as line:

        def show(text: str) -> None:
            nonlocal shown
            if console.is_terminal:
                line.update(escape(printable(text)))
            elif text != shown:
                say(text)
            shown = text

        show(text)
        yield show


def number_table(title: str, *headings: str) -> Table:
    """A table of numbers."""
    return Table(*(Column(heading, justify="right") for heading in headings), title=title)
