"""The default method to convergence: four pushes of an object of 100 cells."""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.physics.simulation import compile_kernels
from push_ident.types import PushRecord
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, make_pushes, observe_motion
from push_ident_sim.studies.common.measuring import MODELS, N_TRAIN, statistics
from push_ident_sim.studies.common.objects import plate, plate_in_bullet
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table, millimetres

_CELLS_ALONG: Final = 10


def _pieces(settings: Settings) -> list[Piece]:
    truths, repetitions, n_test = (1, 1, 1) if settings.quick else (4, 7, 6)
    return [Piece(f"ground truth {i + 1}", _solve, (settings.seed + i, repetitions, n_test)) for i in range(truths)]


def _solve(seed: int, repetitions: int, n_test: int) -> Json:
    compile_kernels()
    model, settings = plate(_CELLS_ALONG, seed), TruthSettings(n_train=N_TRAIN, n_test=n_test)
    records = [
        PushRecord(
            "plate",
            model.shape,
            *observe_motion(motion, settings.pushes.pusher_radius, CameraNoise(), np.random.default_rng([seed, i, 3])),
        )
        for i, motion in enumerate(make_pushes(plate_in_bullet(model), [seed, 2], settings))
    ]
    train, test = records[:N_TRAIN], records[N_TRAIN:]
    results, processor = [], []
    for _ in range(repetitions):
        started = time.process_time()
        results.append(identify(train))
        processor.append(time.process_time() - started)
    last = results[-1]
    models = zip(MODELS, (last.model, last.scalar, last.uniform, model), strict=True)
    return {
        "seed": seed,
        "wall": statistics([result.time_s for result in results]),
        "processor": statistics(processor),
        "simulations": last.n_simulations,
        "status": last.status.name.lower(),
        **{f"{name}_m": float(np.mean(held_out_errors(one, test))) for name, one in models},
    }


def _targets(summary: Json) -> list[Target]:
    solves = summary["solves"]
    slowest = max(solves, key=lambda solve: float(solve["processor"]["median_s"]))
    wall, processor = (slowest[clock]["median_s"] for clock in ("wall", "processor"))
    return [
        Target(
            f"{N_TRAIN} pushes, {_CELLS_ALONG**2} cells, the slowest of {len(solves)} (the paper: 30 s)",
            "≤ 0.5 s",
            f"{processor:.2f} s (wall: {wall:.2f} s)",
            processor <= 0.5 and all(solve["status"] == "converged" for solve in solves),
        )
    ]


def _tables(summary: Json) -> str:
    head = ["seed", "processor [s]", "simulations", "ended", *(f"{name} [mm]" for name in MODELS)]
    rows = [
        [
            f"{solve['seed']}",
            "{median_s:.2f} ({q25_s:.2f}–{q75_s:.2f})".format(**solve["processor"]),
            f"{solve['simulations']}",
            solve["status"],
            *(millimetres(solve[f"{name}_m"]) for name in MODELS),
        ]
        for solve in summary["solves"]
    ]
    return markdown_table(head, rows)


STUDY = Benchmark(
    name="identification",
    title="Identification to convergence",
    question=(
        f"`identify` with its default method on {N_TRAIN} pushes of a plate of {_CELLS_ALONG**2} cells, made by Bullet. Errors: "
        "mean cell error on six held-out pushes."
    ),
    pieces=_pieces,
    summarise=lambda results: {"solves": list(results)},
    targets=_targets,
    tables=_tables,
)
