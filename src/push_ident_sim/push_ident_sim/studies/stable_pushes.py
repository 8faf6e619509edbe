"""Objects carried to goals by two fingers in Bullet, in one push along a Dubins path, without a map of mass or friction."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from typing import Final

import numpy as np

from push_ident.files import finite
from push_ident.geometry.cells import cell_error
from push_ident.geometry.outline import polygon_centroid
from push_ident.geometry.se2 import wrap_angle
from push_ident.physics.body import body_of_cells
from push_ident.planning.stable import StablePush, StableTurns, Support, contact_on_face, shortest_stable_push, stable_turns
from push_ident.types import Float64Array, ObjectShape, PusherShape
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import true_model
from push_ident_sim.studies.common.measuring import grouped, mean_of
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, millimetres

_TOOL: Final = PusherShape(0.004, fingers=np.array([[0.0, 0.012], [0.0, -0.012]]))
_KNOWN_FRICTION: Final = 0.8
"""Lower bounds of the friction of the fingers and of the table that the planner is given, over the true ones [-]."""
_SPEED: Final = 0.05
"""Of the reference point [m/s]."""
_TOLERANCE: Final = (0.005, float(np.radians(2.0)))
"""Within which an object is at its goal [m, rad], as in the experiment `goals`."""
_WORKSPACE: Final = (-0.6, 0.6, -0.6, 0.6)
"""Of object and tool [m]; the table is larger."""
_VARIANTS: Final = ("exact", "map", "camera", "centroid")


def turns_of(shape: ObjectShape, support: Support, friction: float) -> list[StableTurns]:
    """Stable arcs on each face, with the middle of the tool before the centre."""
    found = []
    for face, vertex in enumerate(shape.outline):
        edge = shape.outline[(face + 1) % len(shape.outline)] - vertex
        contact = contact_on_face(shape, _TOOL, face, float((support.centre - vertex) @ edge / np.linalg.norm(edge)))
        if contact is not None and (turns := stable_turns(contact, support, friction, _SPEED)) is not None:
            found.append(turns)
    return found


def _run(case: Case, settings: CaseSettings) -> Json:
    from push_ident_sim.engines.bullet.push_world import PushWorld  # reading results does not need Bullet

    thing = make_object(case.object_name, case.model)
    model = true_model(thing)
    centre = np.array(polygon_centroid(model.shape.outline)) if case.variant == "centroid" else model.centre_of_friction
    body = body_of_cells(model.shape, model.mass, model.friction)
    support = Support.unknown(model.shape, centre, _KNOWN_FRICTION * float(np.sum(body.limit)) / body.mass)
    if case.variant == "map":
        support = Support.of_bodies(model.shape.cells.centres, [body])
    turns = turns_of(model.shape, support, _KNOWN_FRICTION * model.pusher_friction)
    rows: list[Json] = []
    with closing(PushWorld(thing, _TOOL.radius, fingers=_TOOL.fingers)) as world:
        for number in range(settings.goals):
            rng = np.random.default_rng([case.model, number])
            goal = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(-np.pi, np.pi)])
            seen = np.zeros(3)
            if case.variant == "camera":
                seen = rng.normal(size=3) * [settings.noise.position_std, settings.noise.position_std, settings.noise.yaw_std]
            push = shortest_stable_push(turns, seen, goal, _TOOL, speed=_SPEED, clearance=0.01, workspace=_WORKSPACE)
            if push is not None:
                end = world.push(np.zeros(3), push.path).pose[-1]
                rows.append(_row(model.shape, push, end, goal))
    return finite({"faces": len(turns), "goals": settings.goals, "pushes": rows})


def _row(shape: ObjectShape, push: StablePush, end: Float64Array, goal: Float64Array) -> Json:
    off = float(np.hypot(*(end - goal)[:2])), abs(float(wrap_angle(end[2] - goal[2])))
    return {
        "error_m": cell_error(shape.cells, end, goal),
        "there": off[0] <= _TOLERANCE[0] and off[1] <= _TOLERANCE[1],
        "length_m": push.length,
        "radius_m": 1.0 / push.turns.curvature,
    }


def _summarise(results: Sequence[CaseResult]) -> Json:
    summary: Json = {"by_variant": {}}
    for variant, cases in grouped(results, "variant").items():
        rows = [row for case in cases for row in case.values["pushes"]]
        errors = [row["error_m"] for row in rows]
        summary["by_variant"][variant] = {
            "objects": len(cases),
            "faces": sum(case.values["faces"] for case in cases),
            "goals": sum(case.values["goals"] for case in cases),
            "pushes": len(rows),
            "there": sum(row["there"] for row in rows),
            **{key: mean_of((row[key] for row in rows), 6) for key in ("length_m", "radius_m")},
            "error_m": [round(float(np.percentile(errors, at)), 6) if errors else None for at in (50, 90, 100)],
        }
    return summary


def _tables(summary: Json) -> str:
    head = ["known", "objects, faces", "goals", "with a path", "there", "median, 90 %, largest error [mm]", "radius, length [mm]"]
    rows = [
        [
            variant, f"{row['objects']}, {row['faces']}", str(row["goals"]), str(row["pushes"]), str(row["there"]),
            ", ".join(millimetres(value) for value in row["error_m"]),
            f"{millimetres(row['radius_m'], 0)}, {millimetres(row['length_m'], 0)}",
        ]
        for variant, row in summary["by_variant"].items()
    ]  # fmt: skip
    return markdown_table(head, rows)


def _answer(summary: Json) -> str:
    parts = [f"{variant}: {row['there']} of {row['pushes']} planned pushes end there" for variant, row in summary["by_variant"].items()]
    return f"One push of two fingers without a map. {'; '.join(parts)}."


STUDY = Experiment(
    name="stable-pushes",
    title="Do two fingers carry an object to a goal without a map?",
    question=(
        "Two fingers push an object in Bullet to random goals within 0.3 m and any heading, in one push each along a Dubins "
        "path. exact: the push is [stable](../concepts/stable-pushes.md) whatever the pressure of the object is; nothing of the "
        "map is known but the centre of friction. map: the friction map is known, so that sharper arcs are stable. camera: as "
        "exact, but the first pose has the noise of a camera, 1 mm and 0.5 degrees. centroid: as exact, but the centroid of the "
        "outline is taken for the centre of friction, which it is not. In all, the friction of the fingers and, where the map "
        "is not known, that of the table are known to be at least 0.8 times the true ones, and the arcs have the reserve "
        "against inertia that their speed of 50 mm/s asks for. With a path: one that stays within 0.6 m of the middle of the "
        "table. There: within 5 mm and 2 degrees. No pose is looked at during a push."
    ),
    variants=_VARIANTS,
    stages=("geometry", "physics", "planning"),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    counts_goals=True,
)
