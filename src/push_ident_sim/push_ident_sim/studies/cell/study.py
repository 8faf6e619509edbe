"""Checks of the simulated cell: every cell has its own load and friction, alike in every direction, and it runs in real time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError
from push_ident.nodes.base.network import process_domain
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, simulate
from push_ident.types import ObjectModel, PusherPath
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object
from push_ident_sim.recordings.truth import TruthSettings, make_pushes, true_model
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped

__all__ = ["STUDY"]

FloatArray = NDArray[np.float64]

_N_PUSHES = 4
_SLIDING = 0.02
"""An object whose frame is faster than this slides [m/s]."""
_RESTING = 1e-4
"""One whose frame is slower than this [m/s], and turns more slowly [rad/s], rests."""
_ADDED = {"friction": 1.0, "mass": 0.1}
"""To one cell: coefficient, and [kg]."""
_NOTHING = "nothing"
_N_DIRECTIONS = 12
_THROWN = 0.4
"""First speed of the disc [m/s]."""
_CAMERA_RATE = 30.0
"""[Hz], of 640 x 480."""
_WARM_UP, _MEASURED = 3, 8
"""Reports of the node, one a second, that are skipped and that are counted."""
_PATIENCE = 40.0
"""For them [s]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    if case.variant == "directions":
        return _directions(case, settings.truth)
    if case.variant == "speed":
        return _speed(case)
    thing = make_object(case.object_name, case.model)
    own = OBJECT_NAMES.index(case.object_name)
    pushes = replace(settings.truth, n_train=_N_PUSHES, n_test=0)
    motions = make_pushes(thing, [case.model, own, 11], pushes)
    if case.variant == "loads":
        return _loads(thing, motions, pushes)
    return _one_cell(thing, motions, pushes, np.random.default_rng([case.model, own, 12]))


# --- one load a cell -----------------------------------------------------------------------------------------------------


def _loads(thing: SimObject, motions: Sequence[TrueMotion], settings: TruthSettings) -> Json:
    """Contact force of each cell over whole pushes, against its weight."""
    from push_ident_sim.engines.bullet.push_world import PushWorld

    weight = thing.mass * GRAVITY
    world = PushWorld(thing, settings.pushes.pusher_radius, time_step=settings.time_step)
    rest: list[FloatArray] = []
    sliding: list[FloatArray] = []

    def watch() -> None:
        velocity = np.abs(world.object_velocity())
        if np.hypot(*velocity[:2]) > _SLIDING:
            sliding.append(world.cell_loads())
        elif velocity.max() < _RESTING:
            rest.append(world.cell_loads())

    try:
        for motion in motions:
            world.push(motion.pose[0], _path(motion, settings), watch=watch)
    finally:
        world.close()
    return {"weight_n": _rounded(weight), "mean_sliding_n": _rounded(np.mean(sliding, axis=0))} | {
        name: {
            "steps": len(loads),
            "correlation": _rounded(np.array([np.corrcoef(load, weight)[0, 1] for load in loads])),
            "error": _rounded(np.array([np.abs(load - weight).max() for load in loads]) / weight.mean()),
            "empty": _rounded(np.array([np.mean(load <= 0.0) for load in loads])),
        }
        for name, loads in (("rest", rest), ("sliding", sliding))
    }


# --- one cell changed ----------------------------------------------------------------------------------------------------


def _one_cell(thing: SimObject, motions: Sequence[TrueMotion], settings: TruthSettings, rng: np.random.Generator) -> Json:
    """The same pushes with one cell changed: the change of the end here, and the change that the planar model predicts.

    Rows of `nothing` are the pushes themselves, with no cell changed.
    """
    rows: dict[str, list[list[float]]] = {what: [] for what in (_NOTHING, *_ADDED)}
    for motion in motions:
        cell = int(rng.integers(len(thing)))
        before = _end(true_model(thing), motion, settings)
        rows[_NOTHING].append(_compared(motion.pose[-1] - motion.pose[0], before - motion.pose[0]))
        for what, added in _ADDED.items():
            values = np.array(getattr(thing, what))
            values[cell] += added
            changed = replace(thing, mass=values) if what == "mass" else replace(thing, friction=values)
            again = _pushed(changed, motion, settings)
            rows[what].append(_compared(again.pose[-1] - motion.pose[-1], _end(true_model(changed), again, settings) - before))
    return dict(rows)


def _compared(here: FloatArray, model: FloatArray) -> list[float]:
    """Size of a change of pose [m, rad], error of the model in it [m, rad], and both changes (x, y, yaw)."""
    error = here - model
    return _rounded(np.array([np.hypot(*here[:2]), abs(here[2]), np.hypot(*error[:2]), abs(error[2]), *here, *model]))


