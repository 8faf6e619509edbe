"""Batched rollouts against single calls: pushes per second of a core, growth with the cells, threads, and where the pushes end."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import body_of_cells, simulate_body
from push_ident.planning.library import BATCH_STEP, DRAW_STEP, path_of
from push_ident.pushing.sampling import sample_push
from push_ident.types import Float64Array, ObjectModel, PusherPath
from push_ident_sim.recordings.truth import TruthSettings
from push_ident_sim.studies.common.measuring import interleaved, statistics
from push_ident_sim.studies.common.objects import plate, plate_pushes, random_object
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table, millimetres

_CELLS_ALONG: Final = 10
_CALLS: Final = ("single", "batch")
_N_MODELS: Final = 9
"""Maps of one plate in a batch: as many as the planner's library has models."""
_N_PUSHES: Final = 40
_END: Final = np.array([1.0])
"""When pushes of the plate end [s]."""
_AT_REST = np.zeros(3)
_STEPS: Final = {"objects": BATCH_STEP, "draws": DRAW_STEP}
"""Of pushes of random objects [s]: of all that is judged, and of models that may be true in a library."""


def _pieces(settings: Settings) -> list[Piece]:
    quick, seed = settings.quick, settings.seed
    rounds = 1 if quick else 9
    return [
        Piece("rates", _rates, (_CELLS_ALONG, rounds, seed)),
        Piece("threads", _threads, (2 if quick else 15, seed)),
        Piece("ends", _ends, (1 if quick else 10, 5 if quick else 30, seed)),
    ]


def _batch_models(models: Sequence[ObjectModel]) -> list[BatchModel]:
    return [BatchModel(body_of_cells(model.shape, model.mass, model.friction), model.pusher_friction) for model in models]


def _single(models: Sequence[ObjectModel], paths: Sequence[PusherPath], end: Float64Array) -> Callable[[], Float64Array]:
    """One call for each model and push, with default settings; gives the ends, shape (n_models, n_pushes, 3)."""
    bodies = [(model.shape, own.body, own.pusher_friction) for model, own in zip(models, _batch_models(models), strict=True)]
    scenarios = [PushScenario(path, _AT_REST, np.array([last])) for path, last in zip(paths, end, strict=True)]
    return lambda: np.array([[simulate_body(*body, scenario).pose[-1] for scenario in scenarios] for body in bodies])


def _batch(
    models: Sequence[ObjectModel], paths: Sequence[PusherPath], end: Float64Array, n_threads: int = 1, step: float = BATCH_STEP
) -> Callable[[], Float64Array]:
    own, pushes = _batch_models(models), [BatchPush(path, _AT_REST, np.array([last])) for path, last in zip(paths, end, strict=True)]
    return lambda: rollouts(models[0].shape, own, pushes, step=step, n_threads=n_threads)[:, :, -1]


def _rates(cells_along: int, rounds: int, seed: int) -> Json:
    models, paths = [plate(cells_along, seed + i) for i in range(_N_MODELS)], plate_pushes(_N_PUSHES, seed)
    end = np.repeat(_END, len(paths))
    calls = {"single": _single(models, paths, end), "batch": _batch(models, paths, end)}
    times, ends = interleaved(calls, rounds)
    n = len(models) * len(paths)
    return {
        "cells": cells_along**2,
        "calls": {name: {key: value / n if key.endswith("_s") else value for key, value in own.items()} for name, own in times.items()},
        "off": _spread(_distances(models[0], ends["single"].reshape(-1, 3), ends["batch"].reshape(-1, 3))),
    }


def _distances(model: ObjectModel, single: Float64Array, batch: Float64Array) -> list[float]:
    """Cell errors of the ends of a batch against those of single calls, shape (n, 3) each [m]."""
    return [cell_error(model.shape.cells, a, b) for a, b in zip(single, batch, strict=True)]


def _spread(errors: Sequence[float]) -> Json:
    median, late, worst = (float(v) for v in np.quantile(errors, [0.5, 0.95, 1.0]))
    return {"median_m": median, "q95_m": late, "worst_m": worst, "pushes": len(errors)}


