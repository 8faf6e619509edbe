"""Common parts of all commands: console, options, JSON files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from push_ident.files import json_text, write_whole

__all__ = ["BagsArgument", "JsonOption", "OutOption", "console", "millimetres", "warn", "write_json"]

console = Console()
_errors = Console(stderr=True)

BagsArgument = Annotated[
    list[Path], typer.Argument(metavar="BAG...", help="Bags: folders, .mcap, .db3 or ROS 1 .bag files.", show_default=False)
]
JsonOption = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON.", show_default=False)]
OutOption = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Write results into this folder.", show_default=False)]


def warn(text: str) -> None:
    """Print one line on standard error."""
    _errors.print(text, style="yellow", highlight=False, soft_wrap=True)


def millimetres(metres: float) -> str:
    """A length in a table; a dash for a value that is not finite."""
    return f"{1e3 * metres:.1f} mm" if math.isfinite(metres) else "-"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON in which numbers that are not finite are null. Raises PushIdentError where the file cannot be written."""
    write_whole(path, json_text(content), "the result")
