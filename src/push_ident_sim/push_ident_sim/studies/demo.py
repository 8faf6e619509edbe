"""Whether the demo convinces: how well its pushes are predicted before they are made, over objects and seeds."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.errors import PushIdentError
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, millimetres

_FAR: Final = 3.0
"""Expected errors from which on a push counts as badly predicted [1]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "demo.json"
        arguments = ("demo", "--object", case.object_name, "--seed", case.model, "--out", folder, "--json", file)
        command = [sys.executable, "-m", "push_ident.cli", *map(str, arguments)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=900.0)  # two minutes where it has two cores for itself
        except subprocess.TimeoutExpired:
            raise PushIdentError("the demo was not over after 900 s") from None
        if done.returncode != 0:
            raise PushIdentError(f"the demo ended with exit code {done.returncode}: {done.stderr.strip()[-300:]}")
        result: Json = json.loads(file.read_text(encoding="utf-8"))
    return result


def _summarise(results: Sequence[CaseResult]) -> Json:
    """Figures by object, of the four pushes of the test; and of all predicted pushes, from the second on."""
    pushes = [push for r in results for push in (*r.values["training"], *r.values["per_push"]) if "predicted_m" in push]
    errors, expected = (np.array([push[key] for push in pushes]) for key in ("predicted_m", "expected_m"))
    means = [[np.mean([push[key] for push in r.values["per_push"]]) for key in ("predicted_m", "uniform_m")] for r in results]
    return {
        "objects": {name: _row(cases) for name, cases in grouped(results, "object_name").items()},
        "runs": len(results),
        "worse": int(sum(identified >= uniform for identified, uniform in means)),
        "pushes": len(pushes),
        "far": int(np.sum(errors > _FAR * expected)),
        "within": int(np.sum(errors <= expected)),
        "two_ways": sum(len(push["ways"]) > 1 for push in pushes),
    }


def _row(results: Sequence[CaseResult]) -> Json:
    test = [push for r in results for push in r.values["per_push"]]
    identified, uniform = (np.array([push[key] for push in test]) for key in ("predicted_m", "uniform_m"))
    return {
        "runs": len(results),
        "identified_m": float(np.mean(identified)),
        "worst_m": float(np.max(identified)),
        "uniform_m": float(np.mean(uniform)),
        "time_s": float(np.median([r.values["time_s"] for r in results])),
    }


def _tables(summary: Json) -> str:
    head = ["object", "runs", "identified, mean [mm]", "worst", "equal cells, mean [mm]", "time, median [s]"]
    rows = [
        [name, str(row["runs"]), *(millimetres(row[key]) for key in ("identified_m", "worst_m", "uniform_m")), f"{row['time_s']:.0f}"]
        for name, row in summary["objects"].items()
    ]
    n = summary["pushes"]
    counts = [
        ["runs in which equal cells are better in the mean", f"{summary['worse']} of {summary['runs']}"],
        [f"pushes with more than {_FAR:g} expected errors (aim: at most 2 %)", f"{summary['far']} of {n}"],
        ["pushes within the expected error", f"{summary['within']} of {n}"],
        ["pushes that might end in two ways, stated before", f"{summary['two_ways']} of {n}"],
    ]
    return markdown_table(head, rows) + "\n\n" + markdown_table(["count", "measured"], counts)


def _answer(summary: Json) -> str:
    rows = summary["objects"].values()
    identified, uniform = (float(np.mean([row[key] for row in rows])) for key in ("identified_m", "uniform_m"))
    return (
        f"Pushes 5 to 8 are predicted to {millimetres(identified)} mm (equal cells: {millimetres(uniform)} mm); {summary['far']} of "
        f"{summary['pushes']} pushes had more than {_FAR:g} times the expected error."
    )


STUDY = Experiment(
    name="demo",
    title="Does the demo convince, whatever the object and the seed?",
    question=(
        "Each run is `push-ident demo` as a user starts it, live: four pushes of an unknown object, then four that are the test. "
        "Each push from the second on is predicted before it is made. Errors are cell errors against the pose that the camera "
        "measures."
    ),
    variants=("plain",),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    stages=("geometry", "pushing", "perception", "physics", "identification", "nodes", "cli"),
    one_at_a_time=True,
)
