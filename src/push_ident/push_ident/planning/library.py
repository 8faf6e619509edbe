"""Motions of an object by pushes, in its own frame: contacts over the whole outline, directions about the normal, many lengths.

On an even table the motion does not depend on the pose of the object. So one library holds for every pose, also for the second and third
push of a plan. It holds the motion for the mean model and for models of the posterior.

Effects such as a tilt of the table make the motion depend on the pose. A library is then of one pose: exact for the push from there,
approximate for those after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.physics.body import BodyParameters
from push_ident.physics.effect_values import NO_EFFECTS, effect_values
from push_ident.physics.effects import CAUSES
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.planning.goal import EdgeHold
from push_ident.planning.keep_out import compile_keep_out, distance_between
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.sampling import check_push
from push_ident.types import CellGrid, Float64Array, ObjectShape, PusherPath


@dataclass(frozen=True, slots=True)
class LibraryOptions:
    """Size of a library of pushes."""

    n_contacts: int = 48
    """Contacts along the outline."""
    length_step: float = 0.004
    """Step of the lengths of a push [m]."""
    max_length: float = 0.16
    """Largest travel after contact [m]: longer pushes are hardly predictable, and between two shorter ones the object is observed."""
    corner_distance: float = 1e-3
    """Least distance of contacts from the ends of an edge [m], where a small error would miss it."""


_OPTIONS: Final = LibraryOptions()
_DIRECTIONS: Final = np.radians([-40.0, -25.0, -10.0, 0.0, 10.0, 25.0, 40.0])
"""About the inward normal: within a cone of friction coefficient 0.84 [rad]."""
BATCH_STEP: Final = 1.0 / 100.0
"""Of batched simulations [s]: ends of pushes of 6 to 10 cm at 0.1 m/s lie within 0.1 mm of the default step's in the median, 0.2 mm in 95 %
(`push-ident bench batches`)."""
DRAW_STEP: Final = 1.0 / 60.0
"""The same of the models in a library that may be true [s], with ends within 0.2 mm in the median, 0.4 mm in 95 %: they show how far ends
spread, by millimetres, and the pushes that are judged last are simulated anew with the step above."""
_SAME_POSE: Final = np.array([0.02, 0.02, 0.1])
"""Distance [m, m, rad] up to which a library of one pose is taken at another one: the turn changes a force of the table by a tenth of it,
and the pushes that are chosen are simulated once more where they are made."""
_CONE: Final = float(np.radians(45.0))
"""Largest angle between a push and the inward normal [rad]."""


@dataclass(frozen=True, slots=True)
class Strokes:
    """Straight pushes of an object at the pose (0, 0, 0), each touching the outline first where it is planned."""

    contact: Float64Array
    """On the outline [m], shape (n, 2)."""
    tool: Float64Array
    """Axis of the pusher at contact [m], shape (n, 2)."""
    tangent: Float64Array
    """Unit vector along the edge, counter-clockwise, shape (n, 2)."""
    direction: Float64Array
    """Heading [rad], shape (n,)."""
    room: Float64Array
    """Distance of the contact from either end of its edge [m], shape (n,)."""

    def __len__(self) -> int:
        return len(self.direction)

    def heading(self) -> Float64Array:
        """Unit vectors, shape (n, 2)."""
        return np.stack([np.cos(self.direction), np.sin(self.direction)], axis=-1)

    def picked(self, number: int) -> Strokes:
        """One of them."""
        one = slice(number, number + 1)
        return Strokes(self.contact[one], self.tool[one], self.tangent[one], self.direction[one], self.room[one])

    @property
    def direction_from_normal(self) -> float:
        """Angle between the first stroke and the inward normal [rad]."""
        inward = np.arctan2(self.tangent[0, 0], -self.tangent[0, 1])
        return float(wrap_angle(self.direction[0] - inward))

    def changed(self, along: float, turn: float) -> Strokes:
        """One stroke with its contact moved along the edge [m], within the edge, and turned [rad], within a cone of 45 degrees."""
        along = float(np.clip(along, -self.room[0], self.room[0]))
        angle = float(np.clip(self.direction_from_normal + turn, -_CONE, _CONE))
        shift = along * self.tangent
        inward = self.direction - self.direction_from_normal
        return Strokes(
            self.contact + shift, self.tool + shift, self.tangent, np.asarray(wrap_angle(inward + angle)), self.room - abs(along)
        )


@dataclass(frozen=True, slots=True)
class Library:
    """Motions of the object under each stroke, cut off after each length."""

    strokes: Strokes
    lengths: Float64Array
    """Travel after contact [m], shape (n_lengths,)."""
    motion: Float64Array
    """Pose of the object after the push in its frame before it, shape (n_models, n_strokes, n_lengths, 3); NaN where a simulation failed.
    The first model is the mean."""
    variance: Float64Array
    """Of `motion` over the models [m^2, m^2, rad^2], shape (n_strokes, n_lengths, 3)."""
    centres: Float64Array
    """Centres of mass of the models [m], shape (n_models, 2), object frame."""
    pose: Float64Array
    """Of the object at the start of all strokes, table frame of the arm, shape (3,)."""

    @classmethod
    def of(
        cls, belief: Belief, contacts: Strokes, settings: PushSettings, pose: Float64Array, n_draws: int, rng: np.random.Generator
    ) -> Library:
        """Simulate all strokes with the mean model and with `n_draws` models that may be true.

        `pose` is that of the object, table frame of the arm, shape (3,); it matters where the motion depends on the pose.
        """
        lengths = np.arange(_OPTIONS.length_step, min(_OPTIONS.max_length, settings.max_distance) + 1e-9, _OPTIONS.length_step)
        speed = settings.speed_range[0]
        first, pushes = pose if belief.depends_on_pose else np.zeros(3), []
        for tool, heading in zip(contacts.tool, contacts.heading(), strict=True):
            path = path_of(tool, heading, float(lengths[-1]), speed, settings)
            pushes.append(BatchPush(moved(first, path), first, (settings.clearance + lengths) / speed))
        models = belief.models(n_draws, rng)
        centres = np.array([model.body.centre for model in models])
        poses = [simulated(belief, some, pushes, step=step) for some, step in ((models[:1], BATCH_STEP), (models[1:], DRAW_STEP)) if some]
        motion = compose(inverse(first), np.concatenate(poses))
        known = np.isfinite(motion)
        n, filled = np.maximum(np.sum(known, axis=0), 1), np.where(known, motion, 0.0)
        deviation = np.where(known, motion - np.sum(filled, axis=0) / n, 0.0)
        return cls(contacts, lengths, motion, np.sum(deviation**2, axis=0) / n, centres, first)

    @property
    def spread_by_length(self) -> float:
        """Standard deviation of the ends over the models, along the worse axis, by the length of the push: the median [1]."""
        return float(np.median(np.sqrt(np.max(self.variance[..., :2], axis=-1)) / self.lengths))

    def holds_at(self, belief: Belief, pose: Float64Array) -> bool:
        """Whether it holds for an object at a pose, table frame of the arm, shape (3,)."""
        if not belief.depends_on_pose:
            return True
        difference = np.append((pose - self.pose)[:2], wrap_angle(pose[2] - self.pose[2]))
        return bool(np.all(np.abs(difference) <= _SAME_POSE))


def simulated(
    belief: Belief, models: Sequence[BatchModel], pushes: Sequence[BatchPush], edge: TableEdge | None = None, step: float = BATCH_STEP
) -> Float64Array:
    """As `rollouts`, with the law of friction of a belief."""
    law = belief.numerics
    return rollouts(belief.shape, models, pushes, step=step, edge=edge, smoothing_speed=law.smoothing_speed, quasi_static=law.quasi_static)


def moved(pose: Float64Array, path: PusherPath) -> PusherPath:
    """A path beside an object at (0, 0, 0) as one beside the object at a pose, shape (3,)."""
    return PusherPath(path.time, transform_points(pose, path.position), path.radius)


def path_of(tool: Float64Array, heading: Float64Array, distance: float, speed: float, settings: PushSettings) -> PusherPath:
    """Straight path at constant speed from `clearance` before the contact at `tool`, shape (2,), along a unit vector, shape (2,)."""
    ends = tool + np.outer([-settings.clearance, distance], heading)
    return PusherPath(np.array([0.0, (settings.clearance + distance) / speed]), ends, settings.pusher_radius)


def strokes(shape: ObjectShape, settings: PushSettings, obstacles: Sequence[Float64Array] = ()) -> Strokes:
    """All contacts and directions whose first contact is the planned one; the workspace does not count."""
    anywhere = replace(settings, workspace=(-np.inf, np.inf, -np.inf, np.inf))
    rows: list[tuple[Float64Array, Float64Array, Float64Array, float, float]] = []
    for contact, tangent, room in _contacts(shape.outline):
        normal = np.array([tangent[1], -tangent[0]])
        tool = contact + settings.pusher_radius * normal
        for angle in _DIRECTIONS:
            direction = float(wrap_angle(np.arctan2(-normal[1], -normal[0]) + angle))
            try:
                check_push(
                    PushPlan2D(contact, tool, direction, _OPTIONS.length_step, settings.speed_range[0]), shape.outline, anywhere, obstacles
                )
            except PlanningError:
                continue
            rows.append((contact, tool, tangent, direction, room))
    columns = list(zip(*rows, strict=True)) or [()] * 5
    two = (-1, 2)
    return Strokes(
        np.reshape(columns[0], two), np.reshape(columns[1], two), np.reshape(columns[2], two), np.array(columns[3]), np.array(columns[4])
    )


def _contacts(outline: Float64Array) -> list[tuple[Float64Array, Float64Array, float]]:
    """Points spread evenly over the outline, with the tangent of their edge and the distance from its nearer end [m]."""
    edges = np.roll(outline, -1, axis=0) - outline
    lengths = np.linalg.norm(edges, axis=1)
    spacing = lengths.sum() / _OPTIONS.n_contacts
    contacts = []
    for start, edge, length in zip(outline, edges, lengths, strict=True):
        n = max(1, round(length / spacing))
        for k in range(n if length > 2 * _OPTIONS.corner_distance else 0):
            along = np.clip((k + 0.5) * length / n, _OPTIONS.corner_distance, length - _OPTIONS.corner_distance)
            contacts.append((start + along / length * edge, edge / length, float(min(along, length - along))))
    return contacts


def placed(group: Strokes, number: int, pose: Float64Array, distance: float, speed: float) -> PushPlan2D:
    """One stroke of an object at a pose, shape (3,), as a plan in the table frame."""
    return PushPlan2D(
        transform_points(pose, group.contact[number][None])[0],
        transform_points(pose, group.tool[number][None])[0],
        float(wrap_angle(group.direction[number] + pose[2])),
        distance,
        speed,
    )


def compile_planning() -> None:
    """Compile the kernels of batched rollouts, without and with effects, on the table and at its edge, or load them: no plan waits."""
    square = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])
    shape = ObjectShape(CellGrid(np.zeros((1, 2)), 0.02), square)
    body = BodyParameters(0.1, np.zeros(2), 1e-5, np.array([0.3]))
    path = PusherPath(np.array([0.0, 0.1]), np.array([[-0.02, 0.0], [0.0, 0.0]]), 0.005)
    pushes = [BatchPush(path, np.zeros(3), np.array([0.1]))]
    # One effect stands for all: they share the kernel.
    for effects in (NO_EFFECTS, effect_values(CAUSES[:1])):
        for edge in (None, TableEdge(np.array([1.0, 0.0]), 1.0)):
            model = BatchModel(body, 0.3, weight=np.ones(1), effects=effects)
            rollouts(shape, [model], pushes, step=0.01, n_threads=1, edge=edge)
    compile_keep_out()


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Constraints of a push other than the workspace."""

    obstacles: Sequence[Float64Array] = ()
    """Outlines that must not be touched, with their clearance, table frame [m], each of shape (n_vertices, 2)."""
    failed: Sequence[PushPlan2D] = ()
    """Pushes from this pose that did not move the object, or could not be made."""
    hold: EdgeHold | None = None
    """An edge of the table near the object."""
    same_contact: float = 0.004
    """A push whose contact is within this distance of one that failed from the same pose is not proposed again [m]."""
    n_poses: int = 4
    """Poses along a push, the first included, at which the object is compared with obstacles and edges."""

    def has_failed(self, push: PushPlan2D) -> bool:
        """Whether a push with this contact failed before."""
        return any(bool(np.linalg.norm(push.contact_point - other.contact_point) < self.same_contact) for other in self.failed)


def is_possible(
    shape: ObjectShape, settings: PushSettings, plan: PushPlan2D, pose: Float64Array, motion: Float64Array, around: Surroundings
) -> bool:
    """Whether a push keeps tool and object within the workspace, touches nothing before, and did not fail before.

    `pose`: of the object before it, table frame; `motion`: what the push is expected to do, in the object's frame. Both of shape (3,).
    """
    if around.has_failed(plan):
        return False
    motions = np.linspace(0.0, 1.0, around.n_poses)[1:, None] * motion
    outline, *later = (transform_points(p, shape.outline) for p in (pose, *compose(pose, motions)))
    # The tool need not reach the part that overhangs the table.
    before, after = (p if around.hold is None else p[around.hold.edge.beyond(p) <= 0.0] for p in (outline, later[-1]))
    if settings.excess(after) > settings.excess(before):
        return False
    if any(distance_between(one, other) < min(distance_between(outline, other), 0.0) for other in around.obstacles for one in later):
        return False
    try:
        check_push(plan, outline, settings, around.obstacles)
    except PlanningError:
        return False
    return True
