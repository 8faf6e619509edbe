"""What README quotes of the results is what the files of the results say."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from helpers.paths import ROOT

README = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())


def result(name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((ROOT / "docs" / "results" / f"{name}.json").read_text(encoding="utf-8"))
    return content


@pytest.mark.parametrize(
    ("figure", "quoted"),
    [
        ("top1_detectable", "{} detectable single effects were named first"),
        ("mechanism_foreign", "a mechanism by another law than that of the catalogue was named in {} visible cases"),
        ("false_alarms", "{} null cases raised a false alarm"),
        ("wrong_names", "{} was named wrongly with confidence"),
        ("unknown_flagged", "{} were reported as unknown or not trustworthy"),
        ("unknown_misnamed", "{} got a name"),
    ],
)
def test_figures_of_the_blind_check(figure: str, quoted: str) -> None:
    row = result("blind")["summary"]["figures"]["14-pushes"][figure]
    hits = round(row["share"] * row["n"])
    assert quoted.format(f"{ {0: 'none', 1: 'one'}.get(hits, hits) } of {row['n']}") in README


def test_figures_of_known_causes_in_real_recordings() -> None:
    rows = result("injected")["summary"]["variants"]
    alone, against_half = rows["single"], rows["single-against-half"]
    assert f"it named {alone['all_named']} of {alone['detectable']} detectable ones" in README
    assert f"against half of the same recording {against_half['all_named']} of {against_half['detectable']}" in README
    wrong, n_single = (alone[key] + against_half[key] for key in ("wrong", "n"))
    assert f"{wrong} of these {n_single} got a wrong name" in README
    assert f"its size was wrong by {100 * float(np.median(alone['size_errors'])):.0f} %" in README
    held, n = np.sum([row["account_holds"] for row in rows.values()], axis=0)
    assert f"{held} of {n}." in README


def test_errors_of_predicted_pushes_and_successes_of_goals() -> None:
    pushes, success = result("pushes"), result("pusht")["summary"]["kinds"]["identified"]["success"]
    later = [1e3 * error for error in pushes["errors_m"][2:]]
    assert f"reach {1e3 * max(pushes['equal_errors_m']):.1f} mm" in README
    assert f"{min(later):.1f} to {max(later):.1f} mm" in README
    assert f"{success['successes']} of {success['n']} starts" in README
    assert "100 of 100 goals" in README and "100 of 100 goals" in result("goals")["remark"]
