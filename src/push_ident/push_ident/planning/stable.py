"""Stable pushes: a tool with two contacts on a face carries the object along as if it were fixed to it.

Lynch & Mason, Stable pushing: mechanics, controllability, and planning, IJRR 1996; as arcs of a car: Zhou & Mason, Pushing revisited,
ISRR 2017.

An object that turns with the tool about a centre slides on the table with known velocities, whatever bears its load. The friction of the
table then balances the wrench

    w(p) = sum_i p_i (u_i, r_i x u_i)        u_i: direction of the velocity at r_i;  p_i: share of the friction there, sum_i p_i = 1

The push is stable where w(p) lies inside the cone of the wrenches that both contacts can exert, a . w > 0 for each of its faces a. For a
belief, p are the friction loads of its models. Without one, p is any distribution on the base whose centre is known: w is linear in p, so
that the least a . w over all of them is a linear program, whose solution is a convex envelope. Nothing of the map is needed then but the
centre of friction, which is the centre of mass where the friction coefficient is uniform, and a lower bound of the friction of the tool.

At speed the contacts also accelerate the object. Its reference point goes at a constant speed v, the curvature k of its path changes by at
most k' a metre: it turns at v k, and its angular velocity changes by at most v^2 k'. That gives the acceleration of the centre of mass, and
with mass and inertia over the friction of the object the wrench which is added to w(p). The mass over the friction is the inverse of the
deceleration of an object that slides freely.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

from push_ident.errors import InputError
from push_ident.geometry.dubins import DubinsPath, dubins_paths
from push_ident.geometry.outline import edge_normals
from push_ident.geometry.se2 import compose, inverse
from push_ident.physics.body import BodyParameters
from push_ident.types import Float64Array, ObjectShape, PusherPath, PusherShape

_HALVINGS: Final = 10
"""Of the interval of curvatures, from 0 to a turn about an end of the tool: to a thousandth of it."""
_SMALLER: Final = 7
"""Smaller curvatures that are tried beside the largest."""
_SPACING: Final = 0.01
"""Of the poses of a path, over the distance of the contacts [1]: the sharpest turn is about one of them."""
_MOST_POINTS: Final = 950
"""Poses of a path: a message holds 1000."""
_MEANS: Final = 40
"""Points that a mean over the length of a change of the curvature is taken of."""
_FIXED_POINT_STEPS: Final = 40
"""Each is nearer by a factor of 2 at least, up to arcs about an end of the tool: to rounding."""
_DEPTHS: Final = (0.0, 0.5, 1.0, 1.5)
"""Depths of the reference point behind the centre, in units of (radius of gyration)^2 / depth of the centre: at 1 are the rotation centres
of forces through the middle of the tool, where the limit surface is an ellipsoid."""


@dataclass(frozen=True, slots=True)
class FaceContact:
    """A tool with two contacts on one straight face of an object."""

    tool_in_object: Float64Array
    """Pose of the tool's frame (x, y, yaw) [m, m, rad], shape (3,); its x axis points into the object."""
    points: Float64Array
    """Contacts [m], shape (2, 2), object frame."""
    normal: Float64Array
    """Into the object, shape (2,), object frame."""

    @property
    def apart(self) -> float:
        """Distance of the contacts [m]."""
        return float(np.linalg.norm(self.points[1] - self.points[0]))


