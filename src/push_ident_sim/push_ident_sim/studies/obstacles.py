"""How surely objects are brought to a pose between things that must not be touched."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.planning.goal import Goal
from push_ident.planning.keep_out import distance_between
from push_ident.planning.obstacle import Obstacle
from push_ident.planning.planner import PlanStatus
from push_ident.types import Float64Array
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.objects import SimObject, make_object
from push_ident_sim.studies.common.measuring import failures, grouped, mean_of, share
from push_ident_sim.studies.common.pushed import IDENTIFIED, SYSTEMATIC_STD, PushedObject
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import causes_text, markdown_table, number, share_text

_KINDS = _ROUND, _UNAWARE = ("round", "unaware")
"""The planner knows of the obstacles, or does not."""
_OBSTACLES: Final = 3
_MOST_PUSHES: Final = 20
"""For one goal."""
_REACH: Final = 0.25
"""Half the side of the square that starts, goals and obstacles lie in [m]."""
_APART: Final = 0.25
"""Least distance of a goal from the start [m]."""
_ROOM: Final = 0.03
"""Least distance of an obstacle from the object at its start and at its goal [m]: the tool, of 16 mm, is lowered between them."""
_CELL: Final = 0.01
"""Edge of a cell of an obstacle [m]."""
TOUCHED, MISSED, MOST = "touched an obstacle", "MISSED", "MAX_PUSHES"
"""Ends beside those of planning."""


def block(rng: np.random.Generator) -> SimObject:
    """A rectangle with sides of 3 to 8 cm, 3 cm high."""
    nx, ny = rng.integers(3, 9, 2)
    cells = _CELL * np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), axis=-1).reshape(-1, 2)
    n = len(cells)
    return SimObject("block", _CELL, cells - cells.mean(axis=0), np.full(n, 0.03), np.full(n, 0.01), np.full(n, 0.3), 0.3)


def random_pose(rng: np.random.Generator, reach: float) -> Float64Array:
    """In a square about the origin, in any heading, shape (3,)."""
    return np.array([*rng.uniform(-reach, reach, 2), rng.uniform(-np.pi, np.pi)])


def _scene(outline: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, Float64Array, list[tuple[SimObject, Float64Array]]]:
    """Start and goal, each of shape (3,), and obstacles with their poses: one on the straight way, the others anywhere."""
    while True:
        start, goal = random_pose(rng, _REACH), random_pose(rng, _REACH)
        if np.linalg.norm(goal[:2] - start[:2]) < _APART:
            continue
        ends, placed = [transform_points(pose, outline) for pose in (start, goal)], list[tuple[SimObject, Float64Array]]()
        for _ in range(200):
            one, pose = block(rng), random_pose(rng, _REACH)
            if not placed:
                pose[:2] = start[:2] + rng.uniform(0.2, 0.8) * (goal - start)[:2]
            others = [transform_points(at, other.outline) for other, at in placed]
            here = transform_points(pose, one.outline)
            if min(distance_between(here, end) for end in ends) > _ROOM and all(distance_between(here, other) > 0.0 for other in others):
                placed.append((one, pose))
            if len(placed) == _OBSTACLES:
                return start, goal, placed


def _run(case: Case, settings: CaseSettings) -> Json:
    sim_object, rng = make_object(case.object_name, case.model), np.random.default_rng([case.model, 5])
    scenes = [_scene(sim_object.outline, rng) for _ in range(settings.goals)]
    pushed = PushedObject(sim_object, IDENTIFIED, np.random.default_rng([case.model, 6]))
    try:
        return {"goals": [_reach(pushed, *scene, np.random.default_rng([case.model, 7, k]), case) for k, scene in enumerate(scenes)]}
    finally:
        pushed.close()


def _reach(
    pushed: PushedObject,
    start: Float64Array,
    goal_pose: Float64Array,
    placed: Sequence[tuple[SimObject, Float64Array]],
    rng: np.random.Generator,
    case: Case,
) -> Json:
    """Push an object from a start to a goal, each of shape (3,)."""
    pushed.pose = start
    numbers = [pushed.world.add(one, pose, fixed=True) for one, pose in placed]
    known = observed_obstacles(placed, rng) if case.variant == _ROUND else []
    outcome = push_there(pushed, Goal(goal_pose), [one.outline for one in known], _MOST_PUSHES)
    remove_all(pushed.world, numbers)
    return outcome


def remove_all(world: PushWorld, numbers: Sequence[int]) -> None:
    """Take objects off the table that were added last."""
    for number_of in reversed(numbers):
        world.remove(number_of)


def observed_obstacles(placed: Sequence[tuple[SimObject, Float64Array]], rng: np.random.Generator) -> list[Obstacle]:
    """Obstacles as perception shows them at rest, with the errors of their poses."""
    covariance = np.diag(SYSTEMATIC_STD**2)
    poses = [pose + SYSTEMATIC_STD * rng.normal(size=3) for _, pose in placed]
    return [Obstacle.of_object(one.name, one.outline, pose, covariance) for (one, _), pose in zip(placed, poses, strict=True)]


def push_there(pushed: PushedObject, goal: Goal, obstacles: Sequence[Float64Array], most: int) -> Json:
    """Push an object to a goal in at most so many pushes; ends where something was touched.

    `end`: the status of planning, or one of the ends beside it; `plan_s`: time of each plan by the processor.
    """
    outcome: Json = {"end": MOST, "pushes": 0, "time_s": 0.0, "plan_s": [], "error": None}
    while True:
        begun = time.process_time()
        plan = pushed.planner.plan(pushed.belief, *pushed.observe(), goal, obstacles)
        outcome["plan_s"].append(round(time.process_time() - begun, 3))
        if plan.plan is None or outcome["pushes"] >= most:
            break
        outcome["time_s"] = round(outcome["time_s"] + pushed.duration(pushed.push(plan.plan)), 3)
        outcome["pushes"] += 1
        if pushed.world.touched or pushed.has_fallen:
            return outcome | {"end": TOUCHED if pushed.world.touched else "FELL", "reached": False}
    if plan.plan is None:
        outcome["end"] = plan.status.name
    error = goal.error(pushed.pose)
    outcome["error"] = [round(float(value), 5) for value in error]
    if plan.status is PlanStatus.ARRIVED and goal.relative_error(pushed.pose) > 1.0:
        outcome["end"] = MISSED
    return outcome | {"reached": outcome["end"] == PlanStatus.ARRIVED.name}


def _summarise(results: Sequence[CaseResult]) -> Json:
    goals = {kind: [goal for r in cases for goal in r.values["goals"]] for kind, cases in grouped(results, "variant").items()}
    main = goals.get(_ROUND) or next(iter(goals.values()))
    return {
        "kinds": {kind: row_of(rows) for kind, rows in goals.items()},
        "objects": {
            name: row_of([goal for r in cases if r.case.variant == _ROUND for goal in r.values["goals"]])
            for name, cases in grouped(results, "object_name").items()
            if any(r.case.variant == _ROUND for r in cases)
        },
        "success": share(goal["reached"] for goal in main),
        "touched": sum(goal["end"] == TOUCHED for goal in main),
    }


def row_of(goals: Sequence[Json]) -> Json:
    """One row of the table: goals, how they ended, and means over those that were reached."""
    reached = [goal for goal in goals if goal["reached"]]
    return {
        "success": share(goal["reached"] for goal in goals),
        "touched": sum(goal["end"] == TOUCHED for goal in goals),
        "pushes": mean_of(goal["pushes"] for goal in reached),
        "time_s": mean_of(goal["time_s"] for goal in reached),
        "plan_s": mean_of((seconds for goal in goals for seconds in goal["plan_s"]), 3),
        "causes": failures((goal["end"] for goal in goals), PlanStatus.ARRIVED.name),
    }


HEAD: Final = ["success (95 % interval)", "touched", "pushes", "time", "a plan", "failures"]


def cells_of(row: Json) -> list[str]:
    """A row as cells of the table below `HEAD`."""
    numbers = [number(row["pushes"], "{:.2f}", 1.0), number(row["time_s"], "{:.1f} s", 1.0), number(row["plan_s"], "{:.2f} s", 1.0)]
    return [share_text(row["success"]), str(row["touched"]), *numbers, causes_text(row["causes"])]


def _tables(summary: Json) -> str:
    kinds = markdown_table(["obstacles", *HEAD], [[kind, *cells_of(row)] for kind, row in summary["kinds"].items()])
    objects = markdown_table(["object (round)", *HEAD], [[name, *cells_of(row)] for name, row in summary["objects"].items()])
    return f"{kinds}\n\n{objects}"


def _answer(summary: Json) -> str:
    row = next(iter(summary["kinds"].values()))
    return f"{share_text(summary['success'])} goals without a touch, in {number(row['pushes'], '{:.1f}', 1.0)} pushes."


STUDY = Experiment(
    name="obstacles",
    title="Are objects pushed to a pose round things that must not be touched?",
    question=(
        f"Each object is pushed in Bullet from random starts to random poses at least {1e2 * _APART:.0f} cm away, within 20 mm, 0.1 rad, "
        f"in at most {_MOST_PUSHES} pushes. {_OBSTACLES} blocks with sides of 3 to 8 cm are fixed to the table, one with its middle "
        f"on the straight way, none nearer than {1e3 * _ROOM:.0f} mm to the object at its start and its goal. The planner knows outlines, "
        "poses of object and blocks with the errors of perception, and of the mechanics what three random pushes and up to seven more have "
        "shown. Success: the planner says so, the true pose agrees, and neither object nor tool touched a block in any time step of the "
        "engine; a goal ends with the first touch. Unaware: the same planner is not told of the blocks. Time with 0.4 s of rest before and "
        "after each push; a plan by the processor."
    ),
    variants=_KINDS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    counts_goals=True,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
    headline=("success", "touched"),
)