def _pushed(thing: SimObject, motion: TrueMotion, settings: TruthSettings) -> TrueMotion:
    from push_ident_sim.engines.bullet.push_world import PushWorld

    world = PushWorld(thing, settings.pushes.pusher_radius, time_step=settings.time_step)
    try:
        return world.push(motion.pose[0], _path(motion, settings))
    finally:
        world.close()


def _end(model: ObjectModel, motion: TrueMotion, settings: TruthSettings) -> FloatArray:
    """Last pose that the planar model predicts for the pusher's true path."""
    return np.asarray(simulate(model, PushScenario(_path(motion, settings), motion.pose[0], motion.time[-1:])).pose[-1])


def _path(motion: TrueMotion, settings: TruthSettings) -> PusherPath:
    return PusherPath(motion.time, motion.pusher, settings.pushes.pusher_radius)


# --- the same in every direction -----------------------------------------------------------------------------------------


def _directions(case: Case, settings: TruthSettings) -> Json:
    """A uniform disc slides to rest, and is pushed through its middle, in twelve directions."""
    from push_ident_sim.engines.bullet.push_world import PushWorld

    rng = np.random.default_rng([case.model, OBJECT_NAMES.index(case.object_name), 13])
    friction, mass = float(rng.uniform(0.15, 0.5)), float(rng.uniform(0.3, 1.2))
    disc, radius = _disc(friction, mass), settings.pushes.pusher_radius
    world = PushWorld(disc, radius, time_step=settings.time_step)
    reach = float(disc.outline.max()) + radius
    slides, asides, turns, forces = [], [], [], []
    try:
        for angle in 2.0 * np.pi * np.arange(_N_DIRECTIONS) / _N_DIRECTIONS:
            heading, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
            away = PusherPath(np.array([0.0, settings.time_step]), np.array([[0.5, 0.5], [0.5, 0.5]]), radius)
            thrown = world.push(np.zeros(3), away, velocity=[*(_THROWN * heading), 0.0])
            slides.append(float(thrown.pose[-1, :2] @ heading))
            asides.append(float(thrown.pose[-1, :2] @ across))
            turns.append(float(thrown.pose[-1, 2]))
            start, end = -(reach + 0.01) * heading, -(reach - 0.04) * heading
            # The disc turns with the push, so that the pusher always meets the same place of its outline.
            pushed = world.push([0.0, 0.0, angle], PusherPath(np.array([0.0, 0.5]), np.array([start, end]), radius))
            inside = (pushed.time > 0.3) & (pushed.time < 0.5)
            forces.append(float(np.mean(pushed.force[inside] @ heading)))
    finally:
        world.close()
    return {
        "slide_m": _rounded(slides),
        # The engine slows the disc down first and moves it then, in each time step.
        "slide_expected_m": _THROWN**2 / (2.0 * friction * GRAVITY) - 0.5 * _THROWN * settings.time_step,
        "aside_m": _rounded(asides),
        "turn_rad": _rounded(turns),
        "force_n": _rounded(forces),
        "force_expected_n": friction * mass * GRAVITY,
    }


def _disc(friction: float, mass: float) -> SimObject:
    size, radius = 0.012, 0.058
    x, y = np.meshgrid(*2 * [np.arange(-5, 6) * size])
    inside = np.hypot(x, y) <= radius
    n = int(inside.sum())
    cells = np.column_stack([x[inside], y[inside]])
    return SimObject("disc", size, cells, np.full(n, 0.03), np.full(n, mass / n), np.full(n, friction), 0.3)


# --- in time -------------------------------------------------------------------------------------------------------------


