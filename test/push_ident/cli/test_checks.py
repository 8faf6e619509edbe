"""Options are checked before a command begins its work, and errors name the option, not what is inside."""

from __future__ import annotations

import os
import subprocess
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main

from helpers.commands import run_here
from push_ident.cli.checks import parse_numbers
from push_ident.cli.main import app
from push_ident.errors import InputError, PushIdentError

BAG = "no_such_bag"
"""What is refused before it is looked at needs no bag."""
NEVER_NEGATIVE = ("seed", "models", "jobs", "hold_out", "goals", "workers", "pushes", "random", "explore", "max_pushes", "repeat")
"""Whole numbers that no command takes below zero."""
RESULTS = ("out", "json", "page", "truth", "record")


def commands(group: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    for listed in group.commands:
        name, command, _ = group.resolve_command(typer.Context(group), [listed])
        if hasattr(command, "commands"):
            yield from commands(command, f"{before}{name} ")
        else:
            yield before + name, command


def kind_of(option: Any) -> Any:
    """The type of its value, without None."""
    annotation = option.type_descriptor.annotation
    return next((a for a in typing.get_args(annotation) if a in (float, int, Path)), annotation)


OPTIONS = [(name, command, option) for name, command in commands(typer.main.get_command(app)) for option in command.params]


def refusal(command: Any, option: Any, value: str) -> str:
    """What is said of a value; empty where it is accepted."""
    try:
        option.process_value(command.context_class(command, info_name="push-ident"), value)
    except (typer.BadParameter, PushIdentError) as error:
        return str(error)
    return ""


def numbers() -> Iterator[Any]:
    for name, command, option in OPTIONS:
        if kind_of(option) is float:
            yield from (pytest.param(command, option, value, id=f"{name} {option.name}") for value in ("nan", "inf"))
        elif kind_of(option) is int and option.name in NEVER_NEGATIVE:
            yield pytest.param(command, option, "-1", id=f"{name} {option.name}")


@pytest.mark.parametrize(("command", "option", "value"), [*numbers()])
def test_number_that_means_nothing_is_refused(command: Any, option: Any, value: str) -> None:
    assert refusal(command, option, value)
    assert not refusal(command, option, "1")


@pytest.mark.parametrize(
    ("command", "option"),
    [pytest.param(c, o, id=f"{name} {o.name}") for name, c, o in OPTIONS if o.name in RESULTS and kind_of(o) is Path],
)
def test_result_that_cannot_be_written_is_refused(command: Any, option: Any, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "Cannot write to" in refusal(command, option, str(tmp_path / "file" / "below" / "x"))
    assert not refusal(command, option, str(tmp_path / "new"))


@pytest.mark.parametrize(
    ("command", "option", "value"), [("identify", "--friction", "nan"), ("identify", "--seed", "-1"), ("simulate", "--yaw-noise", "-0.001")]
)
def test_number_out_of_range_is_refused_by_the_name_of_the_option(command: str, option: str, value: str) -> None:
    done = run_here(command, *([BAG] if command == "identify" else []), option, value)
    assert done.returncode == 2 and f"'{option}'" in done.stderr and "Prior" not in done.stderr


@pytest.mark.parametrize("command", ["identify", "diagnose", "replay"])
@pytest.mark.parametrize("option", ["--out", "--json"])
def test_what_cannot_be_written_is_told_before_the_bag_is_read(command: str, option: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = run_here(command, BAG, option, tmp_path / "file" / "below")
    assert done.returncode == 1 and "Cannot write to" in done.stderr and BAG not in done.stderr
    assert sorted(tmp_path.iterdir()) == [tmp_path / "file"]


def test_a_result_that_is_a_folder_and_a_new_bag_that_exists_are_told_at_once(tmp_path: Path) -> None:
    done = run_here("identify", BAG, "--json", tmp_path)
    assert done.returncode == 1 and "is a folder" in done.stderr
    for given in (("simulate", "--out", tmp_path), ("salvage", BAG, "--out", tmp_path), ("up", "sim", "--record", tmp_path)):
        done = run_here(*given)
        assert done.returncode == 1 and "exists already and is not overwritten" in done.stderr


def test_a_method_and_pushes_that_are_none_are_told_before_the_bag_is_read() -> None:
    done = run_here("identify", BAG, "--method", "magic")
    assert done.returncode == 1 and "no method `magic`" in done.stderr
    done = run_here("identify", BAG, "--train", "0-x")
    assert done.returncode == 1 and "such as 0,2,5-7" in done.stderr


def test_pushes_are_named_by_numbers_and_ranges() -> None:
    assert parse_numbers("0-2", "--train") == [0, 1, 2] and parse_numbers("7, 3-3 ,0", "--train") == [7, 3, 0]
    for wrong in ("", "1-", "-1", "2-1", "1,,2", "1-2-3", "a", "0-99999999999"):
        with pytest.raises(InputError, match="--train"):
            parse_numbers(wrong, "--train")
    with pytest.raises(InputError, match="twice"):
        parse_numbers("0-2,1", "--train")


def test_shells_can_complete_commands_and_options() -> None:
    def completed(*words: str) -> list[str]:
        asked = {"_PUSH_IDENT_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}
        program = "import sys; sys.argv[0] = 'push-ident'; from push_ident.cli.entry import main; main()"
        return subprocess.run([sys.executable, "-c", program], env=os.environ | asked, capture_output=True, text=True).stdout.split()

    assert completed("push-ident", "push") == ["push", "push-to"]
    assert completed("push-ident", "import", "cs") == ["csv"]
    assert completed("push-ident", "push", "--dr") == ["--dry-run"]
