"""Time of planning a push to a goal: the first plan of what is known of an object, and the further ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from push_ident.geometry.se2 import compose
from push_ident.physics.simulation import compile_kernels
from push_ident.planning.goal import Goal
from push_ident.planning.kernels import compile_planning
from push_ident.types import Float64Array
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.benchmark import Benchmark, Piece, Settings, Target
from push_ident_sim.studies.common.drawing import markdown_table
from push_ident_sim.studies.common.plate import plate_in_bullet
from push_ident_sim.studies.common.pushed import IDENTIFIED, PushedObject
from push_ident_sim.studies.common.random_objects import random_object
from push_ident_sim.studies.goals.run import LEVELS

__all__ = ["STUDY"]

_CELLS: Final = (90, 120)
"""Objects have as many cells."""
_NEAR: Final = (0.04, 0.5)
_FAR: Final = (0.25, 2.0)
"""Largest distance along each axis [m] and angle [rad] of a goal: the last pushes to it, and the first."""
_AIM_FIRST: Final = 1.0
"""[s]"""
_AIM: Final = 0.033
"""Of 99 % of the further plans, to correct a push at the rate of a camera [s]."""


def _pieces(settings: Settings) -> list[Piece]:
    n_objects, n_goals = (1, 1) if settings.quick else (4, 8)
    return [Piece(f"object {i + 1}", _measure, (settings.seed + i, n_goals)) for i in range(n_objects)]


def _measure(seed: int, n_goals: int) -> Json:
    compile_kernels()
    compile_planning()
    rng = np.random.default_rng([seed, 1])
    thing = random_object(rng)
    while not _CELLS[0] <= len(thing.shape.cells) <= _CELLS[1]:
        thing = random_object(rng)
    pushed = PushedObject(plate_in_bullet(thing), IDENTIFIED, rng)
    try:
        first = _timed(partial(_plan, pushed, Goal(_near(pushed.pose, _FAR, rng))))
        again = []
        for _ in range(n_goals):
            for level, tolerance in LEVELS.items():
                for far, room in ((False, _NEAR), (True, _FAR)):
                    goal = Goal(_near(pushed.pose, room, rng), *tolerance)
                    again.append({"level": level, "far": far, **_timed(partial(_plan, pushed, goal))})
    finally:
        pushed.close()
    return {"cells": len(thing.shape.cells), "first": first, "again": again}


def _plan(pushed: PushedObject, goal: Goal) -> None:
    pushed.planner.plan(pushed.belief, *pushed.observe(), goal)


def _near(pose: Float64Array, room: tuple[float, float], rng: np.random.Generator) -> Float64Array:
    """A pose within a distance along each axis [m] and an angle [rad] of another one, shape (3,)."""
    return compose(pose, rng.uniform(-1.0, 1.0, 3) * [room[0], room[0], room[1]])


def _timed(call: Callable[[], object]) -> Json:
    wall, used = time.perf_counter(), time.process_time()
    call()
    return {"wall": time.perf_counter() - wall, "used": time.process_time() - used}


def _summarise(results: Sequence[Json]) -> Json:
    again = [plan for result in results for plan in result["again"]]
    rows = {"first plan": [result["first"] for result in results]}
    rows |= {f"further, goal {'far' if far else 'near'}": [p for p in again if p["far"] is far] for far in (False, True)}
    rows["further, all"] = again
    return {
        "cells": [result["cells"] for result in results],
        "rows": {
            name: {"plans": len(own), **{clock: _quantiles([p[clock] for p in own]) for clock in ("used", "wall")}}
            for name, own in rows.items()
        },
    }


def _quantiles(seconds: Sequence[float]) -> Json:
    median, late, worst = (float(v) for v in np.quantile(seconds, [0.5, 0.99, 1.0]))
    return {"median_s": median, "p99_s": late, "worst_s": worst}


def _targets(summary: Json) -> list[Target]:
    first, again = summary["rows"]["first plan"], summary["rows"]["further, all"]
    return [
        Target(
            "first plan of a push to a goal, about 100 cells, the slowest object",
            f"≤ {_AIM_FIRST:g} s",
            f"{first['wall']['worst_s']:.2f} s ({first['used']['worst_s']:.2f} s of the processor)",
            first["wall"]["worst_s"] <= _AIM_FIRST,
        ),
        Target(
            "further plans of a push to a goal, 99 %",
            f"≤ {1e3 * _AIM:.0f} ms",
            f"{1e3 * again['wall']['p99_s']:.0f} ms ({1e3 * again['used']['p99_s']:.0f} ms of the processor)",
            again["wall"]["p99_s"] <= _AIM,
        ),
    ]


def _tables(summary: Json) -> str:
    rows = [
        [name, f"{own['plans']}", *(" / ".join(f"{1e3 * own[clock][key]:.0f}" for key in own[clock]) for clock in ("used", "wall"))]
        for name, own in summary["rows"].items()
    ]
    cells = ", ".join(str(n) for n in summary["cells"])
    head = ["", "plans", "of the processor, all threads [ms]", "by the wall clock [ms]"]
    return markdown_table(head, rows) + f"\n\nMedian / 99 % / worst; objects of {cells} cells."


STUDY = Benchmark(
    name="plans",
    place=45,
    title="Planning a push to a goal",
    question=(
        "Random objects of about 100 cells of which three random pushes in Bullet have been identified. The first plan simulates the "
        "library of strokes under nine models; further plans with the same model look up in it, improve the best pushes by the exact "
        "derivative and judge them by 33 models. Goals are near (within 4 cm and 0.5 rad along each axis) and far (25 cm, 2 rad), with the "
        "three tolerances of the experiment on goals. The planner takes all cores; the wall clock counts what others do on the machine."
    ),
    pieces=_pieces,
    summarise=_summarise,
    targets=_targets,
    tables=_tables,
    draw=lambda summary, folder: {},
)
