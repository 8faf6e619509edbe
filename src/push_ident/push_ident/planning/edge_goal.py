"""A goal at the edge of the table: the object shall overhang it, to be grasped there, and stay on the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.se2 import rotation, transform_points, wrap_angle
from push_ident.geometry.table import Table
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.planning.goal import EdgeHold, Goal, GoalCode, GoalRefusedError, Target
from push_ident.planning.obstacle import RISK
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class EdgeGoal:
    """Overhang an edge of the table by `overhang`, held on the table by at least `held`.

    Raises:
        InputError: a number that is not finite or positive, with the remedy.
    """

    edge: TableEdge | None
    """Table frame; None: the nearest known one."""
    overhang: float = 0.04
    """Of the outline beyond the edge [m]."""
    held: float = 0.01
    """Least distance of the centre of mass from the border of what supports it [m], see `EdgeHold.margin`."""
    yaw: float | None = None
    """Heading of the pre-grasp pose [rad]; None: the nearest that is held."""
    position: float = 0.02
    """Largest distance from the pre-grasp pose [m]."""
    turn: float = float(np.radians(15.0))
    """Largest angle to it [rad]."""
    limit: float = RISK
    """Largest chance that the object is not held by `held`, at the edge and in each push [1]."""

    def __post_init__(self) -> None:
        for name, value, low in (("overhang", self.overhang, 1e-3), ("held", self.held, 0.0)):
            if not (np.isfinite(value) and low <= value <= 1.0):
                raise InputError(f"The {name} at the edge is {value} m, expected {low:g} to 1 m.")
        if self.yaw is not None and not np.isfinite(self.yaw):
            raise InputError(f"The heading at the edge is {self.yaw}, expected a finite number of radians, or none for the nearest.")
        Goal(np.zeros(3), self.position, self.turn)


def edges_of(table: Table) -> list[TableEdge]:
    """The edges of a table."""
    return [TableEdge.between(*pair) for pair in zip(table.corners, np.roll(table.corners, -1, axis=0), strict=True)]


def edge_target(goal: EdgeGoal, edges: Sequence[TableEdge], belief: Belief, pose: Float64Array, settings: PushSettings) -> Target:
    """The nearest pre-grasp pose at the edge of the goal, else at the nearest of the known `edges` where there is one.

    All in the table frame, the pose of the object of shape (3,).

    Raises:
        GoalRefusedError: no edge is known; else as `pregrasp` for the nearest one.
    """
    candidates = [goal.edge] if goal.edge is not None else sorted(edges, key=lambda edge: -float(edge.beyond(pose[:2])))
    if not candidates:
        pregrasp(goal, belief, pose, settings)
    refusal: GoalRefusedError | None = None
    for edge in candidates:
        try:
            nearest, hold = pregrasp(replace(goal, edge=edge), belief, pose, settings)
        except GoalRefusedError as error:
            refusal = refusal or error
        else:
            return held_target(nearest, hold, belief)
    assert refusal is not None, "there is an edge"
    raise refusal


def held_target(goal: Goal, hold: EdgeHold, belief: Belief) -> Target:
    """Target at an edge, with cells and centres of mass of the object."""
    return Target(goal, hold, belief.shape.cells.centres, _centres(belief))


def pregrasp(
    goal: EdgeGoal,
    belief: Belief,
    pose: Float64Array,
    settings: PushSettings,
    *,
    n_headings: int = 72,
    preferred_margin: float = 0.5,
    lever: float = 0.1,
) -> tuple[Goal, EdgeHold]:
    """The pre-grasp pose that is nearest to a pose, shape (3,), and what holds the object there.

    Of `n_headings` headings one with an additional margin of the centre of mass is preferred, as a share of the tolerance of position [1].
    In the distance to a pose, a turn by one radian counts as `lever` [m/rad].

    Raises:
        GoalRefusedError: the edge is not known, the workspace does not reach it, or the object would not be held there, as far as is known.
    """
    if goal.edge is None:
        raise GoalRefusedError(
            GoalCode.EDGE_UNKNOWN, "the table's edge is not known; give the edge with the goal, or the corners of the table to the node."
        )
    hold, shape = EdgeHold(goal.edge, goal.held, goal.limit), belief.shape
    turns = np.array([goal.yaw]) if goal.yaw is not None else pose[2] + 2 * np.pi * np.arange(n_headings) / n_headings
    poses = np.array([_at_edge(goal, goal.edge, shape.outline, pose, turn, settings) for turn in turns])
    inside = np.array([_is_within(goal.edge, settings, transform_points(one, shape.outline)) for one in poses])
    if not np.any(inside):
        raise GoalRefusedError(
            GoalCode.OUTSIDE_WORKSPACE,
            f"no pose that overhangs the edge by {1e3 * goal.overhang:.0f} mm keeps the object within the workspace {settings.workspace} "
            "m and between the ends of the edge; choose another edge or heading, or widen the workspace.",
        )
    poses = poses[inside]
    margins = np.array([hold.margins(shape.cells.centres, centre, poses) for centre in _centres(belief)])
    risk, mean = hold.risk(margins), margins.mean(axis=0)
    held = risk <= hold.limit
    if not np.any(held):
        best = int(np.argmax(mean))
        raise GoalRefusedError(
            GoalCode.NOT_HELD,
            f"with an overhang of {1e3 * goal.overhang:.0f} mm the centre of mass would be {1e3 * mean[best]:.0f} mm (standard deviation "
            f"{1e3 * float(margins[:, best].std()):.0f} mm) inside its support, not surely the {1e3 * goal.held:.0f} mm of the goal; "
            "allow less overhang, or push the object a few times more so that its centre of mass is known better.",
        )
    preferred = held & (mean >= goal.held + preferred_margin * goal.position)
    far = np.linalg.norm(poses[:, :2] - pose[:2], axis=1) + lever * np.abs(wrap_angle(poses[:, 2] - pose[2]))
    best = int(np.argmin(np.where(preferred if np.any(preferred) else held, far, np.inf)))
    return Goal(poses[best], goal.position, goal.turn), hold


def _centres(belief: Belief) -> Float64Array:
    """Centres of mass by models of the posterior, shape (n_models, 2), object frame."""
    return np.array([model.body.centre for model in belief.models(32, np.random.default_rng(0))])


def _at_edge(
    goal: EdgeGoal, edge: TableEdge, outline: Float64Array, pose: Float64Array, turn: float, settings: PushSettings
) -> Float64Array:
    """Pose with a heading whose outline overhangs the edge as wanted, at the nearest position along the edge: shape (3,)."""
    turned = outline @ rotation(float(turn)).T
    out = edge.offset + goal.overhang - float(np.max(turned @ edge.outward))
    x_min, x_max, y_min, y_max = settings.workspace
    corners = np.array([[x, y] for x in (x_min, x_max) for y in (y_min, y_max)]) @ edge.along
    first, last = max(float(np.min(corners)), edge.span[0]), min(float(np.max(corners)), edge.span[1])
    side = turned @ edge.along
    interval = (first - float(np.min(side)), last - float(np.max(side)))
    along = float(np.clip(pose[:2] @ edge.along, *interval)) if interval[0] <= interval[1] else float(np.mean(interval))
    return np.array([*(out * edge.outward + along * edge.along), turn])


def _is_within(edge: TableEdge, settings: PushSettings, outline: Float64Array) -> bool:
    """Whether what is on the table lies within the workspace of the tool, and all of the object between the ends of the edge."""
    on_table, side = outline[edge.beyond(outline) <= 0.0], outline @ edge.along
    rounding = 1e-9  # of coordinates [m]
    between = edge.span[0] - rounding <= float(np.min(side)) and float(np.max(side)) <= edge.span[1] + rounding
    return between and len(on_table) > 0 and settings.excess(on_table) <= rounding