@dataclass(frozen=True, slots=True)
class Support:
    """What may bear the load of the object: friction loads of models, or any with one centre."""

    places: Float64Array
    """Points of the base [m], shape (n, 2), object frame."""
    loads: Float64Array
    """Share of the friction at each point in each model, shape (n_models, n); of no rows: any distribution about `centre`."""
    centre: Float64Array
    """Of friction [m], shape (2,), object frame."""
    inertia: Float64Array
    """Centre of mass x, y [m], mass over friction [s^2/m] and inertia about that centre over friction [m s^2] in each model, shape
    (n_models, 4), or (1, 4) of any distribution; 0 where the object moves so slowly that they do not matter."""

    @classmethod
    def of_models(cls, places: Float64Array, friction: Float64Array) -> Support:
        """From friction limits of the cells in each model, shape (n_models, n), of any scale. Raises InputError where one has none."""
        friction = np.atleast_2d(np.asarray(friction, dtype=np.float64))
        total = friction.sum(axis=1, keepdims=True)
        if not (np.isfinite(friction).all() and np.all(friction >= 0.0) and np.all(total > 0.0)):
            raise InputError("A model has no friction, or friction below 0; a stable push needs some to hold the object.")
        loads = friction / total
        return cls(places, loads, np.mean(loads, axis=0) @ places, np.zeros((len(loads), 4)))

    @classmethod
    def of_bodies(cls, places: Float64Array, bodies: Sequence[BodyParameters]) -> Support:
        """From bodies that may be true, with their inertia. Raises InputError as `of_models`."""
        support = cls.of_models(places, np.array([body.limit for body in bodies]))
        rows = [[*body.centre, body.mass / np.sum(body.limit), body.inertia / np.sum(body.limit)] for body in bodies]
        return replace(support, inertia=np.array(rows))

    @classmethod
    def unknown(cls, shape: ObjectShape, centre: Float64Array, deceleration: float = np.inf) -> Support:
        """Any pressure on the vertices of the outline and the cells inside of it, and any mass there with the same centre.

        `deceleration`: least one of the object when it slides freely, its friction coefficient times the gravity [m/s^2]; infinite: its
        inertia does not matter. Raises InputError for a centre outside of them, or no positive deceleration.
        """
        if not deceleration > 0.0:
            raise InputError(f"The object decelerates at {deceleration} m/s^2, expected more than 0: its friction coefficient times 9.81.")
        places, centre = np.vstack([shape.outline, shape.cells.centres]), np.asarray(centre, dtype=np.float64)
        support = cls(places, np.empty((0, 0)), centre, np.zeros((1, 4)))
        support.least(np.zeros(len(places)))
        gyration = -support.least(-np.sum((places - centre) ** 2, axis=1))
        return replace(support, inertia=np.array([[*centre, 1.0 / deceleration, gyration / deceleration]]))

    def least(self, values: Float64Array, inertial: Float64Array | float = 0.0) -> float:
        """Smallest mean of `values` at the points, shape (n,), over what may bear the load, each with what a row of `inertia` adds,
        `inertial`, shape (n_models,). Raises InputError where nothing can."""
        if len(self.loads):
            return float(np.min(self.loads @ values + inertial))
        return self._envelope(values) + float(np.min(inertial))

    def _envelope(self, values: Float64Array) -> float:
        try:
            # The least mean about a centre is the lower convex envelope of the values there: the largest of its planes.
            planes = ConvexHull(np.column_stack([self.places, values])).equations
        except QhullError:
            return self._by_linear_program(values)
        below = planes[planes[:, 2] < -1e-9]
        return float(np.max(-(below[:, :2] @ self.centre + below[:, 3]) / below[:, 2]))

    def _by_linear_program(self, values: Float64Array) -> float:
        """The same of values on a plane, which have no hull; and whether there is such a load at all."""
        equal = np.vstack([np.ones(len(self.places)), self.places.T])
        solved = linprog(values, A_eq=equal, b_eq=np.array([1.0, *self.centre]), method="highs")
        if not solved.success:
            raise InputError(f"No pressure on the base has its centre at {self.centre} m; give a centre inside the outline.")
        return float(solved.fun)


@dataclass(frozen=True, slots=True)
class Drive:
    """How fast a contact is driven along a path."""

    speed: float
    """Of the reference point [m/s]."""
    depth: float
    """Of that point before the tool's frame, along its x axis [m]."""
    change: float
    """Most by which the curvature of its path changes [1/m^2]."""


@dataclass(frozen=True, slots=True)
class StableTurns:
    """Arcs along which a contact carries the object: its reference point goes straight ahead in the frame of the tool, or turns."""

    contact: FaceContact
    depth: float
    """Of the reference point before the tool's frame, along its x axis [m]."""
    curvature: float
    """Largest of an arc to either side [1/m]; all smaller ones are stable too."""
    blend: float = 0.0
    """Length over which the curvature goes from one arc to the next [m]; 0: at once."""

    @property
    def reference_in_object(self) -> Float64Array:
        """Frame of the reference point (x, y, yaw), shape (3,), object frame."""
        return compose(self.contact.tool_in_object, np.array([self.depth, 0.0, 0.0]))


