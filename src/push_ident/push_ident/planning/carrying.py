"""Pushes that carry an object to its goal with both ends of a tool on one face: stable under every model that may be true (`stable.py`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.se2 import transform_points
from push_ident.physics.batch import BatchModel
from push_ident.planning.library import Surroundings
from push_ident.planning.stable import StablePush, StableTurns, Support, contact_on_face, stable_pushes, stable_turns
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.sampling import push_with_both_ends
from push_ident.pushing.tool_path import ToolPath
from push_ident.types import Float64Array, ObjectShape

_N_POINTS: Final = 1000
"""Points of a path that a message holds: msg/ToolPath."""


@dataclass(frozen=True, slots=True, eq=False)
class CarryingPush:
    """A push by which the object arrives where it should be, as far as its pose is known."""

    plan: PushPlan2D
    """Its straight beginning, up to the contact."""
    path: ToolPath
    """Of the tool, with its yaw, table frame."""
    length: float
    """Of the path of the object [m]."""


def carrying_turns(shape: ObjectShape, models: Sequence[BatchModel], settings: PushSettings) -> list[StableTurns]:
    """Arcs that are stable under all models on each face, at the speed of pushes, with the middle of the tool as near to the centre of
    friction as the face allows."""
    support = Support.of_bodies(shape.cells.centres, [model.body for model in models])
    friction = min(model.pusher_friction for model in models)
    on_faces = []
    for face, vertex in enumerate(shape.outline):
        edge = shape.outline[(face + 1) % len(shape.outline)] - vertex
        length = float(np.linalg.norm(edge))
        if length < settings.span:
            continue
        along = np.clip(float((support.centre - vertex) @ edge) / length, 0.5 * settings.span, length - 0.5 * settings.span)
        contact = contact_on_face(shape, settings.tool, face, float(along))
        if contact is None or float((support.centre - contact.tool_in_object[:2]) @ contact.normal) <= 0.0:
            continue
        turns = stable_turns(contact, support, friction, settings.speed_range[0])
        if turns is not None and turns.curvature > 0.0:
            on_faces.append(turns)
    return on_faces


def carrying_pushes(
    shape: ObjectShape, turns: Sequence[StableTurns], settings: PushSettings, pose: Float64Array, goal: Float64Array, around: Surroundings
) -> Iterator[CarryingPush]:
    """Pushes from one pose to another, shape (3,) each, that keep tool and object in the workspace and the tool clear.

    The shortest come first of those that turn by less than half a turn, which every arm can make whose wrist turns by a whole one, then of
    the others: both ends are alike, so that it may begin half a turn away. Whether the object keeps clear of obstacles is for the caller to
    judge, with the uncertainty of its pose.
    """
    speed = settings.speed_range[0]
    every = [push for one in turns for push in stable_pushes(one, pose, goal, settings.tool, speed=speed, clearance=settings.clearance)]
    now = settings.excess(transform_points(pose, shape.outline))
    for push in sorted(every, key=lambda push: (_turned(push) > np.pi, push.length)):
        if (carrying := _possible(shape, settings, pose, push, around)) is not None and _stays(shape, push, settings, now):
            yield carrying


def _turned(push: StablePush) -> float:
    """Range of its headings [rad]."""
    return float(np.ptp(push.poses[:, 2]))


def _stays(shape: ObjectShape, push: StablePush, settings: PushSettings, now: float) -> bool:
    """Whether the object reaches no further out of the workspace than now [m], all the way."""
    return settings.excess(transform_points(push.poses, shape.outline).reshape(-1, 2)) <= max(now, 0.0)


def _possible(
    shape: ObjectShape, settings: PushSettings, pose: Float64Array, push: StablePush, around: Surroundings
) -> CarryingPush | None:
    if len(push.path.time) > _N_POINTS:
        return None
    try:
        path = ToolPath(push.path.time, push.path.position, push.path.yaw)
        # Before the tool rises it may back off by the clearance at most: the object is there.
        plan = push_with_both_ends(shape, pose, path, settings, around.obstacles, back_off=settings.clearance)
    except (PlanningError, InputError):  # the arm must not make it, or it is longer than any push
        return None
    return None if around.has_failed(plan) else CarryingPush(plan, path, push.length)
