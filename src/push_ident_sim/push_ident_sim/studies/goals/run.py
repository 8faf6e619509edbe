"""One object that is pushed to goals in Bullet, one after another and without ever being put back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.planning.goal import Goal
from push_ident.planning.planner import GoalPush, PlanStatus
from push_ident.types import Float64Array
from push_ident_sim.studies.common.pushed import PushedObject

__all__ = ["LEVELS", "GoalOutcome", "random_goal", "reach"]

LEVELS = {"20mm_0.1rad": (0.02, 0.1), "10mm_5deg": (0.01, np.radians(5.0)), "5mm_2deg": (0.005, np.radians(2.0))}
"""Tolerances of position [m] and yaw [rad], from the first to the last: every goal is reached at the first, then held to the next."""
_MAX_PUSHES = 20
"""Of one goal, all tolerances together."""
_REACH = 0.15
"""Half the side of the square that goals are drawn from [m]."""


def random_goal(rng: np.random.Generator) -> Float64Array:
    """A pose anywhere in the middle of the table, in any heading, shape (3,)."""
    return np.array([*rng.uniform(-_REACH, _REACH, 2), rng.uniform(-np.pi, np.pi)])


@dataclass(slots=True)
class GoalOutcome:
    """What became of one goal."""

    reached: dict[str, bool] = field(default_factory=dict)
    """By level: whether the object was said to be there, and was."""
    pushes: dict[str, int] = field(default_factory=dict)
    """By level: pushes until then, from the start."""
    time: dict[str, float] = field(default_factory=dict)
    """By level: time of the pushes with their rests until then [s]."""
    chances: list[tuple[float, bool]] = field(default_factory=list)
    """Of each push: the chance that was expected of it, and whether the object was at the goal then."""
    errors: list[float] = field(default_factory=list)
    """Of each push: mean distance of the cells from where they were expected after it [m]."""
    ends: list[str] = field(default_factory=list)
    """How planning ended, level by level."""
    fell: bool = False


def reach(pushed: PushedObject, pose: Float64Array, levels: Sequence[str] = tuple(LEVELS)) -> GoalOutcome:
    """Push an object to a goal, shape (3,), to one tolerance after the other."""
    outcome, pushes, time = GoalOutcome(), 0, 0.0
    for level in levels:
        goal = Goal(pose, *LEVELS[level])
        while True:
            plan: GoalPush = pushed.planner.plan(pushed.belief, *pushed.observe(), goal)
            if plan.plan is None or pushes >= _MAX_PUSHES or outcome.fell:
                break
            time += pushed.duration(pushed.push(plan.plan))
            pushes += 1
            outcome.chances.append((plan.chance, bool(goal.relative_error(pushed.pose) <= 1.0)))
            outcome.errors.append(cell_error(pushed.truth.shape.cells, plan.end, pushed.pose))
            outcome.fell |= pushed.has_fallen
        outcome.reached[level] = plan.status is PlanStatus.ARRIVED and bool(goal.relative_error(pushed.pose) <= 1.0)
        outcome.pushes[level], outcome.time[level] = pushes, time
        outcome.ends.append(plan.status.name)
    return outcome
