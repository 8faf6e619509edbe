"""Options are checked before a command begins its work, and errors name the option, not what is inside."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import run_here
from push_ident.cli.checks import parse_numbers
from push_ident.errors import InputError

BAG = "no_such_bag"
"""What is refused before it is looked at needs no bag."""


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [
        *(
            ("identify", name, value)
            for name in ("--friction", "--nominal-mass", "--total-mass", "--max-seconds")
            for value in ("-1", "nan")
        ),
        ("identify", "--pusher-friction", "0"),
        ("identify", "--seed", "-1"),
        ("identify", "--max-simulations", "0"),
        ("diagnose", "--friction", "inf"),
        ("demo", "--seed", "-1"),
        *(("simulate", name, "-0.001") for name in ("--position-noise", "--yaw-noise", "--force-noise")),
    ],
)
def test_numbers_out_of_range_are_refused_by_the_name_of_the_option(command: str, option: str, value: str) -> None:
    bag = [] if command in ("demo", "simulate") else [BAG]
    done = run_here(command, *bag, option, value)
    assert done.returncode == 2 and f"'{option}'" in done.stderr and "Prior" not in done.stderr and "Budget" not in done.stderr


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
