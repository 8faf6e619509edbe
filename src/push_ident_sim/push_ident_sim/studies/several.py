"""How surely several objects are brought to their poses, one after another, without touching each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from push_ident.planning.goal import Goal
from push_ident.planning.keep_out import distance_between
from push_ident.planning.obstacle import Obstacle
from push_ident.planning.several import NoTurnError, PlacedObject, SeveralGoals
from push_ident.types import Float64Array
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.studies.common.measuring import failures, grouped, mean_of, share
from push_ident_sim.studies.common.pushed import IDENTIFIED, SYSTEMATIC_STD, PushedObject
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import causes_text, markdown_table, number, share_text
from push_ident_sim.studies.obstacles import TOUCHED, push_there, random_pose

_NUMBERS: Final = ("2", "3", "4")
_MOST_PUSHES: Final = 20
"""Of one turn of an object."""
_REACH: Final = 0.3
"""Half the side of the square that starts and goals lie in [m]."""
_ROOM: Final = 0.03
"""Least distance of objects from each other at their starts, and at their goals [m]."""
_REFERENCE: Final = {"2": 96, "3": 192, "4": 318}
"""Times of Push Anything [s] (arXiv 2510.19974): another arm, other objects, other tolerances."""


def _places(outlines: Sequence[Float64Array], rng: np.random.Generator) -> list[Float64Array]:
    """A pose of each object, shape (3,), apart from each other."""
    while True:
        poses = [random_pose(rng, _REACH) for _ in outlines]
        placed = [PlacedObject(outline, pose) for outline, pose in zip(outlines, poses, strict=True)]
        lines = [one.at(one.pose) for one in placed]
        if all(distance_between(line, other) > _ROOM for k, line in enumerate(lines) for other in lines[:k]):
            return poses


def _run(case: Case, settings: CaseSettings) -> Json:
    rng = np.random.default_rng([case.model, 8])
    names = [str(name) for name in rng.permutation(OBJECT_NAMES)[: int(case.variant)]]
    sims = [make_object(name, case.model) for name in names]
    starts, goals = (_places([one.outline for one in sims], rng) for _ in range(2))
    pushed = {
        name: PushedObject(one, IDENTIFIED, np.random.default_rng([case.model, 9, k]))
        for k, (name, one) in enumerate(zip(names, sims, strict=True))
    }
    world = PushWorld(sims[0], pushed[names[0]].settings.pusher_radius)
    world.place(0, starts[0])
    for one, start in zip(sims[1:], starts[1:], strict=True):
        world.add(one, start, fixed=False)
    for k, name in enumerate(names):
        pushed[name].enter(world, k)
    try:
        return _bring(pushed, {name: Goal(goal) for name, goal in zip(names, goals, strict=True)}, world)
    finally:
        world.close()


def _bring(pushed: dict[str, PushedObject], goals: dict[str, Goal], world: PushWorld) -> Json:
    """Bring objects to their goals. `turns`: who was pushed, whether to make room, and how that ended."""
    order = SeveralGoals(goals, next(iter(pushed.values())).settings)
    outcome: Json = {"end": "ARRIVED", "pushes": 0, "time_s": 0.0, "turns": [], "reached": [], "plan_s": []}
    while True:
        seen = {name: one.observe() for name, one in pushed.items()}
        placed = {name: PlacedObject(one.truth.shape.outline, seen[name][0]) for name, one in pushed.items()}
        try:
            turn = order.next(placed)
        except NoTurnError:
            outcome["end"] = "NO_TURN"
            break
        if turn is None:
            break
        covariance = np.diag(SYSTEMATIC_STD**2)
        others = [Obstacle.of_object(name, one.outline, one.pose, covariance) for name, one in placed.items() if name != turn.object_id]
        made = push_there(pushed[turn.object_id], turn.goal, [one.outline for one in others], _MOST_PUSHES)
        outcome["turns"].append([turn.object_id, turn.is_aside, made["end"]])
        outcome["pushes"], outcome["time_s"] = outcome["pushes"] + made["pushes"], outcome["time_s"] + made["time_s"]
        outcome["plan_s"] += made["plan_s"]
        for number_of, one in enumerate(pushed.values()):
            one.pose = world.pose_of(number_of)
        order.note(turn, is_reached=made["reached"], has_moved=made["pushes"] > 0)
        if made["end"] == TOUCHED:
            outcome["end"] = TOUCHED
            break
    outcome["reached"] = [bool(goals[name].relative_error(one.pose) <= 1.0) for name, one in pushed.items()]
    if outcome["end"] == "ARRIVED" and not all(outcome["reached"]):
        outcome["end"] = "MISSED"
    return outcome


def _summarise(results: Sequence[CaseResult]) -> Json:
    numbers = {key: [r.values for r in cases] for key, cases in grouped(results, "variant").items()}
    return {
        "numbers": {key: _row(scenes) for key, scenes in numbers.items()},
        "success": share(scene["end"] == "ARRIVED" for scenes in numbers.values() for scene in scenes),
        "touched": sum(scene["end"] == TOUCHED for scenes in numbers.values() for scene in scenes),
    }


def _row(scenes: Sequence[Json]) -> Json:
    good = [scene for scene in scenes if scene["end"] == "ARRIVED"]
    return {
        "scenes": share(scene["end"] == "ARRIVED" for scene in scenes),
        "objects": share(there for scene in scenes for there in scene["reached"]),
        "touched": sum(scene["end"] == TOUCHED for scene in scenes),
        "aside": sum(is_aside for scene in scenes for _, is_aside, _ in scene["turns"]),
        "pushes": mean_of(scene["pushes"] for scene in good),
        "time_s": mean_of(scene["time_s"] for scene in good),
        "plan_s": mean_of(sum(scene["plan_s"]) for scene in good),
        "causes": failures((scene["end"] for scene in scenes), "ARRIVED"),
    }


def _tables(summary: Json) -> str:
    head = ["objects", "all at their goals (95 % interval)", "objects at their goals", "scenes with a touch", "made room", "pushes", "time"]
    head += ["planning", "Push Anything", "failures"]
    rows = [
        [
            key,
            share_text(row["scenes"]),
            share_text(row["objects"]),
            str(row["touched"]),
            str(row["aside"]),
            number(row["pushes"], "{:.1f}"),
            number(row["time_s"], "{:.0f} s"),
            number(row["plan_s"], "{:.0f} s"),
            f"{_REFERENCE[key]} s",
            causes_text(row["causes"]),
        ]
        for key, row in summary["numbers"].items()
    ]
    return markdown_table(head, rows)


def _answer(summary: Json) -> str:
    parts = [f"{key}: {row['scenes']['successes']} of {row['scenes']['n']}" for key, row in summary["numbers"].items()]
    return f"Scenes with all objects at their goals and no touch, by number of objects: {', '.join(parts)}."


STUDY = Experiment(
    name="several",
    title="Are several objects pushed to their poses, one after another?",
    question=(
        f"Two to four of the five objects lie in Bullet in a square of {2e2 * _REACH:.0f} cm, and each has a random goal in it; starts lie "
        f"{1e3 * _ROOM:.0f} mm apart at least, and so do goals, but an object may lie on the goal of another one. They are pushed to 20 mm "
        f"and 0.1 rad one after another, in at most {_MOST_PUSHES} pushes a turn. Poses have the errors of perception; each object was "
        "pushed three times at random before, alone. Success: the planner says so, all true poses agree, and no object or tool touched "
        "another object in any time step; a scene ends with the first touch. Time of the pushes with 0.4 s of rest before and after each, "
        "as in `goals`; planning by the processor, all plans of a scene. Beside it, as a reference, not like for like, the "
        "times of Push Anything, whose arm, objects and tolerances are others, and whose pushes of all objects are interleaved."
    ),
    objects=("mixed",),
    variants=_NUMBERS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
    headline=("success", "touched"),
)
