"""The next push of an object along a path: a path is followed by a chain of straight pushes, each along the path as far as it pays.

From the library of strokes, with the motion after every 4 mm, a push costs

    J = c + sum over the way of e^2 + l e_end^2 - r progress        e: distance from the path, or angle to it, in tolerances

with sums and progress in metres of path. c is what a contact costs: as much as c metres one tolerance beside the path; l is the length on
which the next push finds the object as far off as this one leaves it. r is what a metre of path costs where the object is within tolerance:
the least (c + sum of e^2 + l e_end^2) / progress of all pushes. There the push that costs least for each metre is the best one; an object
that is further off is brought back first, without progress if need be. (It is the relative cost of a step where the average cost counts:
Bertsekas, Dynamic Programming and Optimal Control II, chapter 5.) All strokes are judged by the mean model, the best by all models.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np

from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.planning.belief import Belief
from push_ident.planning.feasible import Surroundings, is_possible
from push_ident.planning.library import Library, placed, strokes
from push_ident.planning.path_goal import PathGoal
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array, ObjectShape

__all__ = ["PathPlanner", "PathPush", "PathStatus"]

_CONTACT: Final = 0.03
"""What a contact costs: as much as this length of path at one tolerance beside it [m]."""
_CARRIED: Final = 0.03
"""Length of path on which the next push finds the object as far off as this one leaves it [m]."""
_LEAST: Final = 0.004
"""Progress of a push along the path [m]: less is none."""
_SCREENED: Final = 300
"""Pushes that the mean model likes best, judged by all models then."""
_DRAWS: Final = 8
"""Models in the library beside the mean."""
_AHEAD: Final = 0.2
"""How far along the path one push may come [m]."""
_WAYPOINT: Final = 0.03
"""How far ahead of the object who looks one push ahead aims [m]."""


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

    Args:
        shape: of the object.
        settings: limits of pushes and the pusher.
        speed: of the pushes [m/s].
        seed: of the models that are drawn.
        greedy: chase a point 30 mm ahead with the push that ends nearest to it. What other planners are compared with.
    """

    def __init__(self, shape: ObjectShape, settings: PushSettings, speed: float, seed: int = 0, *, greedy: bool = False) -> None:
        self._shape, self._seed, self._greedy = shape, seed, greedy
        self._settings = replace(settings, speed_range=(speed, max(speed, settings.speed_range[1])))
        self._strokes = strokes(shape, settings)
        self._belief: Belief | None = None
        self._library: Library | None = None

    def _library_of(self, belief: Belief, pose: Float64Array) -> Library:
        if self._library is None or belief is not self._belief or not self._library.holds_at(belief, pose):
            self._belief = belief
            self._library = Library.of(belief, self._strokes, self._settings, pose, _DRAWS, np.random.default_rng(self._seed))
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
        """The next push.

        Args:
            belief: what is known of the object.
            pose: of the object in the table frame, shape (3,).
            path: to be followed.
            done: length of path that was behind before the latest push [m]; 0 at first.
            obstacles: outlines of other objects, table frame [m], each of shape (n_vertices, 2).
            failed: pushes from this pose that did not move the object, or could not be made.
        """
        away = inverse(belief.camera)
        place, _ = path.error(pose, done, _AHEAD)
        now = max(done, float(place))
        if path.length - now < _LEAST:
            return PathPush(PathStatus.ARRIVED, now)
        seen = compose(away, pose)
        library = self._library_of(belief, seen)
        around = Surroundings([transform_points(away, outline) for outline in obstacles], failed)
        for number, k, reached in self._ranked(library, pose, path, now):
            plan = placed(library.strokes, number, seen, float(library.lengths[k]), self._settings.speed_range[0])
            if is_possible(self._shape, self._settings, plan, seen, library.motion[0, number, k], around):
                return PathPush(PathStatus.PUSH, now, plan, reached)
        return PathPush(PathStatus.UNREACHABLE, now)

    def _rate(self, library: Library, pose: Float64Array, path: PathGoal, now: float) -> float:
        """r, by the mean model, from as near to `pose` as is within tolerance; 0 where no push brings the object further along the path."""
        wanted = path.at(now)
        beside = pose - wanted
        beside[2] = wrap_angle(beside[2])
        near = wanted + np.clip(beside, -path.tolerance, path.tolerance)
        cost, place, _ = self._cost(library.motion[:1], near, path, now)
        progress = place - now
        brings = progress >= min(_LEAST, path.length - now)
        return float(np.min(cost[brings] / progress[brings])) if brings.any() else 0.0

    def _ranked(self, library: Library, pose: Float64Array, path: PathGoal, now: float) -> list[tuple[int, int, float]]:
        """Strokes, lengths, and where on the path they are expected to end, the best first: by the mean model, then by all."""
        rate = self._rate(library, pose, path, now)
        worth, _ = self._worth(library.motion[:1], pose, path, now, rate)
        n_lengths = len(library.lengths)
        first = np.argsort(worth[0].ravel())[:_SCREENED]
        first = first[np.isfinite(worth[0].ravel()[first])]
        own = np.unique(first // n_lengths)
        worth, place = self._worth(library.motion[:, own], pose, path, now, rate)
        mean, where = worth.mean(axis=0).ravel(), place.mean(axis=0).ravel()
        order = np.argsort(mean)
        return [(int(own[j // n_lengths]), int(j % n_lengths), float(where[j])) for j in order if np.isfinite(mean[j])]

    def _worth(
        self, motion: Float64Array, pose: Float64Array, path: PathGoal, now: float, rate: float
    ) -> tuple[Float64Array, Float64Array]:
        """J of each motion, infinite where it is no use, and the length of path that is behind after it [m]: each of shape (n_models,
        n_strokes, n_lengths)."""
        cost, place, square = self._cost(motion, pose, path, now)
        if self._greedy:
            aim = path.poses[int(np.searchsorted(path.along, min(now + _WAYPOINT, path.length)))]
            poses = compose(pose, motion)
            off = np.concatenate([poses[..., :2] - aim[:2], wrap_angle(poses[..., 2:] - aim[2])], axis=-1) / path.tolerance
            return np.where(np.isfinite(off[..., 0]), np.sum(off**2, axis=-1), np.inf), place
        here = _square(path, path.error(pose, now, _AHEAD)[1])
        progress = place - now
        is_use = (progress >= min(_LEAST, path.length - now)) | (_CONTACT + _CARRIED * square < _CARRIED * here)
        return np.where(is_use, cost - rate * progress, np.inf), place

    def _cost(
        self, motion: Float64Array, pose: Float64Array, path: PathGoal, now: float
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Cost of each motion [m], the length of path that is behind after it [m], and the square error then [tolerances^2]: each of shape
        (n_models, n_strokes, n_lengths)."""
        place, error = path.error(compose(pose, motion), now, _AHEAD)
        square, place = _square(path, error), np.maximum(place, now)
        steps = np.maximum(np.diff(place, axis=2, prepend=now), 0.0)
        # A motion that nobody knows is infinitely far from the path, also where it brings nothing.
        way = np.cumsum(np.multiply(steps, square, out=np.zeros_like(square), where=steps > 0.0), axis=2)
        return _CONTACT + way + _CARRIED * square, place, square


def _square(path: PathGoal, error: Float64Array) -> Float64Array:
    """Squared errors in tolerances, from distances and angles of shape (..., 2)."""
    return np.asarray(np.sum((error / [path.position, path.yaw]) ** 2, axis=-1))
