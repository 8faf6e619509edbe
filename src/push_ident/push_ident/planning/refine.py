"""A push improved by its exact derivative, so that the mean model ends at the goal.

The rollout gives the derivative of the end by the first pose. To move the path of the pusher by a small motion is to move the object by the
inverse one and then everything by that motion, so the same derivative tells what another contact and another direction do; the velocity at
the end tells what another length does. Three numbers of the push for three of the pose: Gauss-Newton.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.geometry.se2 import compose, inverse, rotation, wrap_angle
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings
from push_ident.planning.belief import Belief
from push_ident.planning.goal import Goal
from push_ident.planning.library import Strokes, moved, path_of
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, SolveStatus


@dataclass(frozen=True, slots=True)
class RefineOptions:
    """Numbers of the refinement of a push."""

    evaluations: int = 5
    """Simulations of a push with their derivative."""
    damping: float = 0.5
    """Weight of a change of the push by its whole range, in tolerances [1]: changes that hardly move the end are not made."""
    least_length: float = 0.003
    """Least travel after contact [m]."""
    end_window: float = 0.003
    """Travel over which the motion at the end is averaged [m]: an object that has been hit runs ahead of the pusher for a moment."""


_OPTIONS: Final = RefineOptions()
_RANGE: Final = np.array([0.01, 0.3, 0.03])
"""Largest change of contact [m], direction [rad] and length [m] in a step: the derivative holds on one side of a switch only."""
_NUMERICS: Final = SimulationSettings(step=1.0 / 120.0, resolve_events=True)
_ORIGIN: Final = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class RefinedStroke:
    """A push that brings the mean model nearer to the goal."""

    stroke: Strokes
    """One."""
    length: float
    """Travel after contact [m]."""
    motion: Float64Array
    """Pose of the object after it in its frame before it, shape (3,)."""


def refine(
    belief: Belief, stroke: Strokes, length: float, wanted: Goal, settings: PushSettings, pose: Float64Array = _ORIGIN
) -> RefinedStroke | None:
    """A stroke and a length [m] whose motion is nearer to the wanted one; None where the push cannot be improved.

    `pose` is that of the object before it, table frame of the arm, shape (3,).
    """
    best: RefinedStroke | None = None
    first = least = np.inf
    step = np.zeros(3)
    for _ in range(_OPTIONS.evaluations):
        origin = best or RefinedStroke(stroke, length, np.zeros(3))
        tried = origin.stroke.changed(float(step[0]), float(step[1]))
        longer = float(np.clip(origin.length + step[2], _OPTIONS.least_length, settings.max_distance))
        end, by_push = end_by_push(belief, tried, longer, settings, pose)
        if end is None or by_push is None:
            break
        residual = np.append((end - wanted.pose)[:2], wrap_angle(end[2] - wanted.pose[2])) / wanted.tolerance
        cost = float(residual @ residual)
        first = min(first, cost) if best is None else first
        if cost >= least:
            step *= 0.3  # a shorter step from the best push so far
            continue
        best, least = RefinedStroke(tried, longer, end), cost
        scaled = by_push / wanted.tolerance[:, None] * _RANGE
        step = _RANGE * np.clip(-np.linalg.solve(scaled.T @ scaled + _OPTIONS.damping**2 * np.eye(3), scaled.T @ residual), -1.0, 1.0)
    return best if least < first else None


def end_by_push(
    belief: Belief, stroke: Strokes, length: float, settings: PushSettings, pose: Float64Array = _ORIGIN
) -> tuple[Float64Array | None, Float64Array | None]:
    """Pose after a push in the frame of the object before it, shape (3,), and its derivative by contact, direction and length, (3, 3).

    Where a turn of everything changes the motion, the derivative leaves that out.
    """
    tool, heading = stroke.tool[0], stroke.heading()[0]
    path = path_of(tool, heading, length, settings.speed_range[0], settings)
    just_before = float(path.time[-1]) - _OPTIONS.end_window / settings.speed_range[0]
    first = pose if belief.depends_on_pose else _ORIGIN
    scenario = PushScenario(moved(first, path), first, np.array([just_before, path.time[-1]]))
    law = belief.numerics
    numerics = replace(_NUMERICS, smoothing_speed=law.smoothing_speed, quasi_static=law.quasi_static)
    motion = belief.mean.simulate(scenario, settings=numerics, jacobian=True)
    if motion.status is not SolveStatus.CONVERGED:
        return None, None
    before, end = compose(inverse(first), motion.pose)
    axes = np.eye(3)
    axes[:2, :2] = rotation(float(first[2]))
    by_first = axes.T @ motion.jacobian[-1, :, :3] @ axes
    tangent = stroke.tangent[0]
    moves = np.array([[tangent[0], tangent[1], 0.0], [tool[1], -tool[0], 1.0]])
    columns = [move + move[2] * np.array([-end[1], end[0], 0.0]) - by_first @ move for move in moves]
    by_length = (end - before) / _OPTIONS.end_window
    return end, np.column_stack([*columns, by_length])
