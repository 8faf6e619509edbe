"""The compiled engine: time against the number of cells and the time step, memory, and the first call of a process."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, compile_kernels, loss_gradient, simulate
from push_ident.types import Float64Array, ObjectModel, PusherPath
from push_ident_sim.studies.common.measuring import interleaved, milliseconds, statistics
from push_ident_sim.studies.common.objects import FRAMES, distance_to, plate, plate_pushes
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table, millimetres

_CALLS: Final = ("rollout", "gradient", "jacobian")
_CELLS_ALONG: Final = (4, 10, 32, 100)
_GROWTH_FROM: Final = 1000
"""The exponent is fitted from this number of cells on; below, the cost of a step that does not depend on the cells is larger."""
_MEMORY_CELLS_ALONG: Final = (200, 400)
_STEPS: Final = (1 / 60, 1 / 240, 1 / 960)
_FINEST_STEP: Final = 1 / 15360
_STEP_CELLS_ALONG: Final = 10
_N_PUSHES: Final = 4
_AT_REST: Final = np.zeros(3)
_FIRST_CALL: Final = "from push_ident.physics.simulation import compile_kernels; compile_kernels()"


def _pieces(settings: Settings) -> list[Piece]:
    quick, seed = settings.quick, settings.seed
    along, rounds = ((4, 10), 2) if quick else (_CELLS_ALONG, 9)
    return [
        Piece("time against cells", _against_cells, (along, rounds, seed)),
        Piece("time against step", _against_step, (_STEPS[:2] if quick else _STEPS, rounds, seed)),
        *(Piece("memory", _memory, (n, seed)) for n in ((10,) if quick else _MEMORY_CELLS_ALONG)),
        Piece("first call", _first_call, (1 if quick else 5,)),
    ]


def _calls(model: ObjectModel, pushes: Sequence[PusherPath], settings: SimulationSettings) -> dict[str, Callable[[], object]]:
    even = replace(model, mass=np.full(len(model.mass), model.total_mass / len(model.mass)), friction=np.full(len(model.mass), 0.3))
    losses = [distance_to(simulate(even, PushScenario(push, _AT_REST, FRAMES), settings=settings).pose) for push in pushes]

    def rollout(jacobian: bool) -> None:
        for push in pushes:
            simulate(model, PushScenario(push, _AT_REST, FRAMES), settings=settings, jacobian=jacobian)

    def gradient() -> None:
        for push, loss in zip(pushes, losses, strict=True):
            loss_gradient(model, PushScenario(push, _AT_REST, FRAMES), loss, settings=settings)

    return {"rollout": partial(rollout, False), "gradient": gradient, "jacobian": partial(rollout, True)}


def _ends(model: ObjectModel, pushes: Sequence[PusherPath], settings: SimulationSettings) -> list[Float64Array]:
    return [simulate(model, PushScenario(push, _AT_REST, FRAMES[-1:]), settings=settings).pose[-1] for push in pushes]


def _mean_error(model: ObjectModel, ends: Sequence[Float64Array], others: Sequence[Float64Array]) -> float:
    """Cell error of `ends` against `others`, mean over the pushes [m]."""
    return float(np.mean([cell_error(model.shape.cells, a, b) for a, b in zip(ends, others, strict=True)]))


def _per_push(timing: Json) -> Json:
    return {key: value / _N_PUSHES if key.endswith("_s") else value for key, value in timing.items()}


def _against_cells(cells_along: Sequence[int], rounds: int, seed: int) -> Json:
    settings, pushes = SimulationSettings(), plate_pushes(_N_PUSHES, seed)
    models = {n: plate(n, seed) for n in cells_along}
    calls = {(n, what): call for n, model in models.items() for what, call in _calls(model, pushes, settings).items()}
    times, _ = interleaved(calls, rounds)
    finest = _ends(models[max(models)], pushes, settings)
    return {
        "cells": [
            {
                "cells": n**2,
                **{what: _per_push(times[n, what]) for what in _CALLS},
                "gradient_error": _gradient_error(model, pushes, settings, np.random.default_rng([seed, n])),
                "end_off_m": _mean_error(models[max(models)], _ends(model, pushes, settings), finest),
            }
            for n, model in models.items()
        ],
    }


def _gradient_error(model: ObjectModel, pushes: Sequence[PusherPath], settings: SimulationSettings, rng: np.random.Generator) -> float:
    """Gradient against central differences along a random change of both maps, relative; the median over the pushes."""
    d_mass, d_friction = (np.cos(model.shape.cells.centres @ rng.normal(size=2) * 50.0) for _ in range(2))

    def changed(h: float) -> ObjectModel:
        return replace(model, mass=model.mass * np.exp(h * d_mass), friction=model.friction * np.exp(h * d_friction))

    errors = []
    for push in pushes:
        loss = distance_to(simulate(changed(0.5), PushScenario(push, _AT_REST, FRAMES), settings=settings).pose)

        def slope(h: float, push: PusherPath = push, loss: Callable[[Float64Array], tuple[float, Float64Array]] = loss) -> float:
            ahead, behind = (
                loss(simulate(changed(s * h), PushScenario(push, _AT_REST, FRAMES), settings=settings).pose)[0] for s in (1, -1)
            )
            return (ahead - behind) / (2 * h)

        found = loss_gradient(model, PushScenario(push, _AT_REST, FRAMES), loss, settings=settings)
        exact = found.mass @ (model.mass * d_mass) + found.friction @ (model.friction * d_friction)
        # Richardson's extrapolation removes the error of the differences in h².
        errors.append(abs((4 * slope(1e-4) - slope(2e-4)) / 3 - exact) / abs(exact))
    return float(np.median(errors))


def _against_step(steps: Sequence[float], rounds: int, seed: int) -> Json:
    model, pushes = plate(_STEP_CELLS_ALONG, seed), plate_pushes(_N_PUSHES, seed)
    each = {step: SimulationSettings(step=step) for step in steps}
    times, _ = interleaved({step: _calls(model, pushes, settings)["rollout"] for step, settings in each.items()}, rounds)
    finest = _ends(model, pushes, SimulationSettings(step=_FINEST_STEP))
    return {
        "steps": [
            {
                "step_s": step,
                "rollout": _per_push(times[step]),
                "end_off_m": _mean_error(model, _ends(model, pushes, settings), finest),
            }
            for step, settings in each.items()
        ]
    }


def _memory(cells_along: int, seed: int) -> Json:
    """Rise of the peak of the memory above that of a process that has loaded everything."""
    model, push = plate(cells_along, seed), plate_pushes(1, seed)[0]
    compile_kernels()
    target = distance_to(simulate(plate(4, seed + 1), PushScenario(push, _AT_REST, FRAMES)).pose)
    before = _peak_after(lambda: None)
    gradient = _peak_after(lambda: loss_gradient(model, PushScenario(push, _AT_REST, FRAMES), target))
    jacobian = _peak_after(lambda: simulate(model, PushScenario(push, _AT_REST, FRAMES), jacobian=True))
    return {"memory": {"cells": cells_along**2, "before_b": before, "gradient_b": gradient - before, "jacobian_b": jacobian - before}}


def _peak_after(call: Callable[[], object]) -> int:
    """Highest resident memory of this process since the call began [byte]."""
    Path("/proc/self/clear_refs").write_text("5")
    call()
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])


def _first_call(repetitions: int) -> Json:
    """A new interpreter imports the engine, simulates and differentiates; the first one fills the cache of kernels."""
    wall, processor = [], []
    for _ in range(repetitions + 1):
        used, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run([sys.executable, "-c", _FIRST_CALL], check=True)
        wall.append(time.perf_counter() - started)
        now = resource.getrusage(resource.RUSAGE_CHILDREN)
        processor.append(now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime)
    return {"first_call": {"wall": statistics(wall[1:]), "processor": statistics(processor[1:])}}


def _summarise(results: Sequence[Json]) -> Json:
    summary = {key: value for result in results for key, value in result.items() if key != "memory"}
    large = [row for row in summary["cells"] if row["cells"] >= _GROWTH_FROM]
    sizes = [row["cells"] for row in large]
    summary["exponents"] = (
        {what: round(float(np.polyfit(np.log(sizes), np.log([row[what]["median_s"] for row in large]), 1)[0]), 3) for what in _CALLS}
        if len(large) > 1
        else {}
    )
    return summary | {"memory": [result["memory"] for result in results if "memory" in result]}


def _targets(summary: Json) -> list[Target]:
    row = next(row for row in summary["cells"] if row["cells"] == 100)
    ratio = row["jacobian"]["median_s"] / row["rollout"]["median_s"]
    wall = summary["first_call"]["wall"]["median_s"]
    targets = [
        Target("full Jacobian over the rollout, 100 cells", "≤ 6", f"{ratio:.2f}", ratio <= 6),
        Target("first call of a fresh process", "≤ 2 s", f"{wall:.2f} s (wall)", wall <= 2),
    ]
    if exponents := summary["exponents"]:
        worst = max(exponents.values())
        of = f"growth of the time of {', '.join(exponents)} from {_GROWTH_FROM} to 10,000 cells, largest exponent"
        targets.append(Target(of, "≤ 1.05", f"{worst:.2f}", worst <= 1.05))
    if len(summary["memory"]) > 1:
        few, many = summary["memory"]
        growth, more = max(many[f"{what}_b"] / few[f"{what}_b"] for what in ("gradient", "jacobian")), many["cells"] / few["cells"]
        of = f"growth of the memory of gradient and Jacobian from {few['cells']} to {many['cells']} cells"
        targets.append(Target(of, f"≤ {1.1 * more:.1f} times", f"{growth:.1f} times", growth <= 1.1 * more))
    return targets


def _tables(summary: Json) -> str:
    cells = [
        [
            f"{row['cells']}",
            *(milliseconds(row[what]) for what in _CALLS),
            f"{row['gradient_error']:.0e}",
            millimetres(row["end_off_m"], 3),
        ]
        for row in summary["cells"]
    ]
    head = [
        "cells", "rollout [ms]", "loss and gradient [ms]", "with Jacobian [ms]", "error of the gradient",
        "end against the finest cells [mm]",
    ]  # fmt: skip
    steps = [[f"1/{1 / row['step_s']:.0f}", milliseconds(row["rollout"]), millimetres(row["end_off_m"], 3)] for row in summary["steps"]]
    return "\n\n".join(
        [
            markdown_table(head, cells),
            f"Time step, {_STEP_CELLS_ALONG**2} cells, against a step of 1/{1 / _FINEST_STEP:.0f} s:",
            markdown_table(["step [s]", "rollout [ms]", "error of the end [mm]"], steps),
        ]
    )


STUDY = Benchmark(
    name="engine",
    title="The compiled engine",
    question=(
        f"A square plate, {_N_PUSHES} random pushes of 1 s in 240 steps; per push, median (quartiles). Gradient: of a loss of 31 "
        "poses by mass and friction of every cell, by the adjoint method, its error against central differences; Jacobian: of the "
        "poses."
    ),
    pieces=_pieces,
    summarise=_summarise,
    targets=_targets,
    tables=_tables,
)
