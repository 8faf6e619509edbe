"""Whether the demo convinces: how well its pushes are predicted before they are made, over objects and seeds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.errors import PushIdentError
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment

__all__ = ["STUDY"]

_TIMEOUT: Final = 900.0
"""Of one demo [s]: it takes two minutes where it has two cores for itself."""
_BEYOND: Final = 3.0
"""Expected errors from which on a push counts as badly predicted [1]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    del settings
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "demo.json"
        arguments = ("demo", "--object", case.object_name, "--seed", case.model, "--out", folder, "--json", file)
        command = [sys.executable, "-m", "push_ident.cli", *map(str, arguments)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT)
        except subprocess.TimeoutExpired:
            raise PushIdentError(f"the demo was not over after {_TIMEOUT:.0f} s") from None
        if done.returncode != 0:
            raise PushIdentError(f"the demo ended with exit code {done.returncode}: {done.stderr.strip()[-300:]}")
        found: Json = json.loads(file.read_text(encoding="utf-8"))
    found["load"] = os.getloadavg()[0]
    return found


def _summarise(results: Sequence[CaseResult]) -> Json:
    """Figures of each run, and of all predicted pushes: those of the test, and all from the second on."""
    runs = []
    for result in results:
        test = result.values["per_push"]
        predicted, uniform = (np.array([push[key] for push in test]) for key in ("predicted_m", "uniform_m"))
        runs.append(
            {
                "object": result.case.object_name,
                "seed": result.case.model,
                "identified_mean_m": float(predicted.mean()),
                "identified_median_m": float(np.median(predicted)),
                "uniform_mean_m": float(uniform.mean()),
                "uniform_median_m": float(np.median(uniform)),
                "worst_m": float(predicted.max()),
                "worst_expected": float(np.max(predicted / [push["expected_m"] for push in test])),
                "time_s": result.values["time_s"],
                "load": result.values["load"],
            }
        )
    pushes = [push for result in results for push in (*result.values["training"], *result.values["per_push"]) if "predicted_m" in push]
    errors, expected = (np.array([push[key] for push in pushes]) for key in ("predicted_m", "expected_m"))
    two_ways = [push for push in pushes if len(push["ways"]) > 1]
    return {
        "runs": runs,
        "n_pushes": len(pushes),
        "beyond": int(np.sum(errors > _BEYOND * expected)),
        "within": int(np.sum(errors <= expected)),
        "two_ways": len(two_ways),
        "errors_m": errors.tolist(),
        "expected_m": expected.tolist(),
    }


def _tables(summary: Json) -> str:
    def mm(value: float) -> str:
        return f"{1e3 * value:.2f}"

    head = [
        "object",
        "seed",
        "identified, mean [mm]",
        "median",
        "worst",
        "equal cells, mean [mm]",
        "median",
        "worst error, in expected errors",
    ]
    head += ["time [s]", "load of the machine"]
    rows = [
        [
            run["object"],
            str(run["seed"]),
            *(mm(run[f"identified_{key}_m"]) for key in ("mean", "median")),
            mm(run["worst_m"]),
            *(mm(run[f"uniform_{key}_m"]) for key in ("mean", "median")),
            f"{run['worst_expected']:.1f}",
            f"{run['time_s']:.0f}",
            f"{run['load']:.1f}",
        ]
        for run in summary["runs"]
    ]
    ratios = [run["uniform_median_m"] / run["identified_median_m"] for run in summary["runs"]]
    lost = sum(run["identified_mean_m"] >= run["uniform_mean_m"] for run in summary["runs"])
    n = summary["n_pushes"]
    figures = [
        ["median error of equal cells over that of the identified model, median of the runs", ">= 3", f"{np.median(ratios):.1f}"],
        ["runs in which equal cells are better in the mean", "0", f"{lost} of {len(ratios)}"],
        [f"pushes further off than {_BEYOND:g} expected errors", "<= 2 %", f"{summary['beyond']} of {n}"],
        ["pushes within the expected error", "", f"{summary['within']} of {n}"],
        ["pushes that might end in two ways, said before", "", f"{summary['two_ways']} of {n}"],
    ]
    return markdown_table(head, rows) + "\n\n" + markdown_table(["figure", "aim", "measured"], figures)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    from matplotlib.ticker import LogLocator

    errors, expected = 1e3 * np.array(summary["errors_m"]), 1e3 * np.array(summary["expected_m"])
    figure, (ax,) = new_figure(1)
    ax.loglog(expected, errors, "o", ms=4, color=COLOURS["gauss_newton"])
    ends = np.array([expected.min(), expected.max()])
    ax.plot(ends, ends, color=COLOURS["truth"], lw=1.0, label="as expected")
    ax.plot(ends, _BEYOND * ends, color=COLOURS["truth"], lw=1.0, ls=":", label=f"{_BEYOND:g} expected errors")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    ax.set_xlabel("expected error [mm]")
    ax.set_ylabel("error [mm]")
    label_below(ax, 2)
    save(figure, folder / "demo.png")
    return {"demo.png": "Every dot a push, predicted before it was made: its error against the one that was expected."}


STUDY = Experiment(
    name="demo",
    place=78,
    title="The demo",
    question=(
        "Does `push-ident demo` convince, whatever the object and the seed? Each run is the command as a user starts it: a simulated "
        "depth camera, perception, executor and identification live, four pushes of an unknown object, and four more that are the test. "
        "Each push from the second on is predicted from those before it before it is made. Errors are mean cell errors between the "
        "predicted pose and the pose that the camera measures afterwards, so that they hold the noise of the poses as well."
    ),
    variants=("plain",),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "pushing", "perception", "physics", "identification", "nodes", "cli"),
    one_at_a_time=True,
)
