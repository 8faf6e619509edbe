"""Outcomes of a fleet as one Parquet table with a row per bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from push_ident.extras import need
from push_ident.files import replaced
from push_ident.fleet.job import Outcome

_MAP: Final = ("x", "y", "mass", "friction", "mass_friction", "mass_friction_std")
_NUMBERS: Final = (*(f"map.{name}" for name in _MAP), "train.per_push_m", "test.per_push_m")
"""Columns that are lists of numbers."""
_COLUMNS: Final = {
    "status": ("string", "result.status"),
    "object_id": ("string", "result.object_id"),
    "n_cells": ("int64", "result.n_cells"),
    "method": ("string", "result.method"),
    "n_simulations": ("int64", "result.n_simulations"),
    "time_s": ("float64", "result.time_s"),
    "misfit": ("float64", "result.misfit"),
    **{
        f"{part}_{model}_m": ("float64", f"result.{part}.{model}_m")
        for part in ("train", "test")
        for model in ("uniform", "scalar", "identified")
    },
    "pusher_friction": ("float64", "result.pusher_friction.value"),
    "pusher_friction_std": ("float64", "result.pusher_friction.std"),
    "total_mass": ("float64", "result.total_mass.value"),
    "total_mass_std": ("float64", "result.total_mass.std"),
    "total_mass_identifiable": ("bool", "result.total_mass.identifiable"),
}
"""Columns: type, and path of the value in an outcome."""


def row_of(outcome: Outcome) -> dict[str, Any]:
    """One row: state of the bag, then the numbers of its result; None where there are none."""
    row: dict[str, Any] = {name: outcome.get(name) for name in ("bag", "state", "error", "host", "seconds", "model_file", "page_file")}
    for part in ("train", "test"):
        pushes = _at(outcome, f"result.{part}.pushes")
        row[f"n_{part}"] = None if pushes is None else len(pushes)
    row |= {name: _at(outcome, where) for name, (_, where) in _COLUMNS.items()}
    centre = _at(outcome, "result.centre_of_friction_m") or [None, None]
    row["centre_of_friction_x_m"], row["centre_of_friction_y_m"] = centre
    for name in _NUMBERS:
        row[name.replace(".", "_")] = _at(outcome, f"result.{name}")
    row["notes"] = _at(outcome, "result.notes")
    return row


def write_table(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write all outcomes to a Parquet file; an interrupted write leaves no file.

    Raises:
        MissingPackageError: pyarrow is not installed.
        PushIdentError: the file cannot be written.
    """
    need("fleet")
    import pyarrow as pa
    import pyarrow.parquet as parquet

    text = [(name, pa.string()) for name in ("bag", "state", "error", "host")]
    schema = pa.schema(
        [
            *text,
            ("seconds", pa.float64()),
            ("model_file", pa.string()),
            ("page_file", pa.string()),
            ("n_train", pa.int64()),
            ("n_test", pa.int64()),
            *((name, pa.type_for_alias(kind)) for name, (kind, _) in _COLUMNS.items()),
            ("centre_of_friction_x_m", pa.float64()),
            ("centre_of_friction_y_m", pa.float64()),
            *((name.replace(".", "_"), pa.list_(pa.float64())) for name in _NUMBERS),
            ("notes", pa.list_(pa.string())),
        ]
    )
    with replaced(path, "the table") as file:
        parquet.write_table(pa.Table.from_pylist([row_of(o) for o in outcomes], schema=schema), file)


def _at(content: Any, where: str) -> Any:
    """Value at a dotted path in nested dictionaries; None where there is none."""
    for name in where.split("."):
        content = content.get(name) if isinstance(content, dict) else None
    return content
