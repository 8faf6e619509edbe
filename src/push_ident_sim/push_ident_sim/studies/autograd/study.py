"""The compiled engine against the reference engine with automatic differentiation: the same pushes, the same time step, by turns."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from push_ident.errors import PushIdentError
from push_ident.geometry.cells import cell_error
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, loss_gradient, simulate
from push_ident.types import Float64Array, ObjectModel, PusherPath
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.benchmark import Benchmark, Piece, Settings, Target
from push_ident_sim.studies.common.drawing import markdown_table, millimetres, new_figure, save
from push_ident_sim.studies.common.plate import FRAMES, distance_to, plate, plate_pushes
from push_ident_sim.studies.common.timing import interleaved, milliseconds

__all__ = ["STUDY"]

_STEP = 0.01
"""A usual time step of engines of the reference's kind [s]; the `autograd` method uses it as well."""
_CELLS_ALONG = (4, 7, 10)
_REFERENCE = "reference"
_COMPILED: tuple[Literal["pyramid", "circle"], ...] = ("pyramid", "circle")
_ROUNDS = 3
_REPEATS = 25
"""Repeats of a compiled call in a round, as it is much shorter."""
_AT_REST = np.zeros(3)

_Outcome = tuple[float, Float64Array, Float64Array]
"""Loss, its gradient by the logarithms of mass and friction of each cell, and the last pose."""


def _pieces(settings: Settings) -> list[Piece]:
    sizes = _CELLS_ALONG[:1] if settings.quick else _CELLS_ALONG
    n_pushes, rounds = (1, 1) if settings.quick else (2, _ROUNDS)
    return [Piece(f"autograd, {n * n} cells", _compare, (n, n_pushes, rounds, settings.seed)) for n in sizes]


def _compare(cells_along: int, n_pushes: int, rounds: int, seed: int) -> Json:
    model, other = plate(cells_along, seed), plate(cells_along, seed + 1)
    runs = [_compare_push(model, other, push, rounds) for push in plate_pushes(n_pushes, seed)]
    return {
        "cells": cells_along**2,
        "pushes": n_pushes,
        **{
            name: {key: float(np.mean([run["times"][name][key] for run in runs])) for key in ("median_s", "q25_s", "q75_s")}
            for name in (_REFERENCE, *_COMPILED)
        },
        "off": {
            name: {
                "gradient": float(max(_relative(run["found"][name][1], run["found"]["reference"][1]) for run in runs)),
                "end_m": float(max(cell_error(model.shape.cells, run["found"][name][2], run["found"]["reference"][2]) for run in runs)),
            }
            for name in _COMPILED
        },
    }


def _compare_push(model: ObjectModel, other: ObjectModel, push: PusherPath, rounds: int) -> Json:
    target = simulate(other, PushScenario(push, _AT_REST, FRAMES), settings=SimulationSettings(step=_STEP)).pose
    compiled: dict[str, SimulationSettings] = {name: SimulationSettings(step=_STEP, friction_cone=name) for name in _COMPILED}
    calls: dict[str, Callable[[], _Outcome]] = {
        _REFERENCE: partial(_by_reference, model, push, target),
        **{name: partial(_by_compiled, model, push, target, settings) for name, settings in compiled.items()},
    }
    times, found = interleaved(calls, rounds, dict.fromkeys(compiled, _REPEATS))
    return {"times": times, "found": found}


def _by_compiled(model: ObjectModel, push: PusherPath, target: Float64Array, settings: SimulationSettings) -> _Outcome:
    result = loss_gradient(model, PushScenario(push, _AT_REST, FRAMES), distance_to(target), settings=settings)
    return result.loss, np.concatenate([result.mass * model.mass, result.friction * model.friction]), result.motion.pose[-1]


