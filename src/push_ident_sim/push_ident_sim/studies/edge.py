"""How surely objects are pushed out over the edge of the table without falling, by what is known of them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal, pregrasp
from push_ident.planning.goal import EdgeHold, Goal, GoalCode, GoalRefusedError
from push_ident.planning.planner import PlanStatus
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.objects import make_object
from push_ident_sim.studies.common.measuring import failures, grouped, mean_of, share
from push_ident_sim.studies.common.pushed import IDENTIFIED, KINDS, TABLE, PushedObject
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import causes_text, markdown_table, number, share_text

_EDGE: Final = TableEdge(np.array([1.0, 0.0]), float(TABLE[0]))
"""The table's edge in Bullet."""
_GOAL: Final = EdgeGoal(_EDGE)
"""40 mm over the edge, held by 10 mm; 20 mm and 15 degrees about the pre-grasp pose."""
_PUSHES: Final = PushSettings(workspace=(0.2, 1.0, -0.5, 0.5), pusher_radius=0.008, clearance=0.02, cone=float(np.radians(40.0)))
"""The tool reaches beyond the edge, so that it can pull as well."""
_ON_TABLE: Final = replace(_PUSHES, workspace=(0.2, 0.75, -0.5, 0.5))
"""Of random pushes beside the edge."""
_NOT_KNOWN: Final = (f"refused: {GoalCode.NOT_HELD.name}", PlanStatus.UNHELD.name)
"""Ends after which the object is explored by one more push."""


def _run(case: Case, settings: CaseSettings) -> Json:
    sim_object = make_object(case.object_name, case.model)
    rng = np.random.default_rng([case.model, 3])
    starts = [_random_start(sim_object.outline, rng) for _ in range(settings.goals)]
    # The same noise for all kinds of model, as far as they push alike.
    pushed = PushedObject(sim_object, case.variant, np.random.default_rng([case.model, 4]), rigid=True, pushes=_PUSHES)
    try:
        return {"starts": [_overhang(pushed, start) for start in starts]}
    finally:
        pushed.close()


def _random_start(outline: Float64Array, rng: np.random.Generator) -> Float64Array:
    """A pose on the table near its edge, in any heading, shape (3,)."""
    pose = np.array([0.0, rng.uniform(-0.2, 0.2), rng.uniform(-np.pi, np.pi)])
    pose[0] = _EDGE.offset - rng.uniform(0.05, 0.2) - np.max(transform_points(pose, outline)[:, 0])  # [m] between outline and edge
    return pose


def _overhang(pushed: PushedObject, start: Float64Array) -> Json:
    """Push an object from a start to a pre-grasp pose at the edge.

    Where it is not known well enough, it is pushed at random once more, as long as it is on the table and such pushes are left. `end`: the
    status of planning, the code of the refusal, FELL, or MISSED where the object was said to be there and was not. `error_m`: the true
    distance from the pre-grasp pose; `margin_m`: the least true distance of the centre of mass from the border of its support.
    """
    pushed.pose = start
    outcome: Json = {"end": "", "pushes": 0, "time_s": 0.0, "first_plan_s": None, "error_m": None, "margin_m": None}
    while True:
        goal = _try(pushed, outcome)
        on_table = bool(np.all(_EDGE.beyond(transform_points(pushed.pose, pushed.truth.shape.outline)) < 0.0))
        if outcome["end"] not in _NOT_KNOWN or not on_table:
            break
        motion = pushed.explore(_ON_TABLE)
        if motion is None:
            break
        _count(pushed, motion, outcome)
    if goal is not None:
        outcome["error_m"] = round(float(goal.error(pushed.pose)[0]), 5)
    return outcome | {"reached": outcome["end"] == PlanStatus.ARRIVED.name}


def _try(pushed: PushedObject, outcome: Json) -> Goal | None:
    """Choose the pre-grasp pose and push the object there: the pose, or None where it is refused."""
    begun = time.process_time()
    try:
        goal, hold = pregrasp(_GOAL, pushed.belief, pushed.observe()[0], pushed.settings)
    except GoalRefusedError as refusal:
        outcome["end"] = f"refused: {refusal.code.name}"
        return None
    _push_there(pushed, goal, hold, outcome, time.process_time() - begun)
    return goal


