"""What the study of goals in the live cell counts as success, and what it says of the rest; the cell itself runs in test/system."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.registry import EXPERIMENTS

STUDY = EXPERIMENTS["goals-live"]
REACHED: Json = {
    "reached": True,
    "code": "SUCCESS",
    "text": "",
    "pushes": 4,
    "time_s": 40.0,
    "goal": [0.1, 0.0, 3.1],
    "tolerance": [0.02, 0.1],
    "true_error": [0.004, 0.02],
    "fell": False,
    "rms": [None, None],
    "corrections": 0,
    "corrections_ms": None,
    "load": 1.0,
}


def summary_of(kind: str, *runs: Json) -> Json:
    summary: Json = STUDY.summarise([CaseResult(Case("hammer", k, kind), REACHED | run) for k, run in enumerate(runs)])
    return summary


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"true_error": [0.021, 0.0]}, "true pose beyond tolerance"),
        ({"true_error": [0.0, 0.11]}, "true pose beyond tolerance"),
        ({"fell": True}, "FELL"),
        ({"reached": False, "code": "TIME_LIMIT"}, "TIME_LIMIT"),
        ({"reached": False, "code": "NOT_HELD", "goal": None, "true_error": None}, "NOT_HELD"),
    ],
    ids=["beside it", "turned", "fallen", "late", "no goal chosen"],
)
def test_node_that_says_it_is_there_is_not_believed_alone(change: Json, cause: str) -> None:
    row = summary_of("pose", {}, change)["pose"]
    assert row["success"]["successes"] == 1 and row["success"]["n"] == 2 and row["causes"] == {cause: 1}
    assert row["true_error"] == [0.004, 0.02]


def test_tables_and_picture_hold_runs_with_and_without_corrections(tmp_path: Path) -> None:
    timed: Json = {"rms": [0.002, 0.01], "corrections": 50, "corrections_ms": [12.0, 30.0]}
    summary = summary_of("line", timed, timed | {"corrections_ms": [14.0, 26.0]}, {"reached": False, "code": "OBJECT_LOST"})
    text = STUDY.tables(summary)
    assert "2 of 3" in text and "13 / 30 ms" in text and f"2.0 mm, {np.degrees(0.01):.1f}°" in text and "1 OBJECT_LOST" in text
    for name in STUDY.draw(summary, tmp_path):
        assert (tmp_path / name).stat().st_size > 5000
