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


@pytest.mark.parametrize(
    "command", [["predict", "MODEL", EXAMPLE_BAG], *(["export", "MODEL", "--format", name] for name in ("sdf", "urdf", "mjcf"))], ids=str
)
def test_no_damaged_model_gives_a_traceback(command: list[object], tmp_path: Path) -> None:
    for name, path in damaged_files(tmp_path).items():
        done = run_here(*(path if word == "MODEL" else word for word in command))
        said = done.stderr.strip()
        assert done.returncode == 1, name
        assert said.startswith("push-ident: ") and "\n" not in said and "Traceback" not in said, (name, said)
        assert done.stdout == "", name


def test_export_beside_a_model_with_a_long_name_and_to_a_loop_of_links_are_one_line(tmp_path: Path) -> None:
    model = tmp_path / ("n" * 253)
    model.write_text(json.dumps(right_model()))
    loop = unreadable_paths(tmp_path)["loop of links"]
    for arguments in ([model, "--format", "mjcf"], [model, "--format", "mjcf", "--out", tmp_path / ("o" * 300)]):
        done = run_here("export", *arguments)
        assert done.returncode == 1 and done.stderr.count("\n") == 1 and "File name too long" in done.stderr, done.stderr
    done = run_here("export", model, "--format", "mjcf", "--out", loop)
    assert done.returncode == 0 and loop.read_text().startswith("<?xml")  # a link is replaced, not followed


def test_a_bag_with_a_name_that_is_too_long_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "model.json").write_text(json.dumps(right_model()))
    done = run_here("predict", tmp_path / "model.json", tmp_path / ("b" * 300))
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "there is no such bag" in done.stderr


def test_export_over_the_model_is_refused_by_any_name(tmp_path: Path) -> None:
    model, link = tmp_path / "model.xml", tmp_path / "other.xml"
    model.write_text(json.dumps(right_model()))
    link.hardlink_to(model)
    for arguments in ([model, "--format", "mjcf"], [model, "--format", "mjcf", "--out", link]):
        done = run_here("export", *arguments)
        assert done.returncode == 1 and "is the model itself" in done.stderr
