"""Where a known object ends in MuJoCo and Bullet, against the model with the same object: what is left of a scene that is corrected."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, compile_kernels, simulate
from push_ident.types import Float64Array
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, make_pushes, observe_motion, true_model
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table, millimetres
from push_ident_sim.studies.scenes import any_scene_of_bullet, plain_scene

_N_OBJECTS: Final = 2
"""Ground truths of each object."""
_N_PUSHES: Final = 10
_FINE: Final = SimulationSettings(step=1 / 1920, resolve_events=True)
_LIMIT: Final = 5e-4
"""Of the aim [m]."""
_ENGINES: Final = ("MuJoCo", "Bullet with a cone of friction", "Bullet with its pyramid")


def _pieces(settings: Settings) -> list[Piece]:
    if settings.quick:
        return [Piece("hammer", _measure, ("hammer", settings.seed, 1))]
    return [
        Piece(f"{name}, ground truth {k + 1}", _measure, (name, settings.seed + k, _N_PUSHES))
        for name in OBJECT_NAMES
        for k in range(_N_OBJECTS)
    ]


def _measure(name: str, seed: int, n_pushes: int) -> Json:
    compile_kernels()
    sim_object, truth = make_object(name, seed), TruthSettings(n_train=n_pushes, n_test=0)
    model, radius = true_model(sim_object), truth.pushes.pusher_radius
    with tempfile.TemporaryDirectory() as folder:
        in_mujoco = plain_scene(Path(folder), model.shape.outline, radius, model.pusher_friction)
        in_bullet = any_scene_of_bullet(Path(folder)).with_object(model).with_precise_contact(model.pusher_friction)
        scenes = (
            in_mujoco.with_object(model).with_precise_contact(model.pusher_friction),
            in_bullet,
            replace(in_bullet, precise=False),
        )
        rows: list[Json] = []
        for number, motion in enumerate(make_pushes(sim_object, [seed, 8], truth)):
            path = observe_motion(motion, radius, CameraNoise(), np.random.default_rng([seed, number]))[1]
            start, times = motion.pose[0], path.time[-1:]
            end = simulate(model, PushScenario(path, start, times), settings=_FINE).pose[-1]
            off = [cell_error(model.shape.cells, end, scene.simulate(start, path, times)[-1]) for scene in scenes]
            rows.append({"way_m": cell_error(model.shape.cells, end, start), "off_m": off})
    return {"object": name, "seed": seed, "pushes": rows}


def _off(summary: Json) -> dict[str, Float64Array]:
    """Cell errors at the end of all pushes [m], shape (n_pushes,), by engine."""
    rows = np.array([push["off_m"] for one in summary["objects"] for push in one["pushes"]])
    return dict(zip(_ENGINES, rows.T, strict=True))


def _targets(summary: Json) -> list[Target]:
    targets = []
    for engine, off in list(_off(summary).items())[:2]:
        near = float(np.mean(off <= _LIMIT))
        targets.append(Target(f"ends within 0.5 mm of the model, {engine}", "≥ 95 %", f"{near:.0%} of {len(off)}", near >= 0.95))
    return targets


def _tables(summary: Json) -> str:
    head = ["engine", "pushes", "median [mm]", "90 % [mm]", "worst [mm]", "within 0.5 mm"]
    rows = []
    for engine, off in _off(summary).items():
        errors = [millimetres(float(value)) for value in (np.median(off), np.quantile(off, 0.9), off.max())]
        rows.append([engine, f"{len(off)}", *errors, f"{np.mean(off <= _LIMIT):.0%}"])
    return markdown_table(head, rows)


STUDY = Benchmark(
    name="exports",
    title="A known object in other engines",
    question=(
        f"{_N_OBJECTS} ground truths of each of the {len(OBJECT_NAMES)} objects in a corrected scene, {_N_PUSHES} random pushes of each: "
        "how far its ends lie from those of the model with the same object, at a step of 1/1920 s. The difference is what an engine does "
        "otherwise. Pushes that slip round a corner, or stick and slip, magnify it."
    ),
    pieces=_pieces,
    summarise=lambda results: {"objects": list(results)},
    targets=_targets,
    tables=_tables,
)
