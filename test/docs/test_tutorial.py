"""The tutorial shows the numbers that its commands give."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from helpers.commands import run_here
from helpers.paths import EXAMPLE_BAG, ROOT

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")


def rows(text: str, edge: str) -> dict[str, list[float]]:
    """Numbers of each row of the tables of a text, by its first cell; `edge` divides cells."""
    lines = [line.strip().strip(edge) for line in text.splitlines() if line.strip().startswith(edge)]
    cells = [[cell.strip().strip("`") for cell in line.split(edge)] for line in lines]
    return {first: [float(number) for number in re.findall(r"\d+(?:\.\d+)?", " ".join(rest))] for first, *rest in cells}


def assert_shown(page: dict[str, list[float]], output: dict[str, list[float]]) -> None:
    """Each row of the page is in the output, as close as freshly compiled kernels of another processor may end."""
    assert page
    for first, numbers in page.items():
        assert output[first] == pytest.approx(numbers, rel=0.1, abs=0.2), first


def test_tables_of_the_tutorial_are_those_of_its_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    identified, predicted = PAGE.split("```text\n")[1:3]
    done = run_here("identify", EXAMPLE_BAG, "--train", "0,1,2", "--out", tmp_path)
    assert_shown(rows(identified.split("```")[0], "│"), rows(done.stdout, "│"))
    assert re.search(r"maps: .*", identified)[0] in done.stdout  # type: ignore[index]
    done = run_here("predict", tmp_path / "model.json", EXAMPLE_BAG)
    assert_shown(rows(predicted.split("```")[0], "│"), rows(done.stdout, "│"))


@pytest.mark.long
def test_tutorial_shows_what_the_diagnosis_of_the_hidden_tilt_finds(tmp_path: Path) -> None:
    run_here("simulate", "--effect", "table_tilt=0.02", "--pushes", 10, "--out", tmp_path / "tilted")
    run_here("diagnose", tmp_path / "tilted", "--json", tmp_path / "found.json")
    found, table = json.loads((tmp_path / "found.json").read_text(encoding="utf-8")), rows(PAGE, "|")
    (effect,), gap = found["effects"], found["gap"]
    assert (found["verdict"], effect["name"]) == ("named", "table_tilt")
    degree = 57.2958
    assert_shown(
        {name: table[name] for name in ("slope along x", "error on held-out pushes", "of which noise of the poses", "log Bayes factor")},
        {
            "slope along x": [effect["parameters"]["x"] * degree, effect["std"]["x"] * degree],
            "error on held-out pushes": [1e3 * gap["before_m"], 1e3 * gap["after_m"]],
            "of which noise of the poses": [1e3 * found["account"]["noise_m"]],
            "log Bayes factor": [effect["evidence"], next(e["evidence"] for e in found["ranking"] if e["name"] == "tether")],
        },
    )
