"""`push-ident plan-pushes` as its users and their scripts see it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

from helpers.commands import check_refused, run_here

CORNERS = np.array([[-0.06, -0.04], [0.06, -0.04], [0.06, 0.0], [0.0, 0.0], [0.0, 0.05], [-0.06, 0.05]])


def test_pushes_are_planned_from_an_outline_as_table_page_and_commands(tmp_path: Path) -> None:
    outline, out = tmp_path / "outline.csv", tmp_path / "plan"
    outline.write_text("x,y\n" + "\n".join(f"{x},{y}" for x, y in CORNERS) + "\n")
    done = run_here("plan-pushes", "--outline", outline, "--pushes", 2, "--radius", "10mm", "--out", out, "--json", tmp_path / "p.json")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "p.json").read_text())
    assert len(content["pushes"]) == 2 and len(content["expected_error_m"]) == 3
    rows = np.loadtxt(out / "pushes.csv", delimiter=",", skiprows=1)
    assert rows.shape == (2, 5) and np.all(rows[:, 3:] > 0.0)
    page = (out / "pushes.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 2 and all(command in page for command in content["commands"])
    assert re.search(r"push-ident push --in-object --object ID --at=-?0\.\d+,-?0\.\d+ --direction=", done.stdout)


def test_an_object_that_was_looked_at_is_pushed_where_it_lies_about_its_centroid(tmp_path: Path) -> None:
    look = tmp_path / "look.json"
    seen = [{"object_id": name, "outline_m": np.add(CORNERS, (0.5, 0.1)).tolist()} for name in ("1", "2")]
    look.write_text(json.dumps({"objects": seen}))
    check_refused("name one of them with --object", "plan-pushes", "--look", look)
    done = run_here("plan-pushes", "--look", look, "--object", "2", "--pushes", 1, "--out", tmp_path, "--json", tmp_path / "p.json")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "p.json").read_text())
    assert "--object 2" in content["commands"][0] and abs(content["pushes"][0]["x_m"]) < 0.1
    look.write_text("{}")
    check_refused("is no result of `push-ident look --json`", "plan-pushes", "--look", look)
    check_refused("--outline FILE, or --look FILE", "plan-pushes")
    check_refused("give one of them", "plan-pushes", "--look", look, "--outline", look)
