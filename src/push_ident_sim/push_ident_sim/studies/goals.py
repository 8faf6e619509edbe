"""How surely, and in how many pushes, objects of uneven maps are brought to a pose, by what is known of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from push_ident.planning.goal import Goal
from push_ident.planning.planner import PlanStatus
from push_ident.types import Float64Array
from push_ident_sim.studies.common.measuring import grouped, share
from push_ident_sim.studies.common.objects import plate_in_bullet, random_object
from push_ident_sim.studies.common.pushed import IDENTIFIED, KINDS, PushedObject
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, share_text

_LEVELS: Final = {"20mm_0.1rad": (0.02, 0.1), "10mm_5deg": (0.01, np.radians(5.0)), "5mm_2deg": (0.005, np.radians(2.0))}
"""Tolerances of position [m] and yaw [rad], from the first to the last: every goal is reached at the first, then held to the next."""
_NAMES: Final = {"20mm_0.1rad": "20 mm, 0.1 rad", "10mm_5deg": "10 mm, 5°", "5mm_2deg": "5 mm, 2°"}
_FIRST, _LAST = next(iter(_LEVELS)), tuple(_LEVELS)[-1]
_MOST_PUSHES: Final = 20
"""Of one goal, all tolerances together."""
_REACH: Final = 0.15
"""Half the side of the square that goals are drawn from [m]."""
_SURE: Final = (0.85, 0.95)
"""Expected probabilities of a push that count as "90 % sure"."""


def _run(case: Case, settings: CaseSettings) -> Json:
    rng = np.random.default_rng([case.model, 1])
    goals = [np.array([*rng.uniform(-_REACH, _REACH, 2), rng.uniform(-np.pi, np.pi)]) for _ in range(settings.goals)]
    # The same noise for all kinds of model, as far as they push alike.
    sim_object = plate_in_bullet(random_object(np.random.default_rng(case.model)))
    pushed = PushedObject(sim_object, case.variant, np.random.default_rng([case.model, 2]))
    try:
        return {"goals": [_reach(pushed, goal) for goal in goals]}
    finally:
        pushed.close()


def _reach(pushed: PushedObject, pose: Float64Array) -> Json:
    """Push an object to a goal, shape (3,), to one tolerance after the other.

    By level whether the object was said to be there and was (`reached`), and the `pushes` and their time [s] until then; of each push the
    expected probability that it ends at the goal, and whether it did (`chances`).
    """
    outcome: Json = {"reached": {}, "pushes": {}, "time_s": {}, "chances": [], "fell": False}
    pushes, time = 0, 0.0
    for level, tolerance in _LEVELS.items():
        goal = Goal(pose, *tolerance)
        while True:
            plan = pushed.planner.plan(pushed.belief, *pushed.observe(), goal)
            if plan.plan is None or pushes >= _MOST_PUSHES or outcome["fell"]:
                break
            time += pushed.duration(pushed.push(plan.plan))
            pushes += 1
            outcome["chances"].append((round(plan.chance, 3), bool(goal.relative_error(pushed.pose) <= 1.0)))
            outcome["fell"] |= pushed.has_fallen
        outcome["reached"][level] = plan.status is PlanStatus.ARRIVED and bool(goal.relative_error(pushed.pose) <= 1.0)
        outcome["pushes"][level], outcome["time_s"][level] = pushes, round(time, 2)
    return outcome


def _summarise(results: Sequence[CaseResult]) -> Json:
    goals = {kind: [goal for r in cases for goal in r.values["goals"]] for kind, cases in grouped(results, "variant").items()}
    main = goals.get(IDENTIFIED) or next(iter(goals.values()))
    return {
        "success": {
            kind: {level: share(goal["reached"][level] for goal in rows)["share"] for level in _LEVELS} for kind, rows in goals.items()
        },
        "kinds": {kind: _row(rows) for kind, rows in goals.items()},
        "pushes_mean": _mean(main, "pushes", _FIRST),
        "time_mean_s": _mean(main, "time_s", _FIRST),
        "falls": sum(goal["fell"] for rows in goals.values() for goal in rows),
    }


def _row(goals: Sequence[Json]) -> Json:
    chances = [pair for goal in goals for pair in goal["chances"]]
    return {
        "goals": len(goals),
        "reached": {level: share(goal["reached"][level] for goal in goals) for level in _LEVELS},
        **{key: {level: _mean(goals, key, level) for level in _LEVELS} for key in ("pushes", "time_s")},
        "sure": share(there for chance, there in chances if _SURE[0] <= chance <= _SURE[1]),
    }


def _mean(goals: Sequence[Json], key: str, level: str) -> float:
    return round(float(np.mean([goal[key][level] for goal in goals])), 4)


def _tables(summary: Json) -> str:
    head = [
        "what is known",
        *(f"{name}: reached (95 % interval); pushes; time" for name in _NAMES.values()),
        "pushes 85-95 % sure, and right",
    ]
    rows = [
        [
            kind,
            *(f"{share_text(row['reached'][level])}; {row['pushes'][level]:.2f}; {row['time_s'][level]:.1f} s" for level in _LEVELS),
            f"{row['sure']['successes']}/{row['sure']['n']}",
        ]
        for kind, row in summary["kinds"].items()
    ]
    return markdown_table(head, rows) + f"\n\nObjects that fell off the table: {summary['falls']}."


def _answer(summary: Json) -> str:
    row = summary["kinds"].get(IDENTIFIED) or next(iter(summary["kinds"].values()))
    reached = row["reached"][_LAST]
    return f"Identified: {reached['successes']} of {reached['n']} goals within {_NAMES[_LAST]}, in {row['pushes'][_LAST]:.1f} pushes."


STUDY = Experiment(
    name="goals",
    title="Are objects pushed to a pose?",
    question=(
        "Objects of random shape and uneven maps are pushed in Bullet to random poses in a square of 30 cm, each to three tolerances "
        f"in turn, in at most {_MOST_PUSHES} pushes. The planner knows the outline, poses with the errors of perception, and of the "
        "mechanics nothing (uniform), what three random pushes and up to seven more have shown (identified), or everything (truth). "
        "Reached: the planner says so and the true pose agrees."
    ),
    objects=("uneven",),
    variants=KINDS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    counts_goals=True,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
    headline=("success", "pushes_mean", "time_mean_s", "falls"),
)
