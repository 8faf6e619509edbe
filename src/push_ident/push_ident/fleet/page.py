"""Index page of a fleet: first the failures, then the prediction errors of all bags, then each bag."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from push_ident.fleet.job import Outcome
from push_ident.fleet.table import row_of
from push_ident.pages.page import svg, write_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["write_index"]

_GOOD: Final = "converged"


def write_index(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write the index page. Raises InputError where it cannot be written."""
    rows = [row_of(outcome) for outcome in outcomes]
    done = [row for row in rows if row["state"] == "done"]
    # Worst first: readers look for the bags that need attention.
    done.sort(key=lambda row: (row["status"] == _GOOD, -_number(row["test_identified_m"], row["train_identified_m"])))
    tested = [row for row in done if row["n_test"]]
    failed = [row for row in rows if row["state"] != "done"]
    context = {
        "title": f"{len(rows)} bags",
        "headline": _headline(rows, done, failed, tested),
        "failed": failed,
        "figure": svg(_draw(tested)) if tested else "",
        "rows": done,
        "seconds": sum(row["seconds"] or 0.0 for row in rows),
        "hosts": sorted({row["host"] for row in rows if row["host"]}),
    }
    write_page(path, __package__, "index.html.j2", context)


def _headline(rows: Sequence[Any], done: Sequence[Any], failed: Sequence[Any], tested: Sequence[Any]) -> str:
    parts = [f"{len(done)} of {len(rows)} bags were identified" + (f", {len(failed)} failed." if failed else ".")]
    if tested:
        identified, uniform = (1e3 * float(np.median([row[f"test_{name}_m"] for row in tested])) for name in ("identified", "uniform"))
        parts.append(f"The median error on held-out pushes is {identified:.1f} mm; a model with equal cells has {uniform:.1f} mm.")
    unreliable = sum(row["status"] != _GOOD for row in done)
    if unreliable:
        parts.append(f"{unreliable} fits did not converge or fit poorly: they come first in the table.")
    return " ".join(parts)


def _draw(rows: Sequence[Any]) -> Figure:
    from matplotlib.figure import Figure

    uniform, identified = (1e3 * np.array([row[f"test_{name}_m"] for row in rows], dtype=float) for name in ("uniform", "identified"))
    figure = Figure(figsize=(5.2, 4.6), layout="constrained")
    ax = figure.subplots()
    low, high = 0.8 * float(np.nanmin([uniform, identified])), 1.25 * float(np.nanmax([uniform, identified]))
    ax.plot([low, high], [low, high], ":", color="black", linewidth=1)
    ax.plot(uniform, identified, "o", color="#0072b2", markersize=5, alpha=0.6)
    ax.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    ax.set_xlabel("error of equal cells on held-out pushes [mm]")
    ax.set_ylabel("error of the identified model on held-out pushes [mm]")
    ax.grid(alpha=0.3)
    return figure


def _number(*values: float | None) -> float:
    return next((value for value in values if value is not None and math.isfinite(value)), 0.0)