@dataclass(frozen=True, slots=True)
class StablePush:
    """A push along a Dubins path."""

    turns: StableTurns
    path: PusherPath
    """Of the tool, in the table frame."""
    poses: Float64Array
    """Of the object at the same times, from the start of contact on; shape (n_samples, 3)."""
    length: float
    """Of the path of the reference point [m]."""


def contact_on_face(shape: ObjectShape, tool: PusherShape, face: int, along: float) -> FaceContact | None:
    """Contact of two fingers, or a plate, whose middle stands before a point of a face; None where an end stands beyond the face.

    Args:
        face: number of the edge of the outline, from vertex `face` to the next.
        along: distance of that point from the vertex [m].

    Raises InputError for a tool that has not two ends on the y axis of its frame, at equal distances.
    """
    core = tool.core
    if core.shape != (2, 2) or np.abs(core[:, 0]).max() > 1e-9 or abs(core[0, 1] + core[1, 1]) > 1e-9:
        raise InputError("A stable push needs two fingers or a plate, with both ends on the y axis of its frame, equally far from x.")
    first, second = shape.outline[face], shape.outline[(face + 1) % len(shape.outline)]
    length, half = float(np.linalg.norm(second - first)), float(np.abs(core[0, 1]))
    if not half <= along <= length - half:
        return None
    normal = -edge_normals(shape.outline)[face]
    edge = (second - first) / length
    middle = first + along * edge
    pose = np.array([*(middle - tool.radius * normal), np.arctan2(normal[1], normal[0])])
    return FaceContact(pose, middle + half * np.array([[1.0], [-1.0]]) * edge, normal)


def stable_margin(
    contact: FaceContact, support: Support, friction: float, centre: Float64Array | None, turn: int, drive: Drive | None = None
) -> float:
    """How far inside the cone of the contacts the wrench of the table lies, over the friction of the object [-]; negative: outside.

    The least over all faces of the cone and over what may bear the load; torques count by half the distance of the contacts.

    Args:
        friction: coefficient of the tool on the object.
        centre: of rotation [m], shape (2,), object frame; None for a translation along the normal.
        turn: 1 for a turn to the left, -1 to the right.
        drive: how fast the object is pushed; None: so slowly that its inertia does not matter.
    """
    if centre is None:
        direction = np.tile(contact.normal, (len(support.places), 1))
    else:
        arm = support.places - centre
        distance = np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
        direction = turn * np.column_stack([-arm[:, 1], arm[:, 0]]) / distance[:, None]
    middle, unit = contact.points.mean(axis=0), 0.5 * contact.apart
    torque = _cross(support.places - middle, direction) / unit
    wrench = np.column_stack([direction, torque])
    added = [np.zeros((len(support.inertia), 3))] if drive is None else _inertial(contact, support, centre, drive)
    return min(support.least(wrench @ face, rows @ face) for face in _cone(contact, friction, middle, unit) for rows in added)


def _inertial(contact: FaceContact, support: Support, centre: Float64Array | None, drive: Drive) -> list[Float64Array]:
    """Wrenches that accelerate the object, over its friction, where the curvature rises and falls as fast as it may: each of shape
    (n_models, 3), torques as in `stable_margin`."""
    ahead = contact.normal
    left, middle = np.array([-ahead[1], ahead[0]]), contact.points.mean(axis=0)
    reference = compose(contact.tool_in_object, np.array([drive.depth, 0.0, 0.0]))[:2]
    curvature = 0.0 if centre is None else 1.0 / float((centre - reference) @ left)
    arm, speed2 = support.inertia[:, :2] - reference, drive.speed**2
    wrenches = []
    for rate in (speed2 * drive.change, -speed2 * drive.change):
        acceleration = speed2 * curvature * left + rate * np.column_stack([-arm[:, 1], arm[:, 0]]) - speed2 * curvature**2 * arm
        force = support.inertia[:, 2:3] * acceleration
        torque = _cross(support.inertia[:, :2] - middle, force) + support.inertia[:, 3] * rate
        wrenches.append(np.column_stack([force, torque / (0.5 * contact.apart)]))
    return wrenches


