"""Checks of options that take place before a command begins its work."""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path

import typer

from push_ident.errors import InputError
from push_ident.limits import LIMITS, plain_text


def above_zero(value: float | None) -> float | None:
    """Callback of an option: a finite number above 0, or none."""
    return _in_range(value, value is None or value > 0, "a finite number above 0")


def at_least_zero(value: float | None) -> float | None:
    """Callback of an option: a finite number of 0 or more, or none."""
    return _in_range(value, value is None or value >= 0, "a finite number of 0 or more")


def finite(value: float | None) -> float | None:
    """Callback of an option: a finite number, or none."""
    return _in_range(value, True, "a finite number")


def _in_range(value: float | None, is_in_range: bool, expected: str) -> float | None:
    if value is not None and not (math.isfinite(value) and is_in_range):
        raise typer.BadParameter(f"{value:g} is given, expected {expected}.")
    return value


def writable_folder(path: Path | None) -> Path | None:
    """Callback of an option: a folder in which files can be written, there or to be made; or none."""
    if path is not None:
        _probe(path, path)
    return path


def writable_file(path: Path | None) -> Path | None:
    """Callback of an option: a file that can be written or replaced; or none."""
    if path is not None:
        if os.path.isdir(path):  # unlike that of Path it raises for no name
            raise InputError(f"{plain_text(str(path))} is a folder, expected the name of a file.")
        _probe(path.parent, path)
    return path


def new_bag(path: Path | None) -> Path | None:
    """Callback of an option: the name of a bag that is not there yet, where it can be written; or none."""
    if path is not None:
        # A link that leads nowhere is there too.
        if os.path.lexists(path):
            raise InputError(f"{plain_text(str(path))}: exists already and is not overwritten; choose another name.")
        _probe(path.parent, path)
    return path


def _probe(folder: Path, path: Path) -> None:
    """Raise InputError where no file can be made in a folder, or in the nearest one above it that exists; nothing is left there."""
    try:
        there = next(above for above in (folder, *folder.absolute().parents) if above.exists())
        with tempfile.TemporaryFile(dir=there):
            return
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"Cannot write to {plain_text(str(path))}: {why}; choose a folder with write permission.") from None


def parse_numbers(text: str, option: str) -> list[int]:
    """Numbers from 0 and ranges of them, as `0,2,5-7`; raises InputError for another form, or a number that is there twice."""
    numbers: list[int] = []
    for part in text.split(","):
        first, dash, last = (word.strip() for word in part.partition("-"))
        if not first.isdecimal() or (dash and not last.isdecimal()) or (dash and int(last) < int(first)):
            raise InputError(f"{option} is `{plain_text(text)}`, expected push numbers and ranges such as 0,2,5-7.")
        if dash and int(last) - int(first) >= LIMITS.PUSHES.value:
            raise InputError(f"{option} is `{plain_text(text)}`, expected ranges of at most {LIMITS.PUSHES.value} pushes.")
        numbers += range(int(first), int(last or first) + 1)
    if len(set(numbers)) < len(numbers):
        raise InputError(f"{option} is `{plain_text(text)}` and names a push twice.")
    return numbers
