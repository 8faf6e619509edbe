"""What must be true after every fault, whatever it was."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.errors import PushIdentError
from push_ident_sim.faults.harness.cell import Cell
from push_ident_sim.faults.harness.process import TRACEBACK

__all__ = ["check", "learned_pushes"]

_SETTLED: Final = 20.0
"""Longest wait for the model to contain the pushes that were acknowledged [s]."""
_LEAST: Final = -1e-9
"""A covariance has no eigenvalue below this share of its largest one: what rounding leaves."""
_NOT_NEGATIVE: Final = ("mass", "mass_std", "friction", "friction_std", "mass_friction_std")
_IDENTIFICATION: Final = "identification_node"


def learned_pushes(cell: Cell) -> int | None:
    """Pushes in the model of identification; None where it does not run or has no object yet."""
    process = cell.processes.get(_IDENTIFICATION)
    if process is None or not process.runs:
        return None
    path = cell.folder / "model.json"
    try:
        refusal = cell.save_model(path)
    except PushIdentError:
        return None
    return None if refusal else len(json.loads(path.read_text(encoding="utf-8"))["sources"])


def check(cell: Cell, *, alive: bool, learned_before: int, whole_before: int) -> list[str]:
    """Violations, in words; empty where there is none.

    Args:
        alive: whether all processes must run.
        learned_before: pushes in the model before the fault.
        whole_before: number of whole pushes in `monitor.records` that were already counted then.
    """
    found = _processes(cell, alive) + _logs(cell) + _messages(cell)
    whole = sum(record.error_code == 0 for _, record in list(cell.monitor.records)) - whole_before
    found += _learned(cell, learned_before, whole)
    path = cell.folder / "model.json"
    return found + (_model(path) if path.exists() else [])


def _processes(cell: Cell, alive: bool) -> list[str]:
    return [f"{name} ended by itself" for name, process in cell.processes.items() if alive and not process.runs]


def _logs(cell: Cell) -> list[str]:
    return [f"a traceback in the log of {name}" for name, process in cell.processes.items() if TRACEBACK in process.output]


def _messages(cell: Cell) -> list[str]:
    found = []
    for _, msg in list(cell.monitor.maps):
        for name in _NOT_NEGATIVE:
            values = np.array(getattr(msg, name))
            if not (np.isfinite(values).all() and (values >= 0).all()):
                found.append(f"a map has {name} that is negative or not finite")
    for _, prediction in list(cell.monitor.predictions):
        matrices = [np.array(pose.covariance).reshape(6, 6) for pose in prediction.poses]
        if not all(_is_covariance(matrix) for matrix in matrices):
            found.append("a prediction has a covariance that is not positive semi-definite")
    return sorted(set(found))


def _learned(cell: Cell, before: int, whole: int) -> list[str]:
    """Pushes that were acknowledged stay; a push that was not whole is not learned."""
    now = learned_pushes(cell)
    if now is None:
        return []
    deadline = time.monotonic() + _SETTLED
    while now is not None and now < before + whole and time.monotonic() < deadline:
        time.sleep(0.3)
        now = learned_pushes(cell)
    if now is None:
        return ["identification did not answer save_model"]
    if now < before:
        return [f"the model has {now} pushes, before the fault it had {before}"]
    return [f"{now - before} pushes were learned and {whole} were whole"] if now - before > whole else []


def _model(path: Path) -> list[str]:
    content = json.loads(path.read_text(encoding="utf-8"))
    found = []
    if min(content["mass"]) < 0 or not np.isfinite(content["mass"]).all():
        found.append("the model has a mass that is negative or not finite")
    if not _is_covariance(np.array(content["covariance"])):
        found.append("the covariance of the model is not positive semi-definite")
    return found


def _is_covariance(matrix: np.ndarray) -> bool:
    if not np.isfinite(matrix).all():
        return False
    values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
    return bool(values[0] >= _LEAST * max(1.0, values[-1]))