def _push_there(pushed: PushedObject, goal: Goal, hold: EdgeHold, outcome: Json, spent: float) -> None:
    while True:
        begun = time.process_time()
        plan = pushed.planner.plan(pushed.belief, *pushed.observe(), goal, hold=hold)
        if outcome["pushes"] == 0:
            outcome["first_plan_s"] = round(spent + time.process_time() - begun, 4)
        if plan.plan is None or outcome["pushes"] >= 20:
            break
        _count(pushed, pushed.push(plan.plan, _EDGE), outcome)
        if pushed.has_fallen:
            outcome["end"] = "FELL"
            return
        margin = round(float(hold.margins(pushed.truth.shape.cells.centres, pushed.centre, pushed.pose)), 5)
        outcome["margin_m"] = margin if outcome["margin_m"] is None else min(margin, outcome["margin_m"])
    outcome["end"] = plan.status.name if plan.plan is None else "MAX_PUSHES"
    if outcome["end"] == PlanStatus.ARRIVED.name and goal.relative_error(pushed.pose) > 1.0:
        outcome["end"] = "MISSED"


def _count(pushed: PushedObject, motion: TrueMotion, outcome: Json) -> None:
    outcome["time_s"] = round(outcome["time_s"] + pushed.duration(motion), 5)
    outcome["pushes"] += 1


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_kind = {kind: [run for r in cases for run in r.values["starts"]] for kind, cases in grouped(results, "variant").items()}
    return {
        "kinds": {kind: _row(runs) for kind, runs in by_kind.items()},
        "falls": sum(run["end"] == "FELL" for runs in by_kind.values() for run in runs),
    }


def _row(runs: Sequence[Json]) -> Json:
    reached = [run for run in runs if run["reached"]]
    return {
        "success": share(run["reached"] for run in runs),
        "falls": sum(run["end"] == "FELL" for run in runs),
        "causes": failures((run["end"] for run in runs), PlanStatus.ARRIVED.name),
        "pushes": mean_of(run["pushes"] for run in reached),
        "time_s": mean_of(run["time_s"] for run in reached),
        "first_plan_s": mean_of(run["first_plan_s"] for run in runs if run["pushes"]),
        "error_m": mean_of((run["error_m"] for run in reached), 5),
        "least_margin_m": min((run["margin_m"] for run in runs if run["margin_m"] is not None), default=None),
    }


_COLUMNS: Final = {
    "pushes": ("{:.2f}", 1.0),
    "time_s": ("{:.1f} s", 1.0),
    "first_plan_s": ("{:.1f} s", 1.0),
    "error_m": ("{:.1f} mm", 1e3),
    "least_margin_m": ("{:.0f} mm", 1e3),
}
"""Formats and factors of the numbers of the table."""


def _tables(summary: Json) -> str:
    head = ["what is known", "success (95 % interval)", "falls", "pushes", "time", "first plan", "error", "least margin", "failures"]
    rows = [
        [
            kind,
            share_text(row["success"]),
            str(row["falls"]),
            *(number(row[key], *form) for key, form in _COLUMNS.items()),
            causes_text(row["causes"]),
        ]
        for kind, row in summary["kinds"].items()
    ]
    return markdown_table(head, rows)


def _answer(summary: Json) -> str:
    row = summary["kinds"].get(IDENTIFIED) or next(iter(summary["kinds"].values()))
    return f"Identified: {share_text(row['success'])} starts in {number(row['pushes'], '{:.1f}')} pushes; {row['falls']} objects fell."


STUDY = Experiment(
    name="edge",
    title="Are objects pushed out over the edge of the table and held?",
    question=(
        "Each object starts near an edge, in any heading, and is pushed or pulled until it overhangs by "
        f"{1e3 * _GOAL.overhang:.0f} mm in a pose in which it can be grasped, its centre of mass at least {1e3 * _GOAL.held:.0f} "
        f"mm inside the border of its support. Success: the planner says so, the true pose is within {1e3 * _GOAL.position:.0f} mm "
        f"and {np.degrees(_GOAL.turn):.0f}° of the pre-grasp pose, and it did not fall. In Bullet it tilts and falls, and "
        "shares the load among its contacts in another way than the model: even the true map is not exact. Knowledge as in `goals`; "
        "time with 0.4 s of rest before and after each push; the first plan by the processor."
    ),
    variants=KINDS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    counts_goals=True,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
    headline=("falls",),
)
