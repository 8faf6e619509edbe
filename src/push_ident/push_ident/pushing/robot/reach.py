"""Reach of an arm over its workspace: whole pushes are planned there, with every check that the executor makes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.motion import MotionSettings, plan_push
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.types import Float64Array

AXES: Final = ("x", "y")
"""Headings that are tried: along each axis of `table`."""


class Outcome(IntEnum):
    """Outcome of the plan of a push."""

    POSSIBLE = 0
    """The executor would make it."""
    LIMIT = 1
    """The arm gets there, but a speed, acceleration or height is beyond its limit."""
    UNREACHABLE = 2
    """The arm has no posture for a point of the path."""


@dataclass(frozen=True, slots=True)
class Trial:
    """The push whose plan is tried at every place."""

    distance: float = 0.06
    """Travel after contact [m]; the default of `push_distance`."""
    speed: float = 0.15
    """[m/s]; the default of `push_speed`."""


@dataclass(frozen=True, slots=True)
class Reach:
    """Outcomes of pushes on a grid over the workspace."""

    x: Float64Array
    """Places [m], shape (n_x,), `table` frame."""
    y: Float64Array
    """[m], shape (n_y,)."""
    outcome: NDArray[np.int8]
    """`Outcome` of the push along each of `AXES` at each place, shape (2, n_x, n_y)."""
    reasons: tuple[tuple[Outcome, str], ...]
    """Of all that are not possible, each once, with the heading and place of its first push."""
    largest: tuple[float, float, float, float] | None
    """The largest workspace all of whose places can be pushed at along both axes, x_min, x_max, y_min, y_max [m]; None: there is none."""

    def share(self, axis: int, outcome: Outcome) -> float:
        """Fraction of the places at which a push along an axis ends so."""
        return float(np.mean(self.outcome[axis] == outcome))


def find_reach(
    kinematics: ArmKinematics,
    motion: MotionSettings,
    pushes: PushSettings,
    *,
    spacing: float,
    trial: Trial | None = None,
    on_step: Callable[[float], None] = lambda share: None,
) -> Reach:
    """Plan a push along x and one along y at every place of a grid over the workspace, from home and back.

    The travel of the tool has its middle at the place, moved where it would leave the workspace. One plan takes some 0.05 s.

    Args:
        spacing: Largest distance of neighbouring places [m].
        trial: The push; default: as the executor makes one that gives neither distance nor speed.
        on_step: Gets the fraction that is done.
    """
    tried = trial or Trial()
    x_min, x_max, y_min, y_max = pushes.workspace
    xs, ys = _places(x_min, x_max, spacing), _places(y_min, y_max, spacing)
    outcome = np.zeros((len(AXES), len(xs), len(ys)), dtype=np.int8)
    reasons: dict[str, tuple[Outcome, str]] = {}
    for count, (axis, i, j) in enumerate(np.ndindex(outcome.shape)):
        push = _push_at(np.array([xs[i], ys[j]]), axis, tried, pushes)
        try:
            plan_push(kinematics, motion.home, push, motion, pushes.span)
        except PlanningError as error:
            outcome[axis, i, j] = kind = Outcome.UNREACHABLE if error.code == PushCode.UNREACHABLE else Outcome.LIMIT
            # Faults of one kind begin with the same words: which joint, and what of it.
            begin = " ".join(str(error).split()[:4])
            reasons.setdefault(begin, (kind, f"along {AXES[axis]} at ({xs[i]:.2f}, {ys[j]:.2f}): {error}"))
        on_step((count + 1) / outcome.size)
    return Reach(xs, ys, outcome, tuple(reasons.values()), _largest(xs, ys, np.all(outcome == Outcome.POSSIBLE, axis=0)))


def _places(low: float, high: float, spacing: float) -> Float64Array:
    return np.linspace(low, high, max(int(np.ceil((high - low) / spacing - 1e-9)), 1) + 1)


def _push_at(point: Float64Array, axis: int, trial: Trial, pushes: PushSettings) -> PushPlan2D:
    """The push along an axis whose travel has its middle at a point, or as near to it as the workspace allows."""
    low, high = pushes.workspace[2 * axis : 2 * axis + 2]
    travel = min(pushes.clearance + trial.distance, high - low)
    start = point.copy()
    start[axis] = np.clip(point[axis] - 0.5 * travel, low, high - travel)
    heading = np.eye(2)[axis]
    touching = start + pushes.clearance * heading
    contact = touching + pushes.pusher_radius * heading
    return PushPlan2D(contact, touching, float(np.arctan2(heading[1], heading[0])), travel - pushes.clearance, trial.speed)


def _largest(xs: Float64Array, ys: Float64Array, free: NDArray[np.bool_]) -> tuple[float, float, float, float] | None:
    """The rectangle of places with the largest area that are all free; grids are small, so every one is tried."""
    best, largest = 0.0, None
    for i, j in np.argwhere(free):
        for k in range(i + 1, len(xs)):
            for m in range(j + 1, len(ys)):
                area = float((xs[k] - xs[i]) * (ys[m] - ys[j]))
                if area > best and free[i : k + 1, j : m + 1].all():
                    best, largest = area, (float(xs[i]), float(xs[k]), float(ys[j]), float(ys[m]))
    return largest