def _by_reference(model: ObjectModel, push: PusherPath, target: Float64Array) -> _Outcome:
    # Imported here, so that the tables can be made without loading torch.
    import torch

    from push_ident.physics.reference import ReferenceModel, reference_rollout

    mass, friction = (torch.tensor(values, requires_grad=True) for values in (model.mass, model.friction))
    motion = reference_rollout(
        model.shape,
        ReferenceModel(mass, friction, torch.tensor(model.pusher_friction, dtype=torch.float64)),
        [push],
        torch.zeros(1, 3, dtype=torch.float64),
        [FRAMES],
        settings=SimulationSettings(step=_STEP),
    )
    value, by_pose = distance_to(target)(motion.poses[0].detach().numpy())
    motion.poses[0].backward(torch.tensor(by_pose))  # type: ignore[no-untyped-call]
    if mass.grad is None or friction.grad is None:
        raise PushIdentError("The reference engine gave no gradient: the pusher never touches.")
    gradient = np.concatenate([mass.grad.numpy() * model.mass, friction.grad.numpy() * model.friction])
    return value, gradient, motion.poses[0][-1].detach().numpy()


def _relative(found: Float64Array, expected: Float64Array) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def _ratio(row: Json, engine: str) -> float:
    return float(row["reference"]["median_s"] / row[engine]["median_s"])


def _targets(summary: Json) -> list[Target]:
    rows = [row for row in summary["cells"] if row["cells"] == 100]
    return [
        Target(
            f"loss and gradient of a push of 1 s, 100 cells, step {_STEP} s: reference with autograd over compiled, {name}",
            "≥ 3000",
            f"{_ratio(row, name):.0f}",
            _ratio(row, name) >= 3000,
        )
        for row in rows
        for name in _COMPILED
    ]


def _tables(summary: Json) -> str:
    head = ["cells", "engine", "loss and gradient [ms]", "ratio", "error of the gradient", "error of the end [mm]"]
    rows = []
    for row in summary["cells"]:
        rows.append([f"{row['cells']}", "reference, autograd", milliseconds(row["reference"]), "1", "–", "–"])
        for name in _COMPILED:
            off = row["off"][name]
            rows.append(
                [
                    f"{row['cells']}",
                    f"compiled, {name}",
                    milliseconds(row[name]),
                    f"{_ratio(row, name):.0f}",
                    f"{off['gradient']:.0e}" if name == "pyramid" else "–",
                    millimetres(off["end_m"], 4),
                ]
            )
    return markdown_table(head, rows)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (ax,) = new_figure(1, width=5.6, height=4.2)
    cells = [row["cells"] for row in summary["cells"]]
    for name, colour in zip((_REFERENCE, *_COMPILED), ("#009e73", "#d55e00", "#0072b2"), strict=True):
        median, low, high = (1e3 * np.array([row[name][key] for row in summary["cells"]]) for key in ("median_s", "q25_s", "q75_s"))
        ax.plot(cells, median, "o-", color=colour, markersize=4, label="reference, autograd" if name == _REFERENCE else f"compiled, {name}")
        ax.fill_between(cells, low, high, color=colour, alpha=0.2, linewidth=0)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xticks(cells, [str(n) for n in cells])
    ax.set_xticks([], minor=True)
    ax.set_xlabel("cells")
    ax.set_ylabel(f"loss and gradient, push of 1 s, step {_STEP} s [ms]")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.legend(fontsize=8, frameon=False)
    ax.grid(alpha=0.3)
    save(figure, folder / "autograd.png")
    return {"autograd.png": "Time of loss and gradient against cells, medians and quartiles."}


STUDY = Benchmark(
    name="autograd",
    place=20,
    title="Against the reference engine with autograd",
    question=(
        f"Loss and gradient of pushes of 1 s with a time step of {_STEP} s: the paper's LCP with three velocities a cell in torch "
        "(ours, not the authors' code), differentiated by autograd, against the compiled engine. `pyramid` solves the problem of the "
        "reference; `circle`, the default, has Coulomb's circular cone, so its motion differs, and its gradient is that of another "
        "loss. Mean over the pushes of the medians (quartiles), with the largest differences from the reference."
    ),
    pieces=_pieces,
    summarise=lambda results: {"cells": list(results)},
    targets=_targets,
    tables=_tables,
    draw=_draw,
)
