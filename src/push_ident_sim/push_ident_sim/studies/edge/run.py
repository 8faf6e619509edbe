"""One object that is pushed out over the edge of the table, to a pose in which it can be grasped, from one start after another."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal, pregrasp
from push_ident.planning.goal import Goal
from push_ident.planning.goal_code import GoalCode, GoalRefusedError
from push_ident.planning.hold import EdgeHold
from push_ident.planning.planner import PlanStatus
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.pushed import TABLE, PushedObject

__all__ = ["EDGE", "EDGE_GOAL", "PUSHES", "EdgeOutcome", "overhang", "random_start"]

EDGE = TableEdge(np.array([1.0, 0.0]), float(TABLE[0]))
"""The table's edge in Bullet."""
EDGE_GOAL = EdgeGoal(EDGE)
"""40 mm over the edge, held by 10 mm; 20 mm and 15 degrees about the pre-grasp pose."""
PUSHES = PushSettings(workspace=(0.2, 1.0, -0.5, 0.5), pusher_radius=0.008, clearance=0.02, cone=float(np.radians(40.0)))
"""The tool reaches beyond the edge, so that it can pull as well."""
_ON_TABLE = replace(PUSHES, workspace=(0.2, 0.75, -0.5, 0.5))
"""Of random pushes beside the edge."""
_NOT_KNOWN = (f"refused: {GoalCode.NOT_HELD.name}", PlanStatus.UNHELD.name)
_DISTANCE = (0.05, 0.2)
"""Between the outline and the edge at the start [m]."""
_ASIDE = 0.2
"""Largest distance of the start from the middle, along the edge [m]."""
_MAX_PUSHES = 20


def random_start(outline: Float64Array, rng: np.random.Generator) -> Float64Array:
    """A pose on the table near its edge, in any heading, shape (3,)."""
    pose = np.array([0.0, rng.uniform(-_ASIDE, _ASIDE), rng.uniform(-np.pi, np.pi)])
    pose[0] = EDGE.offset - rng.uniform(*_DISTANCE) - np.max(transform_points(pose, outline)[:, 0])
    return pose


@dataclass(slots=True)
class EdgeOutcome:
    """What became of one start."""

    end: str
    """How it ended: the status of planning, the code of the refusal, FELL, or MISSED where the object was said to be there and was not."""
    pushes: int = 0
    time_s: float = 0.0
    """Of the pushes with their rests."""
    planning_s: float = 0.0
    """Of the processor, all plans together."""
    first_plan_s: float = 0.0
    margin_m: float = float("nan")
    """Least true distance of the centre of mass from the border of its support at the end of a push."""
    overhang_m: float = float("nan")
    """True, at the end."""
    error_m: float = float("nan")
    error_rad: float = float("nan")
    """True, from the pre-grasp pose."""
    poses: list[list[float]] = field(default_factory=list)
    """True, at the start and after each push."""

    @property
    def is_reached(self) -> bool:
        """Whether the object is where it shall be."""
        return self.end == PlanStatus.ARRIVED.name

    def values(self) -> Json:
        """For JSON; numbers that were not measured are null."""
        numbers = {key: round(value, 5) if np.isfinite(value) else None for key, value in asdict(self).items() if isinstance(value, float)}
        return asdict(self) | numbers | {"reached": self.is_reached}


def overhang(pushed: PushedObject) -> EdgeOutcome:
    """Push an object from where it is to a pre-grasp pose at the edge.

    Where it is not known well enough, it is pushed at random once more, as long as it is on the table and such pushes are left.
    """
    outcome = EdgeOutcome("", poses=[pushed.pose.round(5).tolist()])
    while True:
        goal = _try(pushed, outcome)
        on_table = bool(np.all(EDGE.beyond(transform_points(pushed.pose, pushed.truth.shape.outline)) < 0.0))
        if outcome.end not in _NOT_KNOWN or not on_table:
            break
        motion = pushed.explore(_ON_TABLE)
        if motion is None:
            break
        _note(pushed, motion, outcome)
    if goal is not None:
        outcome.error_m, outcome.error_rad = (float(value) for value in goal.error(pushed.pose))
    outcome.overhang_m = float(np.max(EDGE.beyond(transform_points(pushed.pose, pushed.truth.shape.outline))))
    return outcome


def _try(pushed: PushedObject, outcome: EdgeOutcome) -> Goal | None:
    """Choose the pre-grasp pose and push the object there: the pose, or None where it is refused."""
    begun = time.process_time()
    try:
        goal, hold = pregrasp(EDGE_GOAL, pushed.belief, pushed.observe()[0], pushed.settings)
    except GoalRefusedError as refusal:
        outcome.end = f"refused: {refusal.code.name}"
        return None
    if outcome.pushes == 0:
        outcome.first_plan_s = time.process_time() - begun
    _push_there(pushed, goal, hold, outcome)
    return goal


def _note(pushed: PushedObject, motion: TrueMotion, outcome: EdgeOutcome) -> None:
    outcome.time_s += pushed.duration(motion)
    outcome.pushes += 1
    outcome.poses.append(pushed.pose.round(5).tolist())


def _push_there(pushed: PushedObject, goal: Goal, hold: EdgeHold, outcome: EdgeOutcome) -> None:
    while True:
        begun = time.process_time()
        plan = pushed.planner.plan(pushed.belief, *pushed.observe(), goal, hold=hold)
        spent = time.process_time() - begun
        outcome.planning_s += spent
        if outcome.pushes == 0:
            outcome.first_plan_s += spent
        if plan.plan is None or outcome.pushes >= _MAX_PUSHES:
            break
        _note(pushed, pushed.push(plan.plan, EDGE), outcome)
        if pushed.has_fallen:
            outcome.end = "FELL"
            return
        margin = float(hold.margins(pushed.truth.shape.cells.centres, pushed.centre, pushed.pose))
        outcome.margin_m = margin if np.isnan(outcome.margin_m) else min(margin, outcome.margin_m)
    outcome.end = plan.status.name if plan.plan is None else "MAX_PUSHES"
    if outcome.is_reached and goal.relative_error(pushed.pose) > 1.0:
        outcome.end = "MISSED"