def _speed(case: Case) -> Json:
    """The node of the cell at full speed with its camera at 30 Hz, by its own reports."""
    try:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
    except ImportError as error:
        raise InputError(f"The speed of the cell is that of its node, which needs ROS ({error}); run without this variant.") from None

    domain = str(process_domain())
    parameters = {"object": case.object_name, "seed": case.model, "camera_rate": _CAMERA_RATE, "real_time_factor": 0.0}
    command = [sys.executable, "-m", "push_ident_sim", "sim_cell_node", "--ros-args"]
    command += [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]
    node = subprocess.Popen(command, env={**os.environ, "ROS_DOMAIN_ID": domain}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    reports: list[dict[str, float]] = []

    def on_report(msg: DiagnosticArray) -> None:
        values = [(v.key, v.value) for status in msg.status for v in status.values if status.name == "/sim_cell_node"]
        reports.append({key: float(value) for key, value in values})

    context = rclpy.Context()
    rclpy.init(context=context, domain_id=int(domain))
    listener = rclpy.create_node("cell_speed", context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(listener)
    listener.create_subscription(DiagnosticArray, "/diagnostics", on_report, 10)
    try:
        deadline = time.monotonic() + _PATIENCE
        while len(reports) < _WARM_UP + _MEASURED and time.monotonic() < deadline and node.poll() is None:
            executor.spin_once(timeout_sec=0.1)
    finally:
        executor.shutdown(timeout_sec=0.5)
        listener.destroy_node()
        rclpy.shutdown(context=context)
        node.terminate()
        node.wait(_PATIENCE)
    if len(reports) <= _WARM_UP:
        raise InputError(f"The node of the cell gave {len(reports)} reports in {_PATIENCE:g} s, expected {_WARM_UP + 1} at least.")
    counted = reports[_WARM_UP:]
    parts = sorted(key for key in counted[0] if key.startswith("processor, "))
    return {
        "real_time_factor": [r["real time factor"] for r in counted],
        "processor": {p.removeprefix("processor, ").removesuffix(" [s/s]"): float(np.mean([r[p] for r in counted])) for p in parts},
    }


# --- results ----------------------------------------------------------------------------------------------------


def _rounded(values: Sequence[float] | FloatArray) -> list[float]:
    """Six digits: enough, and small files."""
    return [float(f"{v:.6g}") for v in np.ravel(values)]


def _summarise(results: Sequence[CaseResult]) -> Json:
    summary: Json = {}
    by_variant = {variant: grouped(own, "object_name") for variant, own in grouped(results, "variant").items()}
    if "loads" in by_variant:
        summary["loads"] = {name: _summed_loads(own) for name, own in by_variant["loads"].items()}
    if "one-cell" in by_variant:
        summary["one_cell"] = {
            name: {what: [row for result in own for row in result.values[what]] for what in (_NOTHING, *_ADDED)}
            for name, own in by_variant["one-cell"].items()
        }
    if "directions" in by_variant:
        discs = [result.values for own in by_variant["directions"].values() for result in own]
        summary["directions"] = {
            "discs": len(discs),
            "slide_ratio": [_rounded(np.array(d["slide_m"]) / d["slide_expected_m"]) for d in discs],
            "aside_m": _rounded([np.abs(d["aside_m"]).max() for d in discs]),
            "turn_rad": _rounded([np.abs(d["turn_rad"]).max() for d in discs]),
            "force_ratio": [_rounded(np.array(d["force_n"]) / d["force_expected_n"]) for d in discs],
        }
    if "speed" in by_variant:
        summary["speed"] = {
            name: {
                "real_time_factor": _rounded([f for result in own for f in result.values["real_time_factor"]]),
                "processor": {
                    part: float(np.mean([result.values["processor"][part] for result in own])) for part in own[0].values["processor"]
                },
            }
            for name, own in by_variant["speed"].items()
        }
    return summary


def _summed_loads(results: Sequence[CaseResult]) -> Json:
    summed: Json = {key: [v for result in results for v in result.values[key]] for key in ("weight_n", "mean_sliding_n")}
    for name in ("rest", "sliding"):
        together = {key: np.array([v for result in results for v in result.values[name][key]]) for key in ("correlation", "error", "empty")}
        summed[name] = {
            "steps": len(together["error"]),
            "correlation_mean": float(together["correlation"].mean()),
            "correlation_q05": float(np.quantile(together["correlation"], 0.05)),
            "error_median": float(np.median(together["error"])),
            "empty": float(together["empty"].mean()),
        }
    return summed


def _tables(summary: Json) -> str:
    parts = []
    if "loads" in summary:
        head = ["contact force of a cell against its weight", "at rest: correlation", "sliding: correlation", "5 %", "cells without load"]
        rows = [
            [
                name,
                *(f"{own[w]['correlation_mean']:.4f}" for w in ("rest", "sliding")),
                f"{own['sliding']['correlation_q05']:.4f}",
                f"{100 * own['sliding']['empty']:.2f} %",
            ]
            for name, own in summary["loads"].items()
        ]
        parts.append(markdown_table(head, rows))
    if "one_cell" in summary:
        head = ["changed: median over pushes", "pushes", "end moves [mm]", "[deg]", "model error [mm]", "[deg]"]
        head += ["90 % [mm]", "[deg]"]
        rows = []
        for name, own in summary["one_cell"].items():
            for what in (_NOTHING, *_ADDED):
                values = np.array(own[what])
                middle, high = np.median(values[:, :4], axis=0), np.quantile(values[:, 2:4], 0.9, axis=0)
                moved = [f"{1e3 * middle[0]:.2f}", f"{np.degrees(middle[1]):.2f}"]
                errors = [number for mm, rad in (middle[2:], high) for number in (f"{1e3 * mm:.3f}", f"{np.degrees(rad):.3f}")]
                rows.append([f"{name}: {what}", str(len(values)), *moved, *errors])
        parts.append(markdown_table(head, rows))
    if "directions" in summary:
        own = summary["directions"]
        slide, force = np.array(own["slide_ratio"]), np.array(own["force_ratio"])
        head = ["a disc in 12 directions, against theory", "discs", "mean", "lowest", "highest"]
        rows = [
            [what, str(own["discs"]), f"{v.mean():.4f}", f"{v.min():.4f}", f"{v.max():.4f}"]
            for what, v in (("sliding distance", slide), ("force of a push", force))
        ]
        worst = f"Largest sideways motion {1e3 * max(own['aside_m']):.3f} mm, largest turn {np.degrees(max(own['turn_rad'])):.3f} degrees."
        parts.append(markdown_table(head, rows) + "\n\n" + worst)
    if "speed" in summary:
        used = sorted({part for own in summary["speed"].values() for part in own["processor"]})
        head = ["node with 640 x 480 at 30 Hz", "real-time factor", "lowest", *(f"{part} [s/s]" for part in used)]
        rows = [
            [name, f"{np.mean(own['real_time_factor']):.2f}", f"{min(own['real_time_factor']):.2f}"]
            + [f"{own['processor'].get(part, 0.0):.3f}" for part in used]
            for name, own in summary["speed"].items()
        ]
        parts.append(markdown_table(head, rows) + "\n\nSeconds of the processor per simulated second, by part.")
    return "\n\n".join(parts)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, axes = new_figure(3, width=4.2)
    loads, one_cell, round_about = axes
    for name, own in summary.get("loads", {}).items():
        loads.plot(own["weight_n"], own["mean_sliding_n"], ".", markersize=3, label=name)
    loads.axline((0.0, 0.0), slope=1.0, color="black", linewidth=0.8)
    loads.set_xlabel("weight of a cell [N]")
    loads.set_ylabel("mean contact force while sliding [N]")
    for name, own in summary.get("one_cell", {}).items():
        values = 1e3 * np.array([row for what in _ADDED for row in own[what]])
        one_cell.plot(values[:, [7, 8]].ravel(), values[:, [4, 5]].ravel(), ".", markersize=3, label=name)
    one_cell.axline((0.0, 0.0), slope=1.0, color="black", linewidth=0.8)
    one_cell.set_xlabel("end moves by [mm], x and y: planar model")
    one_cell.set_ylabel("the same in Bullet [mm]")
    angle = 360.0 * np.arange(_N_DIRECTIONS) / _N_DIRECTIONS
    for key, label, marker in (("slide_ratio", "sliding distance", "."), ("force_ratio", "force of a push", "+")):
        for i, ratios in enumerate(summary.get("directions", {}).get(key, [])):
            difference = 100.0 * (np.array(ratios) - 1.0)
            round_about.plot(angle, difference, marker, color=f"C{key == 'force_ratio':d}", markersize=5, label=label if i == 0 else None)
    round_about.axhline(0.0, color="black", linewidth=0.8)
    round_about.set_ylim(-1.0, 1.0)
    round_about.set_xlabel("direction on the table [deg]")
    round_about.set_ylabel("disc: difference to theory [%]")
    for ax in axes:
        ax.grid(alpha=0.3)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=8)
    save(figure, folder / "cell.png")
    return {
        "cell.png": "Left: every dot a cell. Middle: one cell changed in mass or friction, two dots a push. "
        "Right: discs that slide to rest and are pushed in twelve directions."
    }


STUDY = Experiment(
    name="cell",
    place=90,
    title="Checks of the simulated cell",
    question=(
        "Loads: the table's force on each cell at each time step of four random pushes, against the weight of the cell. One cell: the "
        "same pushes with the friction coefficient of one cell raised by 1, or its mass by 0.1 kg; the displacement of the end of the "
        "push, and the error of the planar model in it; `nothing` are the pushes without a change. Directions: a uniform disc of "
        "random mass and friction slides to rest from 0.4 m/s, and is pushed through its middle. Speed: the node of the cell with arm "
        "and camera, at full speed; other load on the machine reduces the factor, not the processor seconds."
    ),
    variants=("loads", "one-cell", "directions", "speed"),
    once=("speed",),
    needs_truth=False,
    stages=("geometry", "physics"),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
)
