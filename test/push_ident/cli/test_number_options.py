"""Every option of every command that takes a number or names a result is checked before the command begins."""

from __future__ import annotations

import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main

from push_ident.cli.main import app
from push_ident.errors import PushIdentError

NEVER_NEGATIVE = ("seed", "models", "jobs", "hold_out", "goals", "workers", "pushes", "random", "explore", "max_pushes", "repeat")
"""Whole numbers that no command takes below zero."""
RESULTS = ("out", "json", "page", "truth", "record")


def commands(group: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{before}{name} ")
        else:
            yield before + name, command


def kind_of(option: Any) -> Any:
    """The type of its value, without None."""
    annotation = option.type_descriptor.annotation
    return next((a for a in typing.get_args(annotation) if a in (float, int, Path)), annotation)


COMMANDS = dict(commands(typer.main.get_command(app)))


def refusal(command: Any, option: Any, value: str) -> str:
    """What is said of a value; empty where it is accepted."""
    try:
        option.process_value(command.context_class(command, info_name="push-ident"), value)
    except (typer.BadParameter, PushIdentError) as error:
        return str(error)
    return ""


def numbers() -> Iterator[Any]:
    for name, command in COMMANDS.items():
        for option in command.params:
            if kind_of(option) is float:
                yield pytest.param(command, option, "nan", id=f"{name} {option.name}")
                yield pytest.param(command, option, "inf", id=f"{name} {option.name}")
            elif kind_of(option) is int and option.name in NEVER_NEGATIVE:
                yield pytest.param(command, option, "-1", id=f"{name} {option.name}")


@pytest.mark.parametrize(("command", "option", "value"), [*numbers()])
def test_number_that_means_nothing_is_refused(command: Any, option: Any, value: str) -> None:
    assert refusal(command, option, value)
    assert not refusal(command, option, "1")


def results() -> Iterator[Any]:
    for name, command in COMMANDS.items():
        yield from (
            pytest.param(command, option, id=f"{name} {option.name}")
            for option in command.params
            if option.name in RESULTS and kind_of(option) is Path
        )


@pytest.mark.parametrize(("command", "option"), [*results()])
def test_result_that_cannot_be_written_is_refused(command: Any, option: Any, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "Cannot write to" in refusal(command, option, str(tmp_path / "file" / "below" / "x"))
    assert not refusal(command, option, str(tmp_path / "new"))
