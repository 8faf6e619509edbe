"""A push improved by its exact derivative, so that the mean model ends at the goal.

The rollout gives the derivative of the end by the first pose. To move the path of the pusher by a small motion is to move the object by the
inverse one and then everything by that motion, so the same derivative tells what another contact and another direction do; the velocity at
the end tells what another length does. Three numbers of the push for three of the pose: Gauss-Newton.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.unknowns import Mechanics
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings
from push_ident.planning.goal import Goal
from push_ident.planning.library import Strokes, path_of
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, SolveStatus

__all__ = ["end_by_push", "refine"]

_STEPS: Final = 3
_DAMPING: Final = np.array([0.5, 0.5, 0.5])
"""Weight of a change of the push by its whole range, in tolerances [1]: changes that hardly move the end are not made."""
_RANGE: Final = np.array([0.01, 0.3, 0.03])
"""Largest change of contact [m], direction [rad] and length [m] in a step: the derivative holds on one side of a switch only."""
_CONE: Final = float(np.radians(45.0))
"""Largest angle between push and inward normal [rad]."""
_SHORTEST: Final = 0.003
"""Travel after contact [m]."""
_WINDOW: Final = 0.003
"""Travel over which the motion at the end is averaged [m]: an object that has been hit runs ahead of the pusher for a moment."""
_NUMERICS: Final = SimulationSettings(step=1.0 / 120.0, resolve_events=True)


def refine(
    mechanics: Mechanics, own: Strokes, number: int, length: float, wanted: Goal, settings: PushSettings
) -> tuple[Strokes, float, Float64Array] | None:
    """A stroke and a length that bring the mean model nearer to the wanted motion: (one stroke, length [m], motion, shape (3,)).

    None where the push cannot be improved.
    """
    stroke = _picked(own, number)
    best: tuple[float, Strokes, float, Float64Array] | None = None
    start = np.inf
    for _ in range(_STEPS + 1):
        end, by_push = end_by_push(mechanics, stroke, length, settings)
        if end is None or by_push is None:
            break
        residual = end - wanted.pose
        residual[2] = wrap_angle(residual[2])
        cost = float(np.sum((residual / wanted.tolerance) ** 2))
        if best is None:
            start = cost
        if best is None or cost < best[0]:
            best = (cost, stroke, length, end)
        elif cost > best[0]:
            break
        scaled = by_push / wanted.tolerance[:, None] * _RANGE
        step = -np.linalg.solve(scaled.T @ scaled + np.diag(_DAMPING**2), scaled.T @ (residual / wanted.tolerance))
        step = _RANGE * np.clip(step, -1.0, 1.0)
        stroke, length = (
            _changed(stroke, float(step[0]), float(step[1])),
            float(np.clip(length + step[2], _SHORTEST, settings.max_distance)),
        )
    if best is None or not best[0] < start:
        return None
    return best[1], best[2], best[3]


def end_by_push(
    mechanics: Mechanics, stroke: Strokes, length: float, settings: PushSettings
) -> tuple[Float64Array | None, Float64Array | None]:
    """Pose after a push of an object at (0, 0, 0), shape (3,), and its derivative by contact, direction and length, (3, 3)."""
    tool, heading = stroke.tool[0], stroke.heading()[0]
    path = path_of(tool, heading, length, settings.speed_range[0], settings)
    just_before = float(path.time[-1]) - _WINDOW / settings.speed_range[0]
    motion = mechanics.simulate(PushScenario(path, np.zeros(3), np.array([just_before, path.time[-1]])), settings=_NUMERICS, jacobian=True)
    if motion.status is not SolveStatus.CONVERGED:
        return None, None
    end, by_first = motion.pose[-1], motion.jacobian[-1, :, :3]
    tangent = stroke.tangent[0]
    moves = np.array([[tangent[0], tangent[1], 0.0], [tool[1], -tool[0], 1.0]])
    columns = [move + move[2] * np.array([-end[1], end[0], 0.0]) - by_first @ move for move in moves]
    by_length = (end - motion.pose[-2]) / _WINDOW
    return end, np.column_stack([*columns, by_length])


def _picked(own: Strokes, number: int) -> Strokes:
    one = slice(number, number + 1)
    return Strokes(own.contact[one], own.tool[one], own.tangent[one], own.direction[one], own.room[one])


def _changed(stroke: Strokes, along: float, turn: float) -> Strokes:
    """With the contact moved along its edge [m], within the edge, and the direction turned [rad], within the cone."""
    along = float(np.clip(along, -stroke.room[0], stroke.room[0]))
    shift = along * stroke.tangent
    inward = np.arctan2(stroke.tangent[0, 0], -stroke.tangent[0, 1])
    angle = float(np.clip(wrap_angle(stroke.direction[0] + turn - inward), -_CONE, _CONE))
    return replace(
        stroke,
        contact=stroke.contact + shift,
        tool=stroke.tool + shift,
        direction=np.array([wrap_angle(inward + angle)]),
        room=stroke.room - abs(along),
    )
