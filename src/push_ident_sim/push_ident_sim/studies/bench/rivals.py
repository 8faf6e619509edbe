"""The same object from the same pushes: this package, MuJoCo with the optimiser of its identification toolbox, and Newton with its tape.

`mujoco.sysid` fits parameters of a scene by `mujoco.minimize.least_squares`, with derivatives by finite differences; Newton has a gradient.
Both get what the default method has: the friction of each cell and of the pusher, with the same prior, and poses of all frames.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.unknowns.mechanics import uniform_model
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import ModelGradient, compile_kernels, loss_gradient
from push_ident.simulators.mujoco_scene import MujocoScene
from push_ident.types import Float64Array, ObjectModel, PusherPath, PushRecord
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, make_pushes, observe_motion
from push_ident_sim.studies.bench.newton_plate import NewtonPlate
from push_ident_sim.studies.common.objects import plate, plate_in_bullet
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table, millimetres, number
from push_ident_sim.studies.scenes import plain_scene

_CELLS_ALONG: Final = 5
_N_TRAIN: Final = 6
_DIFFERENCE: Final = 1e-3
"""Of the logarithm of a parameter, for finite differences [1]: the simulation is not smooth to rounding."""
_PRIOR: Final = Prior()
_NEWTON_CALLS: Final = 60
"""Evaluations of cost and gradient by Newton, at most."""
_RATE: Final = 0.05
"""Step of the logarithm of each coefficient [1]: they are known to about 0.3, and 60 steps reach ten times that."""
_FRICTION_STEP: Final = 3e-3
"""For differences in Newton [1]: it computes in single precision."""
_FINE_STEP: Final = 1e-5
"""The same in this package [1]."""
_ALONG: Final = np.array([1.0, 0.7, 0.05])
"""Direction of which derivatives are compared [1, 1, m]."""

_RIVALS: Final = {"mujoco": "MuJoCo", "newton": "Newton"}

_Simulate = Callable[[Float64Array, PusherPath, Float64Array], Float64Array]
"""As of `PushSimulator.simulate`."""


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
    task = _Task(uniform_model(model.shape, _PRIOR), train, test, iterations)
    result = {
        "seed": seed,
        "cells": len(model.mass),
        "equal_m": float(np.mean(held_out_errors(ours.uniform, test))),
        "ours": {"seconds": seconds, "error_m": float(np.mean(held_out_errors(ours.model, test)))},
    }
    with tempfile.TemporaryDirectory() as folder:
        result["mujoco"] = _by_mujoco(task, plain_scene(Path(folder), model.shape.outline, radius, _PRIOR.pusher_friction))
    longest = max(float(record.pusher.time[-1] - record.pusher.time[0]) for record in records)
    try:
        result["newton"] = _by_newton(task, NewtonPlate(task.start, radius, longest))
    except ModuleNotFoundError:
        result["newton"] = None
    return result


@dataclass(frozen=True, slots=True)
class _Task:
    """What a rival has to identify. Its unknowns `x` are logarithms of the friction of each cell and of the pusher, relative to `start`."""

    start: ObjectModel
    train: Sequence[PushRecord]
    test: Sequence[PushRecord]
    iterations: int

    @property
    def stds(self) -> Float64Array:
        """Of the prior of `x`, shape (n_cells + 1,)."""
        return np.r_[np.full(len(self.start.mass), _PRIOR.friction_map_std), _PRIOR.pusher_friction_std]

    def friction(self, x: Float64Array) -> Float64Array:
        """Of each cell, then of the pusher [1], shape (n_cells + 1,)."""
        return np.asarray(np.r_[self.start.friction, self.start.pusher_friction] * np.exp(x))

    def model(self, x: Float64Array) -> ObjectModel:
        """The object of `x`."""
        *friction, pusher_friction = self.friction(x)
        return replace(self.start, friction=np.array(friction), pusher_friction=pusher_friction)

    def error(self, simulate: _Simulate) -> float:
        """Mean cell error at the ends of the test pushes [m]."""
        errors = []
        for record in self.test:
            seen = observe_push(record)
            end = simulate(seen.pose[0], record.pusher, seen.time[-1:])[-1]
            errors.append(cell_error(record.shape.cells, end, seen.pose[-1]))
        return float(np.mean(errors))


def _by_mujoco(task: _Task, scene: MujocoScene) -> Json:
    """Errors and processor time."""
    from mujoco import minimize as by_mujoco

    observed = [observe_push(record) for record in task.train]

    def scene_of(x: Float64Array) -> MujocoScene:
        model = task.model(x)
        return scene.with_object(model).with_precise_contact(model.pusher_friction)

    def residual(columns: Float64Array) -> Float64Array:
        return np.column_stack([_residual(scene_of(x), task.train, observed, x / task.stds) for x in columns.T])

    first, started = np.zeros(len(task.stds)), time.process_time()
    x, trace = by_mujoco.least_squares(first, residual, eps=_DIFFERENCE, max_iter=task.iterations, verbose=0)
    seconds = time.process_time() - started
    errors = {"before_m": task.error(scene_of(first).simulate), "error_m": task.error(scene_of(x).simulate)}
    return {"seconds": seconds, "iterations": len(trace), **errors}


def _residual(scene: MujocoScene, records: Sequence[PushRecord], observed: Sequence, prior: Float64Array) -> Float64Array:
    rows = []
    for record, seen in zip(records, observed, strict=True):
        difference = scene.simulate(seen.pose[0], record.pusher, seen.time) - seen.pose
        rows.append(np.einsum("fij,fj->fi", seen.whitening, difference).ravel())
    return np.concatenate([*rows, prior])


def _by_newton(task: _Task, plate_there: NewtonPlate) -> Json:
    """Errors, processor time, and the gradient against differences."""
    observed = [observe_push(record) for record in task.train]

    def cost(x: Float64Array) -> tuple[float, Float64Array]:
        """Half the sum of squared residuals and its derivatives, shape (n_cells + 1,)."""
        friction = task.friction(x)
        value, slope = 0.5 * float(np.sum((x / task.stds) ** 2)), x / task.stds**2
        for record, seen in zip(task.train, observed, strict=True):
            poses = plate_there.simulate(friction, seen.pose[0], record.pusher, seen.time)
            residuals = np.einsum("fij,fj->fi", seen.whitening, poses - seen.pose)
            value += 0.5 * float(np.sum(residuals**2))
            slope = slope + friction * plate_there.gradient(np.einsum("fij,fi->fj", seen.whitening, residuals))
        return value, slope

    def simulate_with(x: Float64Array) -> _Simulate:
        return lambda pose, path, times: plate_there.simulate(task.friction(x), pose, path, times)

    first, started = np.zeros(len(task.stds)), time.process_time()
    n_calls = _NEWTON_CALLS if task.iterations > 1 else 2
    best = _by_adam(cost, first, n_calls)
    seconds = time.process_time() - started
    errors = {"before_m": task.error(simulate_with(first)), "error_m": task.error(simulate_with(best))}
    return {"seconds": seconds, "iterations": n_calls, **errors, **_derivatives(task, plate_there)}


def _by_adam(cost: Callable[[Float64Array], tuple[float, Float64Array]], x: Float64Array, n_calls: int) -> Float64Array:
    """The best of so many points (Kingma & Ba, 2015): its steps do not depend on the size of a gradient."""
    best, least, mean, square = x, np.inf, np.zeros(len(x)), np.zeros(len(x))
    for n in range(1, n_calls + 1):
        value, slope = cost(x)
        best, least = (x, value) if value < least else (best, least)
        mean, square = 0.9 * mean + 0.1 * slope, 0.999 * square + 0.001 * slope**2
        x = x - _RATE * (mean / (1.0 - 0.9**n)) / (np.sqrt(square / (1.0 - 0.999**n)) + 1e-8)
    return best


def _derivatives(task: _Task, plate_there: NewtonPlate) -> Json:
    """Of the end of each push along one direction, by the friction of all cells and of the pusher: how far Newton's ends lie from ours,
    cosine and size of each gradient against central differences in the same engine, and processor times of simulation and gradient."""
    friction, n, rows = task.friction(np.zeros(len(task.stds))), len(task.start.mass), []
    for record in task.train:
        start, times = observe_push(record).pose[0], record.pusher.time[-1:]
        scenario = PushScenario(record.pusher, start, times)

        def newton_end(values: Float64Array, start: Float64Array = start, path: PusherPath = record.pusher) -> Float64Array:
            return plate_there.simulate(values, start, path, path.time[-1:])[-1]

        def our_gradient(values: Float64Array, scenario: PushScenario = scenario) -> ModelGradient:
            model = replace(task.start, friction=values[:n], pusher_friction=float(values[n]))
            return loss_gradient(model, scenario, lambda poses: (float(poses[-1] @ _ALONG), np.broadcast_to(_ALONG, poses.shape).copy()))

        started = time.process_time()
        there = newton_end(friction)
        tape = plate_there.gradient(_ALONG[None])
        newton_seconds, started = time.process_time() - started, time.process_time()
        here = our_gradient(friction)
        our_seconds = time.process_time() - started
        rows.append({
            "off_m": cell_error(record.shape.cells, there, here.motion.pose[-1]),
            "newton": {"seconds": newton_seconds, **_against(tape, lambda v: float(newton_end(v) @ _ALONG), friction, _FRICTION_STEP)},
            "ours": {
                "seconds": our_seconds,
                **_against(np.r_[here.friction, here.pusher_friction], lambda v: our_gradient(v).loss, friction, _FINE_STEP),
            },
        })  # fmt: skip
    return {"pushes": rows}


def _against(gradient: Float64Array, loss: Callable[[Float64Array], float], at: Float64Array, step: float) -> Json:
    """Cosine and size of a gradient, relative to central differences."""
    steps = step * np.eye(len(at))
    differences = np.array([loss(at + one) - loss(at - one) for one in steps]) / (2 * step)
    size, expected = float(np.linalg.norm(gradient)), float(np.linalg.norm(differences))
    return {"cosine": float(gradient @ differences) / (size * expected), "size": size / expected}


def _targets(summary: Json) -> list[Target]:
    solves = summary["solves"]
    targets = []
    for key, name in _RIVALS.items():
        if all(solve[key] for solve in solves):
            faster = float(np.median([solve[key]["seconds"] / solve["ours"]["seconds"] for solve in solves]))
            nearer = float(np.median([solve[key]["error_m"] / solve["ours"]["error_m"] for solve in solves]))
            held = faster >= 10.0 and nearer >= 1.0
            targets.append(
                Target(f"processor time and error of {name} over ours, medians", "≥ 10, ≥ 1", f"{faster:.0f}, {nearer:.2f}", held)
            )
    return targets


def _tables(summary: Json) -> str:
    solves = summary["solves"]
    head = ["seed", "cells", "equal cells [mm]", *(f"{name} [{unit}]" for unit in ("mm", "s") for name in ("ours", *_RIVALS.values()))]
    head += [f"steps of {name}" for name in _RIVALS.values()]
    rows = []
    for solve in solves:
        others = [solve[key] or {} for key in _RIVALS]
        errors = [millimetres(one) for one in (solve["equal_m"], solve["ours"]["error_m"], *(one.get("error_m") for one in others))]
        seconds = [number(one.get("seconds"), "{:.3g}") for one in (solve["ours"], *others)]
        rows.append([f"{solve['seed']}", f"{solve['cells']}", *errors, *seconds, *(number(one.get("iterations"), "{}") for one in others)])
    return "\n\n".join([markdown_table(head, rows), *_table_of_derivatives(solves)])


def _table_of_derivatives(solves: Sequence[Json]) -> list[str]:
    pushes = [push for solve in solves if solve["newton"] for push in solve["newton"]["pushes"]]
    if not pushes:
        return ["Newton is not installed."]
    head = ["gradient", "cosine, worst", "size, median", "smallest to largest", "push and gradient [ms]"]
    rows = []
    for key, name in (("ours", "ours"), ("newton", "Newton's tape")):
        sizes, times = [push[key]["size"] for push in pushes], [push[key]["seconds"] for push in pushes]
        worst = min(push[key]["cosine"] for push in pushes)
        span = f"{min(sizes):.4f} to {max(sizes):.4f}" if key == "ours" else f"{min(sizes):.2f} to {max(sizes):.2f}"
        rows.append([name, f"{worst:.4f}", f"{np.median(sizes):.3f}", span, f"{1e3 * float(np.median(times)):.3g}"])
    off = [1e3 * push["off_m"] for push in pushes]
    words = (
        f"Gradients of the ends of the {len(pushes)} pushes by all frictions, against central differences in the same engine (1: right). "
        f"Newton's ends lie {np.median(off):.2f} mm from ours in the median, {max(off):.2f} mm at most."
    )
    return [markdown_table(head, rows), words]


STUDY = Benchmark(
    name="rivals",
    title="The same pushes identified with MuJoCo and with Newton",
    question=(
        f"A plate of {_CELLS_ALONG**2} cells, {_N_TRAIN} pushes in Bullet, processor time and mean cell error on as many other pushes: "
        "`identify` with its default method, `mujoco.minimize`, the optimiser of `mujoco.sysid`, on a MuJoCo scene, ten iterations at "
        f"most, and Adam on the gradient of Newton's tape (`SolverSemiImplicit` on the processor), {_NEWTON_CALLS} evaluations, "
        "without the time in which it records the launches of a push. The cells of both have the same unknown friction with the same "
        "prior. Ours also fits where the load lies. Equal cells: without pushes."
    ),
    pieces=_pieces,
    summarise=lambda results: {"solves": list(results)},
    targets=_targets,
    tables=_tables,
)
