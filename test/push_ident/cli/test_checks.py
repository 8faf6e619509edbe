"""Options are checked before a command begins its work, and errors name the option, not what is inside."""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main

from helpers.commands import run_here
from push_ident.cli.checks import parse_numbers
from push_ident.cli.main import app
from push_ident.cli.units import parse_floats, read_number
from push_ident.errors import InputError, PushIdentError

BAG = "no_such_bag"
"""What is refused before it is looked at needs no bag."""
NEVER_NEGATIVE = ("seed", "hold_out", "workers", "explore")
AT_LEAST_ONE = ("models", "jobs", "goals", "pushes", "random", "max_pushes", "repeat", "n_train", "n_test")
"""Whole numbers."""
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


def test_numbers_that_mean_nothing_and_results_that_cannot_be_written_are_refused_by_every_command(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name, command, option in OPTIONS:
        least = 0 if option.name in NEVER_NEGATIVE else 1 if option.name in AT_LEAST_ONE else None
        values = ("nan", "inf") if kind_of(option) is float else () if least is None else (str(least - 1),)
        for value in values:
            assert refusal(command, option, value) and not refusal(command, option, "1"), f"{name} {option.name} {value}"
        if option.name in RESULTS and kind_of(option) is Path:
            assert "Cannot write to" in refusal(command, option, str(tmp_path / "file" / "below" / "x")), f"{name} {option.name}"
            assert not refusal(command, option, str(tmp_path / "new")), f"{name} {option.name}"


def test_every_length_and_angle_takes_its_unit_and_a_bare_number_in_millimetres_or_degrees_is_refused() -> None:
    bare = {"[m]": ("4cm", "0.04", "50", "50mm is 0.05 m"), "[rad]": ("10deg", "0.1745329", "-90", "-90deg is -1.571 rad")}
    n_checked = 0
    for name, command, option in OPTIONS:
        unit = next((unit for unit in bare if re.search(rf"\{unit[:-1]}(\]|, or)", option.help or "")), None)
        if unit is None or kind_of(option) is not float:
            continue
        with_unit, same, wrong, reading = bare[unit]
        context = command.context_class(command, info_name="push-ident")
        values = [option.process_value(context, text) for text in (with_unit, same)]
        assert values[0] == pytest.approx(values[1], rel=1e-6), f"{name} {option.name}"
        assert reading in refusal(command, option, wrong), f"{name} {option.name}"
        n_checked += 1
    assert n_checked >= 15


def test_numbers_are_read_in_any_unit_of_their_kind() -> None:
    for text, unit, value in (
        ("90deg", "rad", np.pi / 2), ("-90°", "rad", -np.pi / 2), ("1.57rad", "rad", 1.57), ("6.28", "rad", 6.28), ("90rad", "rad", 90.0),
        ("5cm", "m", 0.05), (" 50 mm", "m", 0.05), ("1e-3m", "m", 0.001), ("7m", "m", 7.0), ("20", "mm", 20.0), ("2cm", "mm", 20.0),
        ("0.1rad", "deg", np.degrees(0.1)), ("5", "deg", 5.0), ("100mm/s", "m/s", 0.1), ("0.05m/s", "mm/s", 50.0),
    ):  # fmt: skip
        assert read_number(text, unit) == pytest.approx(value, rel=1e-12), text
    for text, unit in (
        ("5cm", "rad"),
        ("5deg", "m"),
        ("5 in", "m"),
        ("mm", "m"),
        ("", "m"),
        ("nan", "m"),
        ("infdeg", "rad"),
        ("90", "rad"),
    ):
        with pytest.raises(ValueError, match="expected"):
            read_number(text, unit)
    np.testing.assert_allclose(parse_floats("50mm,-0.02,90deg", ("m", "m", "rad"), "--pose", "X,Y,YAW"), [0.05, -0.02, np.pi / 2])
    with pytest.raises(InputError, match="--pose is '0,0,90', expected X,Y,YAW; 90 is given, expected radians: 90deg is 1.571 rad"):
        parse_floats("0,0,90", ("m", "m", "rad"), "--pose", "X,Y,YAW")


def test_what_is_wrong_in_the_options_is_told_before_the_bag_is_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for command, reason in (
        (("identify", BAG, "--friction", "nan"), "'--friction'"),
        (("simulate", "--yaw-noise", "-0.001"), "'--yaw-noise'"),
        (("push", "--at", "0,0", "--direction", 90), "'--direction': 90 is given, expected radians: 90deg is 1.571 rad"),
        (("push-to", "--x", "0", "--y", "0", "--yaw", "57.3"), "'--yaw': 57.3 is given"),
        (("push-to", "--spacing-mm", "0.5mm"), "'--spacing-mm': 0.5 mm is given, expected 1 mm or more"),
        (("experiment", "goals", "--goals", "0"), "'--goals'"),
        (("identify", BAG, "--method", "magic"), "no method `magic`"),
        (("identify", BAG, "--train", "0-x"), "such as 0,2,5-7"),
        (("identify", BAG, "--json", tmp_path), "is a folder"),
        (("diagnose", BAG, "--out", tmp_path / "file" / "below"), "Cannot write to"),
        (("replay", BAG, "--json", tmp_path / "file" / "below"), "Cannot write to"),
        (("simulate", "--out", tmp_path), "exists already and is not overwritten"),
        (("salvage", BAG, "--out", tmp_path), "exists already and is not overwritten"),
        (("up", "sim", "--record", tmp_path), "exists already and is not overwritten"),
    ):
        done = run_here(*command)
        assert done.returncode == (2 if reason.startswith("'") else 1) and reason in done.stderr and BAG not in done.stderr, command
    assert sorted(tmp_path.iterdir()) == [tmp_path / "file"]


def test_pushes_are_named_by_numbers_and_ranges() -> None:
    assert parse_numbers("0-2", "--train") == [0, 1, 2] and parse_numbers("7, 3-3 ,0", "--train") == [7, 3, 0]
    for wrong in ("", "1-", "-1", "2-1", "1,,2", "1-2-3", "a", "0-99999999999"):
        with pytest.raises(InputError, match="--train"):
            parse_numbers(wrong, "--train")
    with pytest.raises(InputError, match="twice"):
        parse_numbers("0-2,1", "--train")