def stable_turns(contact: FaceContact, support: Support, friction: float, speed: float = 0.0) -> StableTurns | None:
    """The sharpest arcs to both sides that are stable; None where not even a push straight ahead is.

    Of a few depths of the reference point that is taken whose arcs are the sharpest. `speed`: of that point [m/s]; at speed the curvature
    changes over a length as that between the contacts, from one side to the other at most.
    """
    if stable_margin(contact, support, friction, None, 1) <= 0.0:
        return None
    ahead = float((support.centre - contact.tool_in_object[:2]) @ contact.normal)
    gyration = float(np.mean(np.sum((support.places - support.centre) ** 2, axis=1)))
    best: StableTurns | None = None
    for factor in _DEPTHS:
        depth = ahead + factor * gyration / ahead
        curvature = min(_sharpest(contact, support, friction, depth, turn, speed) for turn in (1, -1))
        if best is None or curvature > best.curvature:
            best = StableTurns(contact, depth, curvature, contact.apart if speed else 0.0)
    return best


def stable_pushes(
    turns: StableTurns, start: Float64Array, goal: Float64Array, tool: PusherShape, *, speed: float, clearance: float = 0.0
) -> list[StablePush]:
    """Pushes with a contact that carry the object from one pose to another, the shortest first; none where it can only go straight.

    Args:
        start, goal: poses of the object (x, y, yaw) [m, m, rad], shape (3,), table frame.
        speed: of the reference point [m/s].
        clearance: from the object, from which the tool comes straight ahead [m].
    """
    if turns.curvature <= 0.0:
        return []
    reference, ahead = turns.reference_in_object, np.array([0.5 * turns.blend, 0.0, 0.0])
    first, last = compose(compose(start, reference), ahead), compose(compose(goal, reference), -ahead)
    pushes = []
    for path in dubins_paths(first, last, 1.0 / _of_arcs(turns.curvature, turns.blend)):
        along = _blended(path, last, turns)
        poses = compose(along, inverse(reference))
        tool_poses = compose(poses, turns.contact.tool_in_object)
        back = compose(tool_poses[0], np.array([-clearance, 0.0, 0.0]))
        n_back = 1 if clearance > 0.0 else 0
        driven = np.vstack([*[back] * n_back, tool_poses])
        steps = np.linalg.norm(np.diff(along[:, :2], axis=0), axis=1)
        travelled = np.concatenate([np.zeros(1), np.full(n_back, clearance), steps])
        driven[:, 2] = np.unwrap(driven[:, 2])
        tool_path = PusherPath(np.cumsum(travelled) / speed, driven[:, :2], tool.radius, tool.polygon, driven[:, 2], tool.fingers)
        pushes.append(StablePush(turns, tool_path, np.vstack([*[poses[0]] * n_back, poses]), path.length + turns.blend))
    return pushes


def _blended(path: DubinsPath, end: Float64Array, turns: StableTurns) -> Float64Array:
    """Poses of the reference point, shape (n, 3), along a path of arcs to `end`, whose curvature changes over `turns.blend`.

    It is straight for half that length before and after. Each pose is the mean over that length of the path of arcs: its velocity is a mean
    of theirs, so that its curvature goes evenly from one to the next. On an arc it is a circle within it (`_of_arcs`).
    """
    # Along a chord the tool goes up to half its angle aside of the arc: on the sharpest, a hundredth of a radian.
    spacing, half = max(_SPACING * turns.contact.apart, (path.length + turns.blend) / _MOST_POINTS), 0.5 * turns.blend
    if not half:
        return path.poses(spacing)
    arcs, ahead = path.poses(0.1 * half), np.array([2.0 * half, 0.0, 0.0])
    # Straight on at both ends, as far as the means there reach.
    arcs = np.vstack([compose(path.start, -ahead), arcs, compose(end, ahead)])
    arcs[0, 2], arcs[-1, 2] = arcs[1, 2], arcs[-2, 2]
    length = np.concatenate([np.zeros(1), np.cumsum(np.linalg.norm(np.diff(arcs[:, :2], axis=0), axis=1))])
    middle = np.linspace(half, length[-1] - half, 1 + math.ceil((length[-1] - 2.0 * half) / spacing))
    over = middle[:, None] + half * (2.0 * (np.arange(_MEANS) + 0.5) / _MEANS - 1.0)
    return np.column_stack([np.interp(over, length, column).mean(axis=1) for column in arcs.T])


