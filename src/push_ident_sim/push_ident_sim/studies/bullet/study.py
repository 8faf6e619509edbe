"""The compiled engine against PyBullet with finite differences: time of a rollout and of a gradient, and the error of the gradient."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.cells import cell_error
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import loss_gradient, simulate
from push_ident.types import Float64Array, ObjectModel, PusherPath
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.benchmark import Benchmark, Piece, Settings
from push_ident_sim.studies.common.drawing import markdown_table, millimetres
from push_ident_sim.studies.common.plate import FRAMES, distance_to, plate, plate_in_bullet, plate_pushes
from push_ident_sim.studies.common.timing import interleaved, milliseconds

__all__ = ["STUDY"]

_CELLS_ALONG = 10
_STEPS = (1e-4, 1e-2)
"""Relative changes of a parameter in finite differences."""
_REPEATS = 25
"""Repeats of a compiled call in its turn, as it is much shorter."""
_AT_REST = np.zeros(3)

_Rollout = Callable[[ObjectModel], Float64Array]
"""Poses at `FRAMES`, shape (31, 3)."""


def _pieces(settings: Settings) -> list[Piece]:
    along, n_pushes, n_cells, rounds = (4, 1, 1, 1) if settings.quick else (_CELLS_ALONG, 3, 3, 3)
    seeds = np.random.SeedSequence([settings.seed, 3]).generate_state(n_pushes).tolist()
    return [
        Piece(f"PyBullet, push {i + 1}", _compare, (along, push, n_cells, rounds, settings.seed, seed))
        for i, (push, seed) in enumerate(zip(plate_pushes(n_pushes, settings.seed), seeds, strict=True))
    ]


def _compare(cells_along: int, push: PusherPath, n_cells: int, rounds: int, seed: int, cell_seed: int) -> Json:
    from push_ident_sim.engines.bullet.push_world import PushWorld

    model = plate(cells_along, seed)
    world = PushWorld(plate_in_bullet(model), push.radius)
    loss = distance_to(simulate(plate(cells_along, seed + 1), PushScenario(push, _AT_REST, FRAMES)).pose)
    times, _ = interleaved(
        {
            "bullet": lambda: world.push(_AT_REST, push, longest_rest=0.0),
            "rollout": lambda: simulate(model, PushScenario(push, _AT_REST, FRAMES)),
            "gradient": lambda: loss_gradient(model, PushScenario(push, _AT_REST, FRAMES), loss),
        },
        rounds,
        {"rollout": _REPEATS, "gradient": _REPEATS},
    )
    world.close()

    cells = np.random.default_rng(cell_seed).choice(cells_along**2, n_cells, replace=False)
    result = loss_gradient(model, PushScenario(push, _AT_REST, FRAMES), loss)
    exact = np.concatenate([(result.mass * model.mass)[cells], (result.friction * model.friction)[cells]])
    rollouts: dict[str, _Rollout] = {"bullet": partial(_bullet_poses, push), "compiled": partial(_compiled_poses, push)}
    quotients = {name: [_differences(rollout, model, cells, loss, step) for step in _STEPS] for name, rollout in rollouts.items()}
    ends = [rollout(model)[-1] for rollout in rollouts.values()]
    return {
        "cells": cells_along**2,
        "times": times,
        "end_off_m": cell_error(model.shape.cells, *ends),
        "exact": exact.tolist(),
        "differences": {name: [d.tolist() for d in own] for name, own in quotients.items()},
    }


def _compiled_poses(push: PusherPath, model: ObjectModel) -> Float64Array:
    return simulate(model, PushScenario(push, _AT_REST, FRAMES)).pose


def _bullet_poses(push: PusherPath, model: ObjectModel) -> Float64Array:
    from push_ident_sim.engines.bullet.push_world import PushWorld

    world = PushWorld(plate_in_bullet(model), push.radius)
    motion = world.push(_AT_REST, push, longest_rest=0.0)
    world.close()
    return np.column_stack([np.interp(FRAMES, motion.time, column) for column in motion.pose.T])


def _differences(
    rollout: _Rollout, model: ObjectModel, cells: NDArray[np.int64], loss: Callable[[Float64Array], tuple[float, Float64Array]], step: float
) -> Float64Array:
    """Central differences of the loss by the logarithms of mass, then of friction, of `cells`."""
    slopes = []
    for name in ("mass", "friction"):
        for cell in cells:
            sides = []
            for sign in (1, -1):
                values = getattr(model, name).copy()
                values[cell] *= np.exp(sign * step)
                sides.append(loss(rollout(replace(model, **{name: values})))[0])
            slopes.append((sides[0] - sides[1]) / (2 * step))
    return np.array(slopes)


def _off(found: Sequence[float], expected: Sequence[float]) -> str:
    """Relative difference of two vectors."""
    return f"{np.linalg.norm(np.subtract(found, expected)) / np.linalg.norm(expected):.1e}"


def _cosine(a: Sequence[float], b: Sequence[float]) -> str:
    return f"{np.dot(a, b) / (np.linalg.norm(a) * np.linalg.norm(b)):.4f}"


def _summarise(results: Sequence[Json]) -> Json:
    medians = {name: float(np.median([r["times"][name]["median_s"] for r in results])) for name in ("bullet", "rollout", "gradient")}
    # One-sided differences, the cheapest: one rollout more than there are parameters.
    rollouts = 2 * results[0]["cells"] + 1
    return {
        "pushes": list(results),
        "rollouts_for_a_gradient": rollouts,
        "bullet_gradient_s": rollouts * medians["bullet"],
        "rollout_ratio": medians["bullet"] / medians["rollout"],
        "gradient_ratio": rollouts * medians["bullet"] / medians["gradient"],
    }


def _tables(summary: Json) -> str:
    pushes = summary["pushes"]
    head = ["push", "PyBullet, rollout [ms]", "compiled, rollout [ms]", "compiled, loss and gradient [ms]", "distance of the ends [mm]"]
    times = [
        [f"{i + 1}", *(milliseconds(p["times"][name]) for name in ("bullet", "rollout", "gradient")), millimetres(p["end_off_m"], 3)]
        for i, p in enumerate(pushes)
    ]
    quality = []
    for i, p in enumerate(pushes):
        for j, step in enumerate(_STEPS):
            ours, bullets = p["differences"]["compiled"][j], p["differences"]["bullet"]
            found = bullets[j]
            before = [_off(found, bullets[j - 1]), _cosine(found, bullets[j - 1])] if j else ["–", "–"]
            quality.append([f"{i + 1}, {step:g}", _off(ours, p["exact"]), *before, _off(found, p["exact"]), _cosine(found, p["exact"])])
    return "\n\n".join(
        [
            markdown_table(head, times),
            f"A gradient by one-sided differences takes {summary['rollouts_for_a_gradient']} rollouts in PyBullet, at these times "
            f"{summary['bullet_gradient_s']:.0f} s (extrapolated, not run): {summary['gradient_ratio']:.0f} times the exact gradient. "
            f"A rollout takes {summary['rollout_ratio']:.0f} times as long.",
            f"Central differences with respect to mass and friction of {len(pushes[0]['exact']) // 2} cells drawn at random; relative "
            "differences between vectors of slopes, and the cosines between them:",
            markdown_table(
                [
                    "push, relative step",
                    "compiled, against its exact gradient",
                    "PyBullet, against the step above",
                    "cosine",
                    "PyBullet, against our exact gradient",
                    "cosine",
                ],
                quality,
            ),
        ]
    )


STUDY = Benchmark(
    name="bullet",
    place=30,
    title="Against PyBullet with finite differences",
    question=(
        f"The plate of {_CELLS_ALONG**2} cells in PyBullet, every cell on a joint of its own, friction corrected as in the simulated "
        "cell, and the same pushes of 1 s in 240 steps in the compiled engine. Building a new world for changed cells is not counted. "
        "Both engines solve the same mechanics; the distance between their ends is given beside the times."
    ),
    pieces=_pieces,
    summarise=_summarise,
    targets=lambda summary: [],
    tables=_tables,
    draw=lambda summary, folder: {},
)
