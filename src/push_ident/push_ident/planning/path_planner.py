"""The next push of an object along a path, which is followed by a chain of straight pushes.

From the library of strokes, with the motion after every 4 mm, the cost of a push is

    J = c + sum over the path of e^2 + l e_end^2 - r progress        e: distance from the path, or angle to it, in tolerances

with sums and progress in metres of path. c is the cost of a contact, that of c metres at an error of one tolerance; l is the length over
which the error at the end persists in the next push. r is the cost of a metre of path where the object is within tolerance: the least
(c + sum of e^2 + l e_end^2) / progress of all pushes. There the push of the least cost per metre is optimal; an object with a larger error
is brought back first, without progress if necessary. (It is the relative cost of a step where the average cost counts:
Bertsekas, Dynamic Programming and Optimal Control II, chapter 5.) All strokes are judged by the mean model, the best by all models.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np

from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.planning.belief import Belief
from push_ident.planning.library import Library, Surroundings, is_possible, placed, strokes
from push_ident.planning.path_goal import PathGoal
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array, ObjectShape


@dataclass(frozen=True, slots=True)
class PathOptions:
    """Costs of pushes along a path, and the size of the search."""

    contact_cost: float = 0.03
    """Cost c of a contact: that of this length of path at an error of one tolerance [m]."""
    carried_length: float = 0.03
    """Length l of path over which the error at the end of a push persists in the next one [m]."""
    least_progress: float = 0.004
    """Least progress of a push along the path [m]; the path ends that far before its end."""
    look_ahead: float = 0.2
    """Largest progress of the object in one push [m]."""
    screened: int = 300
    """Pushes that are best under the mean model, and are then judged by all models."""
    n_models: int = 8
    """Models in the library beside the mean."""
    bearable_error: float = math.sqrt(2.0)
    """Largest expected root mean square error of a steered push that is preferred to a straight one [tolerances]: distance and angle both
    at their tolerance."""
    stuck_progress: float = 0.005
    """After a steered push with less progress a straight one comes first [m]."""


PATH_OPTIONS: Final = PathOptions()


class PathStatus(Enum):
    """How planning ended."""

    PUSH = "a push is proposed"
    ARRIVED = "the object is at the end of the path"
    UNREACHABLE = "no push within the workspace brings the object further along the path: move the path to the middle, or round its turns"


@dataclass(frozen=True, slots=True)
class PathPush:
    """The next push along a path, or why there is none."""

    status: PathStatus
    done: float
    """Length of path that is behind now [m]."""
    plan: PushPlan2D | None = None
    expected_done: float = np.nan
    """Length of path that is expected to be behind after the push [m]."""


class PathPlanner:
    """Plans pushes of one object along paths at one speed; what it has simulated it keeps until the belief changes.

    `settings`: limits of pushes and the pusher; `speed`: of the pushes [m/s].
    """

    def __init__(self, shape: ObjectShape, settings: PushSettings, speed: float) -> None:
        self._shape = shape
        self._settings = replace(settings, speed_range=(speed, max(speed, settings.speed_range[1])))
        self._strokes = strokes(shape, settings)
        self._belief: Belief | None = None
        self._library: Library | None = None

    def _library_of(self, belief: Belief, pose: Float64Array) -> Library:
        if self._library is None or belief is not self._belief or not self._library.holds_at(belief, pose):
            self._belief = belief
            self._library = Library.of(belief, self._strokes, self._settings, pose, PATH_OPTIONS.n_models, np.random.default_rng(0))
        return self._library

    def plan(
        self,
        belief: Belief,
        pose: Float64Array,
        path: PathGoal,
        done: float,
        obstacles: Sequence[Float64Array] = (),
        failed: Sequence[PushPlan2D] = (),
    ) -> PathPush:
        """The next push of an object at a pose in the table frame, shape (3,).

        `done`: length of path that was behind before the latest push [m], 0 at first; `obstacles`: outlines of other objects, table frame
        [m], each of shape (n_vertices, 2); `failed`: pushes from this pose that did not move the object, or could not be made.
        """
        camera_in_arm = inverse(belief.camera)
        reached, _ = path.error(pose, done, PATH_OPTIONS.look_ahead)
        now = max(done, float(reached))
        if path.length - now < PATH_OPTIONS.least_progress:
            return PathPush(PathStatus.ARRIVED, now)
        in_arm = compose(camera_in_arm, pose)
        library = self._library_of(belief, in_arm)
        around = Surroundings([transform_points(camera_in_arm, outline) for outline in obstacles], failed)
        for number, k, expected in self._ranked(library, pose, path, now):
            plan = placed(library.strokes, number, in_arm, float(library.lengths[k]), self._settings.speed_range[0])
            if is_possible(self._shape, self._settings, plan, in_arm, library.motion[0, number, k], around):
                return PathPush(PathStatus.PUSH, now, plan, expected)
        return PathPush(PathStatus.UNREACHABLE, now)

    def _rate(self, library: Library, pose: Float64Array, path: PathGoal, now: float) -> float:
        """r, by the mean model, from as near to `pose` as is within tolerance; 0 where no push brings the object further along the path."""
        wanted = path.at(now)
        error = pose - wanted
        error[2] = wrap_angle(error[2])
        near = wanted + np.clip(error, -path.tolerance, path.tolerance)
        cost, reached, _ = self._cost(library.motion[:1], near, path, now)
        progress = reached - now
        useful = progress >= min(PATH_OPTIONS.least_progress, path.length - now)
        return float(np.min(cost[useful] / progress[useful])) if useful.any() else 0.0

    def _ranked(self, library: Library, pose: Float64Array, path: PathGoal, now: float) -> list[tuple[int, int, float]]:
        """Strokes, lengths, and where on the path they are expected to end, the best first: by the mean model, then by all."""
        rate = self._rate(library, pose, path, now)
        worth, _ = self._worth(library.motion[:1], pose, path, now, rate)
        n_lengths = len(library.lengths)
        first = np.argsort(worth[0].ravel())[: PATH_OPTIONS.screened]
        first = first[np.isfinite(worth[0].ravel()[first])]
        numbers = np.unique(first // n_lengths)
        worth, reached = self._worth(library.motion[:, numbers], pose, path, now, rate)
        mean, end = worth.mean(axis=0).ravel(), reached.mean(axis=0).ravel()
        order = np.argsort(mean)
        return [(int(numbers[j // n_lengths]), int(j % n_lengths), float(end[j])) for j in order if np.isfinite(mean[j])]

    def _worth(
        self, motion: Float64Array, pose: Float64Array, path: PathGoal, now: float, rate: float
    ) -> tuple[Float64Array, Float64Array]:
        """J of each motion, infinite where it is no use, and the length of path that is behind after it [m]: each of shape (n_models,
        n_strokes, n_lengths)."""
        cost, reached, square = self._cost(motion, pose, path, now)
        here = _square(path, path.error(pose, now, PATH_OPTIONS.look_ahead)[1])
        progress = reached - now
        is_use = (progress >= min(PATH_OPTIONS.least_progress, path.length - now)) | (
            PATH_OPTIONS.contact_cost + PATH_OPTIONS.carried_length * square < PATH_OPTIONS.carried_length * here
        )
        return np.where(is_use, cost - rate * progress, np.inf), reached

    def _cost(
        self, motion: Float64Array, pose: Float64Array, path: PathGoal, now: float
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Cost of each motion [m], the length of path that is behind after it [m], and the square error then [tolerances^2]: each of shape
        (n_models, n_strokes, n_lengths)."""
        reached, error = path.error(compose(pose, motion), now, PATH_OPTIONS.look_ahead)
        square, reached = _square(path, error), np.maximum(reached, now)
        steps = np.maximum(np.diff(reached, axis=2, prepend=now), 0.0)
        # A motion whose simulation failed is infinitely far from the path, also without progress.
        integral = np.cumsum(np.multiply(steps, square, out=np.zeros_like(square), where=steps > 0.0), axis=2)
        return PATH_OPTIONS.contact_cost + integral + PATH_OPTIONS.carried_length * square, reached, square


def _square(path: PathGoal, error: Float64Array) -> Float64Array:
    """Squared errors in tolerances, from distances and angles of shape (..., 2)."""
    return np.asarray(np.sum((error / [path.position, path.yaw]) ** 2, axis=-1))