def _of_arcs(curvature: float, blend: float) -> float:
    """Curvature of the arcs of which means over a length [m] have the given one [1/m].

    The mean velocity over an angle a is sin(a / 2) / (a / 2) times as fast, and turns as fast.
    """
    of_arcs = curvature
    for _ in range(_FIXED_POINT_STEPS):
        of_arcs = curvature * float(np.sinc(0.5 * of_arcs * blend / np.pi))
    return of_arcs


def shortest_stable_push(
    options: list[StableTurns],
    start: Float64Array,
    goal: Float64Array,
    tool: PusherShape,
    *,
    speed: float,
    clearance: float = 0.0,
    workspace: tuple[float, float, float, float] | None = None,
) -> StablePush | None:
    """The shortest push of all contacts; None where none leads to the goal.

    `workspace`: x_min, x_max, y_min, y_max [m], within which the frames of object and tool have to stay, table frame. The other arguments
    are those of `stable_pushes`.
    """
    pushes = (push for turns in options for push in stable_pushes(turns, start, goal, tool, speed=speed, clearance=clearance))
    possible = (push for push in pushes if workspace is None or _stays(push, workspace))
    return min(possible, key=lambda push: push.length, default=None)


def _stays(push: StablePush, workspace: tuple[float, float, float, float]) -> bool:
    """Whether object and tool stay in a workspace."""
    low, high = np.array(workspace[::2]), np.array(workspace[1::2])
    places = np.vstack([push.poses[:, :2], push.path.position])
    return bool(np.all((places >= low) & (places <= high)))


def _sharpest(contact: FaceContact, support: Support, friction: float, depth: float, turn: int, speed: float) -> float:
    """Largest curvature to one side up to which all are stable [1/m]: by bisection, and then some of the smaller ones."""

    def is_stable(curvature: float, largest: float) -> bool:
        # From one side to the other over the length of a mean, which is as much shorter as its arcs are less curved, and once more so where
        # it turns from one side to the other.
        change = 2.0 * largest**3 / (contact.apart * _of_arcs(largest, contact.apart) ** 2) if speed else 0.0
        drive = Drive(speed, depth, change) if speed else None
        centre = compose(contact.tool_in_object, np.array([depth, turn / curvature, 0.0]))[:2] if curvature else None
        return stable_margin(contact, support, friction, centre, turn, drive) > 0.0

    stable, high = 0.0, 2.0 / contact.apart
    for _ in range(_HALVINGS):
        middle = 0.5 * (stable + high)
        # Where the curvature begins to change, the tool still goes straight ahead.
        is_middle = is_stable(middle, middle) and (not speed or is_stable(0.0, middle))
        stable, high = (middle, high) if is_middle else (stable, middle)
    for k in range(1, _SMALLER + 1):
        if stable > 0.0 and not is_stable(stable * k / (_SMALLER + 1), stable):
            return stable * (k - 1) / (_SMALLER + 1)
    return stable


def _cone(contact: FaceContact, friction: float, middle: Float64Array, unit: float) -> Iterator[Float64Array]:
    """Inward unit normals of the faces of the cone of wrenches about `middle` that two contacts exert, each shape (3,)."""
    tangent = np.array([-contact.normal[1], contact.normal[0]])
    edges = [contact.normal + sign * friction * tangent for sign in (1.0, -1.0)]
    rays = np.array([[*edge, _cross(point - middle, edge) / unit] for point in contact.points for edge in edges])
    for i in range(4):
        for j in range(i):
            face = np.cross(rays[i], rays[j])
            size = float(np.linalg.norm(face))
            for sign in (1.0, -1.0):
                if size > 0.0 and np.all(sign * rays @ face >= -1e-12):
                    yield sign * face / size


def _cross(a: Float64Array, b: Float64Array) -> Float64Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
