"""Whatever stands in the place of a model, a command that takes one ends with one line and without a traceback."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from helpers.commands import run_here
from helpers.damaged_models import DAMAGE, DAMAGED_TEXT, right_model, unreadable_paths
from helpers.paths import EXAMPLE_BAG


def damaged_files(folder: Path) -> dict[str, Path]:
    files = unreadable_paths(folder)
    for number, (name, (change, _)) in enumerate(DAMAGE.items()):
        content = right_model()
        change(content)
        files[name] = folder / f"damaged{number}.json"
        files[name].write_text(json.dumps(content))
    for number, (name, (make, _)) in enumerate(DAMAGED_TEXT.items()):
        files[name] = folder / f"text{number}.json"
        files[name].write_text(make())
    return files


@pytest.mark.parametrize("command", [["predict", "MODEL", EXAMPLE_BAG], ["export", "MODEL", "--format", "mjcf"]], ids=str)
def test_no_damaged_model_gives_a_traceback(command: list[object], tmp_path: Path) -> None:
    for name, path in damaged_files(tmp_path).items():
        done = run_here(*(path if word == "MODEL" else word for word in command))
        said = done.stderr.strip()
        assert done.returncode == 1 and done.stdout == "", name
        assert said.startswith("push-ident: ") and "\n" not in said and "Traceback" not in said, (name, said)


def test_names_that_are_too_long_and_exports_over_the_model_are_one_line_and_a_link_is_replaced(tmp_path: Path) -> None:
    long, model, link = tmp_path / ("n" * 253), tmp_path / "model.xml", tmp_path / "other.xml"
    long.write_text(json.dumps(right_model()))
    model.write_text(long.read_text())
    link.hardlink_to(model)
    for command, reason in (
        (("export", long, "--format", "mjcf"), "File name too long"),
        (("export", model, "--format", "mjcf", "--out", tmp_path / ("o" * 300)), "File name too long"),
        (("predict", model, tmp_path / ("b" * 300)), "there is no such bag"),
        (("export", model, "--format", "mjcf"), "is the model itself"),
        (("export", model, "--format", "mjcf", "--out", link), "is the model itself"),
    ):
        done = run_here(*command)
        assert done.returncode == 1 and done.stderr.count("\n") == 1 and reason in done.stderr, done.stderr
    loop = unreadable_paths(tmp_path)["loop of links"]
    done = run_here("export", model, "--format", "mjcf", "--out", loop)
    assert done.returncode == 0 and loop.read_text().startswith("<?xml")  # a link is replaced, not followed
