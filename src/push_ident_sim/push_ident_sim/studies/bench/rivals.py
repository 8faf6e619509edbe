"""The same object from the same pushes: this package, and MuJoCo with the optimiser of its identification toolbox.

`mujoco.sysid` fits parameters of a scene by `mujoco.minimize.least_squares`, with derivatives by finite differences. It gets what the
default method has: the friction of each cell and of the pusher, with the same prior, poses of all frames, and contact that does not creep.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.unknowns.mechanics import uniform_model
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.simulation import compile_kernels
from push_ident.simulators.mujoco_scene import MujocoScene
from push_ident.types import Float64Array, ObjectModel, PushRecord
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, make_pushes, observe_motion
from push_ident_sim.studies.common.objects import plate, plate_in_bullet
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table, millimetres, number
from push_ident_sim.studies.scenes import plain_scene

_CELLS_ALONG: Final = 5
_N_TRAIN: Final = 6
_DIFFERENCE: Final = 1e-3
"""Of the logarithm of a parameter, for finite differences [1]: the simulation is not smooth to rounding."""
_PRIOR: Final = Prior()


def _pieces(settings: Settings) -> list[Piece]:
    if settings.quick:
        return [Piece("ground truth 1", _solve, (settings.seed, 3, 2, 1))]
    return [Piece(f"ground truth {i + 1}", _solve, (settings.seed + i, _CELLS_ALONG, _N_TRAIN, 10)) for i in range(2)]


def _solve(seed: int, cells_along: int, n_train: int, iterations: int) -> Json:
    compile_kernels()
    model, settings = plate(cells_along, seed), TruthSettings(n_train=n_train, n_test=n_train)
    radius = settings.pushes.pusher_radius
    records = [
        PushRecord("plate", model.shape, *observe_motion(motion, radius, CameraNoise(), np.random.default_rng([seed, i, 3])))
        for i, motion in enumerate(make_pushes(plate_in_bullet(model), [seed, 4], settings))
    ]
    train, test = records[:n_train], records[n_train:]
    started = time.process_time()
    ours = identify(train)
    seconds = time.process_time() - started
    result = {
        "seed": seed,
        "cells": len(model.mass),
        "equal_m": float(np.mean(held_out_errors(ours.uniform, test))),
        "ours": {"seconds": seconds, "error_m": float(np.mean(held_out_errors(ours.model, test)))},
    }
    with tempfile.TemporaryDirectory() as folder:
        scene = plain_scene(Path(folder), model.shape.outline, radius, _PRIOR.pusher_friction)
        return {**result, "mujoco": _by_mujoco(scene, uniform_model(model.shape, _PRIOR), train, test, iterations)}


def _by_mujoco(scene: MujocoScene, start: ObjectModel, train: Sequence[PushRecord], test: Sequence[PushRecord], iterations: int) -> Json:
    """Errors and processor time after each iteration."""
    from mujoco import minimize

    stds = np.r_[np.full(len(start.mass), _PRIOR.friction_map_std), _PRIOR.pusher_friction_std]
    observed = [observe_push(record) for record in train]

    def scene_of(x: Float64Array) -> MujocoScene:
        model = replace(start, friction=start.friction * np.exp(x[:-1]), pusher_friction=start.pusher_friction * float(np.exp(x[-1])))
        return scene.with_object(model).with_precise_contact(model.pusher_friction)

    def residual(columns: Float64Array) -> Float64Array:
        return np.column_stack([_residual(scene_of(x), train, observed, x / stds) for x in columns.T])

    def error(x: Float64Array) -> float:
        corrected, errors = scene_of(x), []
        for record in test:
            seen = observe_push(record)
            end = corrected.simulate(seen.pose[0], record.pusher, seen.time[-1:])[-1]
            errors.append(cell_error(record.shape.cells, end, seen.pose[-1]))
        return float(np.mean(errors))

    first, started = np.zeros(len(stds)), time.process_time()
    x, trace = minimize.least_squares(first, residual, eps=_DIFFERENCE, max_iter=iterations, verbose=0)
    seconds = time.process_time() - started
    return {"seconds": seconds, "iterations": len(trace), "before_m": error(first), "error_m": error(x)}


def _residual(scene: MujocoScene, records: Sequence[PushRecord], observed: Sequence, prior: Float64Array) -> Float64Array:
    rows = []
    for record, seen in zip(records, observed, strict=True):
        difference = scene.simulate(seen.pose[0], record.pusher, seen.time) - seen.pose
        rows.append(np.einsum("fij,fj->fi", seen.whitening, difference).ravel())
    return np.concatenate([*rows, prior])


def _targets(summary: Json) -> list[Target]:
    solves = summary["solves"]
    faster = float(np.median([solve["mujoco"]["seconds"] / solve["ours"]["seconds"] for solve in solves]))
    nearer = float(np.median([solve["mujoco"]["error_m"] / solve["ours"]["error_m"] for solve in solves]))
    held = faster >= 10.0 and nearer >= 1.0
    return [Target("processor time and error of MuJoCo over ours, medians", "≥ 10, ≥ 1", f"{faster:.0f}, {nearer:.2f}", held)]


def _tables(summary: Json) -> str:
    head = ["seed", "cells", "equal cells [mm]", "ours [mm]", "MuJoCo [mm]", "ours [s]", "MuJoCo [s]", "iterations"]
    rows = []
    for solve in summary["solves"]:
        ours, mujoco = solve["ours"], solve["mujoco"]
        errors = [millimetres(one) for one in (solve["equal_m"], ours["error_m"], mujoco["error_m"])]
        seconds = [number(ours["seconds"], "{:.2f}"), number(mujoco["seconds"], "{:.0f}")]
        rows.append([f"{solve['seed']}", f"{solve['cells']}", *errors, *seconds, f"{mujoco['iterations']}"])
    return markdown_table(head, rows)


STUDY = Benchmark(
    name="rivals",
    title="The same pushes identified with MuJoCo",
    question=(
        f"A plate of {_CELLS_ALONG**2} cells, {_N_TRAIN} pushes in Bullet, processor time and mean cell error on as many other pushes: "
        "`identify` with its default method, and `mujoco.minimize`, the optimiser of `mujoco.sysid`, on a MuJoCo scene whose cells have "
        "the same unknown friction with the same prior, ten iterations at most. Ours also fits where the load lies. Equal cells: without "
        "pushes."
    ),
    pieces=_pieces,
    summarise=lambda results: {"solves": list(results)},
    targets=_targets,
    tables=_tables,
)