def _threads(rounds: int, seed: int) -> Json:
    """One thread and two in turn, by both clocks: on a shared machine two threads seldom have two cores."""
    models, paths = [plate(_CELLS_ALONG, seed + i) for i in range(_N_MODELS)], plate_pushes(2 * _N_PUSHES, seed)
    n, calls = len(models) * len(paths), {k: _batch(models, paths, np.repeat(_END, len(paths)), k) for k in (1, 2)}
    wall: dict[int, list[float]] = {k: [] for k in calls}
    used: dict[int, list[float]] = {k: [] for k in calls}
    for call in calls.values():
        call()
    for _ in range(rounds):
        for k, call in calls.items():
            before = time.perf_counter(), time.process_time()
            call()
            wall[k].append((time.perf_counter() - before[0]) / n)
            used[k].append((time.process_time() - before[1]) / n)
    return {
        "threads": [
            {"threads": k, "wall": statistics(wall[k]), "used": statistics(used[k]), "cores": float(np.median(np.divide(used[k], wall[k])))}
            for k in calls
        ]
    }


def _ends(n_objects: int, n_pushes: int, seed: int) -> Json:
    """Straight pushes of random objects at the speed that the planner takes: where batches end, against single calls."""
    pushes, errors = TruthSettings().pushes, {name: list[float]() for name in _STEPS}
    speed = pushes.speed_range[0]
    for i in range(n_objects):
        rng = np.random.default_rng([seed, i])
        model = random_object(rng)
        plans = [sample_push(model.shape, _AT_REST, rng, pushes) for _ in range(n_pushes)]
        paths = [path_of(plan.tool_at_contact, plan.heading, plan.distance, speed, pushes) for plan in plans]
        end = np.array([path.time[-1] for path in paths])
        single = _single([model], paths, end)()[0]
        for name, step in _STEPS.items():
            errors[name] += _distances(model, single, _batch([model], paths, end, step=step)()[0])
    return {name: _spread(own) for name, own in errors.items()}


def _summarise(results: Sequence[Json]) -> Json:
    rows = [result for result in results if "cells" in result]
    rest = {key: value for result in results if "cells" not in result for key, value in result.items()}
    return {"rows": rows, **rest}


def _targets(summary: Json) -> list[Target]:
    row = next(row for row in summary["rows"] if row["cells"] == 100)
    times = row["calls"]["single"]["median_s"] / row["calls"]["batch"]["median_s"]
    off = max(row["off"]["worst_m"], summary["objects"]["worst_m"])
    one, two = summary["threads"]
    more = two["used"]["median_s"] / one["used"]["median_s"]
    faster = one["wall"]["q25_s"] / two["wall"]["q25_s"]
    return [
        Target("batched pushes a second of a core over single calls, 100 cells", "≥ 3", f"{times:.2f}", times >= 3.0),
        Target(
            "ends of batched pushes, the worst",
            "≤ 0.3 mm",
            f"{1e3 * off:.2f} mm",
            off <= 3e-4,
        ),
        Target("processor time of a batched push, two threads over one", "≤ 1.05", f"{more:.2f}", more <= 1.05),
        Target(
            "the same by the wall clock, the fastest quarter of the rounds",
            "≥ 1.9",
            f"{faster:.2f}, of {two['cores']:.2f} cores",
            faster >= 1.9,
        ),
    ]


def _per_second(timing: Json) -> str:
    return f"{1 / timing['median_s']:.0f} ({1 / timing['q75_s']:.0f}–{1 / timing['q25_s']:.0f})"


def _distance(off: Json) -> str:
    return "/".join(millimetres(off[key], 2) for key in ("median_m", "q95_m", "worst_m"))


def _tables(summary: Json) -> str:
    head = ["cells", "single calls, a second", "batch, a second", "ratio", "ends, median/95 %/worst [mm]"]
    rows = []
    for row in summary["rows"]:
        single, batch = (row["calls"][name] for name in _CALLS)
        ratio = f"{single['median_s'] / batch['median_s']:.2f}"
        rows.append([f"{row['cells']}", _per_second(single), _per_second(batch), ratio, _distance(row["off"])])
    rows.append([f"random objects, {summary['objects']['pushes']} pushes", "", "", "", _distance(summary["objects"])])
    steps = f"the same with steps of 1/{1 / DRAW_STEP:.0f} s"
    rows.append([steps, "", "", "", _distance(summary["draws"])])
    return markdown_table(head, rows)


STUDY = Benchmark(
    name="batches",
    title="Rollouts in batches",
    question=(
        f"{_N_PUSHES} pushes of 1 s of a square plate under {_N_MODELS} maps: each by a call with the default step of 1/240 s, and all "
        f"in one call with the planner's step of 1/{1 / BATCH_STEP:.0f} s. Ends: cell error against the single calls, also for the step "
        "of the models in the planner's library."
    ),
    pieces=_pieces,
    summarise=_summarise,
    targets=_targets,
    tables=_tables,
)
