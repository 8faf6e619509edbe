"""The tutorial shows the numbers that its commands give."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from helpers.commands import run_here
from helpers.paths import ROOT

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


def stored(case: str) -> dict[str, Any]:
    """Answer of a command, which `test/system/test_baseline.py` holds equal to what the command gives."""
    answer: dict[str, Any] = json.loads((ROOT / "test" / "system" / "baseline" / f"{case}.json").read_text(encoding="utf-8"))["content"]
    return answer


def test_tables_of_the_tutorial_are_the_answers_of_its_commands() -> None:
    identified, predicted = (rows(text.split("```")[0], "│") for text in PAGE.split("```text\n")[1:3])
    found, pushes = stored("identify-hammer_depth"), stored("predict-hammer_depth")["pushes"]
    errors = {f"{kind} ({len(found[kind]['pushes'])})": found[kind] for kind in ("train", "test")}
    output = {name: [1e3 * error[f"{maps}_m"] for maps in ("uniform", "scalar", "identified")] for name, error in errors.items()}
    for quantity in found["knowledge"]["quantities"]:
        unit = 1e3 if quantity["unit"] == "m" else 1.0
        output[quantity["name"]] = [unit * quantity[key] for key in ("value", "std", "prior_std")]
    assert_shown(identified, output)
    errors_of_pushes = [[1e3 * push[key] for key in ("cell_error_m", "cell_error_std_m")] for push in pushes]
    assert_shown(predicted, {str(number): errors for number, errors in enumerate(errors_of_pushes, start=1)})


def test_notebook_shows_the_numbers_of_the_tutorial() -> None:
    """Both have one source, the stored answers; `tools/run_notebook.py` stores the notebook anew where they differ."""
    cells = json.loads((ROOT / "docs" / "examples" / "bag_to_next_push.ipynb").read_text(encoding="utf-8"))["cells"]
    pages = ["".join(output.get("data", {}).get("text/html", [])) for cell in cells for output in cell.get("outputs", [])]
    edged = re.sub(r"</t[dh]>", "│", re.sub(r"</?tr[^>]*>", "\n│", "\n".join(pages)))
    shown = rows(re.sub(r"<[^>]+>", "", edged), "│")
    output = {
        q["name"]: [(1e3 if q["unit"] == "m" else 1.0) * abs(q[key]) for key in ("value", "std", "prior_std")]
        for q in stored("identify-hammer_depth")["knowledge"]["quantities"]
    }
    last = stored("predict-hammer_depth")["pushes"][3]
    output["hammer_depth push 4"] = [1e3 * last[key] for key in ("cell_error_m", "cell_error_std_m")]
    assert_shown({name: shown[name] for name in output}, output)


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
