"""Index page of a fleet: first the failures, then the prediction errors of all bags, then each bag."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.fleet.job import Outcome
from push_ident.fleet.table import row_of
from push_ident.pages.page import write_page
from push_ident.pages.scatter import Dot, scatter

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
        "figure": _draw(tested) if tested else "",
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


def _draw(rows: Sequence[Any]) -> str:
    """Error of the identified model over that of equal cells, a dot for each bag."""
    dots = []
    for row in rows:
        uniform, identified = (1e3 * float(row[f"test_{name}_m"]) for name in ("uniform", "identified"))
        dots.append(Dot(uniform, identified, f"{row['bag']}: identified {identified:.1f} mm, equal cells {uniform:.1f} mm"))
    return scatter("Errors on held-out pushes of each bag", dots, x_axis="equal cells [mm]", y_axis="identified [mm]")


def _number(*values: float | None) -> float:
    return next((value for value in values if value is not None and math.isfinite(value)), 0.0)
