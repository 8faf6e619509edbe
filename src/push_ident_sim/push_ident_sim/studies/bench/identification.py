"""The default method to convergence, from four and ten pushes of an object of 100 cells, and its update at each frame of a push."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.identification.identify import identify
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.result import Identification
from push_ident.physics.simulation import compile_kernels
from push_ident.types import PoseTrack, PusherPath, PushRecord
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, make_pushes, observe_motion
from push_ident_sim.studies.common.measuring import MODELS, N_TRAIN, late_quantiles, statistics
from push_ident_sim.studies.common.objects import plate, plate_in_bullet
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table, millimetres

_CELLS_ALONG: Final = 10
_MORE: Final = 10
"""Pushes of the longer solve."""


def _pieces(settings: Settings) -> list[Piece]:
    truths, repetitions, n_test = (1, 1, 1) if settings.quick else (4, 7, 6)
    return [Piece(f"ground truth {i + 1}", _solve, (settings.seed + i, repetitions, n_test)) for i in range(truths)]


def _solve(seed: int, repetitions: int, n_test: int) -> Json:
    compile_kernels()
    model, settings = plate(_CELLS_ALONG, seed), TruthSettings(n_train=_MORE, n_test=n_test)
    records = [
        PushRecord(
            "plate",
            model.shape,
            *observe_motion(motion, settings.pushes.pusher_radius, CameraNoise(), np.random.default_rng([seed, i, 3])),
        )
        for i, motion in enumerate(make_pushes(plate_in_bullet(model), [seed, 2], settings))
    ]
    train, test = records[:_MORE], records[_MORE:]
    seconds: dict[int, list[float]] = {N_TRAIN: [], _MORE: []}
    results: dict[int, Identification] = {}
    for _ in range(repetitions):
        for n, of_solves in seconds.items():
            started = time.process_time()
            results[n] = identify(train[:n])
            of_solves.append(time.process_time() - started)
    last = results[N_TRAIN]
    models = zip(MODELS, (last.model, last.scalar, last.uniform, model), strict=True)
    return {
        "seed": seed,
        "processor": statistics(seconds[N_TRAIN]),
        "processor_more": statistics(seconds[_MORE]),
        "updates": late_quantiles(_seconds_of_updates(train[: N_TRAIN + 1])),
        "simulations": last.n_simulations,
        "simulations_more": results[_MORE].n_simulations,
        "status": last.status.name.lower(),
        "status_more": results[_MORE].status.name.lower(),
        **{f"{name}_m": float(np.mean(held_out_errors(one, test))) for name, one in models},
    }


def _seconds_of_updates(records: Sequence[PushRecord]) -> list[float]:
    """Processor time of the update at each frame of the last push, in which the pusher touches the object, after those before [s]."""
    online, push, seconds = OnlineIdentifier(OnlineIdentifier.new(records[0].shape)), records[-1], list[float]()
    for record in records[:-1]:
        online.add(record)
    for n in range(2, len(push.poses.time) + 1):
        poses, pusher = push.poses, push.pusher
        poses_so_far = PoseTrack(poses.time[:n], poses.pose[:n], poses.covariance[:n], poses.camera)
        known = np.searchsorted(pusher.time, poses_so_far.time[-1], side="right")
        if known < 2:
            continue
        partial = replace(push, poses=poses_so_far, pusher=PusherPath(pusher.time[:known], pusher.position[:known], pusher.radius))
        started = time.process_time()
        if online.update(partial) is not None:
            seconds.append(time.process_time() - started)
    return seconds


def _targets(summary: Json) -> list[Target]:
    solves = summary["solves"]
    few, more = (max(solve[key]["median_s"] for solve in solves) for key in ("processor", "processor_more"))
    late = max(solve["updates"]["p99_s"] for solve in solves)
    what = f"{_CELLS_ALONG**2} cells, the slowest of {len(solves)}"
    return [
        Target(f"{N_TRAIN} pushes, {what} (the paper: 30 s)", "≤ 0.5 s", f"{few:.2f} s", few <= 0.5 and _converged(solves, "status")),
        Target(f"{_MORE} pushes, {what}", "≤ 3 s", f"{more:.2f} s", more <= 3.0 and _converged(solves, "status_more")),
        Target(f"update at a frame of a push, 99 %, {what}", "≤ 33 ms", f"{1e3 * late:.0f} ms", late <= 0.033),
    ]


def _converged(solves: list[Json], key: str) -> bool:
    """Whether all solves did, by a key of their status: one that gave up early is no quick one."""
    return all(solve[key] == "converged" for solve in solves)


def _tables(summary: Json) -> str:
    head = ["seed", f"{N_TRAIN} pushes: processor [s]", "simulations", "ended", f"{_MORE} pushes: processor [s]", "simulations"]
    head += ["update at a frame: median, 99 % [ms]", *(f"{name} [mm]" for name in MODELS)]
    text = "{median_s:.2f} ({q25_s:.2f}–{q75_s:.2f})"
    rows = [
        [
            f"{solve['seed']}",
            text.format(**solve["processor"]),
            f"{solve['simulations']}",
            solve["status"],
            text.format(**solve["processor_more"]),
            f"{solve['simulations_more']}",
            f"{1e3 * solve['updates']['median_s']:.0f}, {1e3 * solve['updates']['p99_s']:.0f}",
            *(millimetres(solve[f"{name}_m"]) for name in MODELS),
        ]
        for solve in summary["solves"]
    ]
    return markdown_table(head, rows)


STUDY = Benchmark(
    name="identification",
    title="Identification to convergence",
    question=(
        f"`identify` with its default method on {N_TRAIN} and {_MORE} pushes of a plate of {_CELLS_ALONG**2} cells, made by Bullet, and "
        f"the update at each frame of push {N_TRAIN + 1}. Errors: mean cell error of {N_TRAIN} pushes on six held-out ones."
    ),
    pieces=_pieces,
    summarise=lambda results: {"solves": list(results)},
    targets=_targets,
    tables=_tables,
)
