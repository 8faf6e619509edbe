"""Where to push an object that shall follow a path in as few contacts as possible, by pushes that curve.

At each contact of the outline the tool would move as if fixed to the object on its path; `CurvedPushes` improves that for a stretch of path
ahead. A push costs c + sum of e^2 + l e_end^2, as a straight one does (`path_planner.py`). Contacts are compared by their cost per metre,
truncated where that is least, but not before the look-ahead of the corrections, which would give such a contact up at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.physics.batch import ModelBatch
from push_ident.planning.belief import Belief
from push_ident.planning.curved import N_LIMITS, N_SEGMENTS, CurvedPushes, Horizon, PushStart, RolledPushes, face_of
from push_ident.planning.keep_out import KeepOut
from push_ident.planning.library import Strokes, Surroundings, is_possible, placed, strokes
from push_ident.planning.obstacle import RISK
from push_ident.planning.path_follower import FollowerOptions, ModelWeights, PathFollower, guesses_around
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PATH_OPTIONS, PathStatus
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.tool_path import Corridor
from push_ident.types import Float64Array, ObjectShape


@dataclass(frozen=True, slots=True)
class CurvedPlannerOptions:
    """Size of the search of `CurvedPathPlanner`."""

    travel: float = 0.2
    """Length of path that a contact is judged by [m]."""
    iterations: int = 3
    """Gauss-Newton iterations for each contact."""
    refined: int = 6
    """Best contacts around which others are tried."""
    shifts: tuple[float, ...] = (-0.003, -0.0015, 0.0, 0.0015, 0.003)
    """Their shifts along the face [m]: contacts of the library are some 8 mm apart, and one that is 4 mm beside the line of the force turns
    the object by 5 degrees."""
    judged: int = 10
    """Contacts that are best under the mean model, and are then judged by all models."""
    max_angle: float = float(np.radians(70.0))
    """Largest angle between the motion of a face along the path and its inward normal, for the face to be pushed [rad]."""
    corridor_spacing: float = 0.012
    """Distance between points of the line of a corridor [m]."""
    corridor_margin: float = 0.005
    """Margin of a corridor beyond the planned motion of the tool, where that is further aside than the half width [m]."""
    straight_length: float = 0.004
    """Length of the straight beginning that is checked as a push [m]."""


_OPTIONS: Final = CurvedPlannerOptions()


@dataclass(frozen=True, slots=True)
class CurvedPush:
    """The next push along a path, or why there is none. All in the table frame of the arm."""

    status: PathStatus
    done: float
    """Length of path that is behind now [m]."""
    contact: PushPlan2D | None = None
    """Its first contact and heading; the distance is that of its straight beginning."""
    time: Float64Array | None = None
    """[s], shape (n,), from where the tool is lowered; the object is touched at the second."""
    tool: Float64Array | None = None
    """Axis of the tool then [m], shape (n, 2)."""
    corridor: Corridor | None = None
    """Corridor of the corrections along the rest of the path."""
    expected_error: float = np.nan
    """Root mean square error until then under the mean model [tolerances]: corrections compensate for the differences of the models."""
    expected_done: float = np.nan
    """Expected length of path behind at the end of the push without corrections [m]."""


class CurvedPathPlanner:
    """Chooses contacts for pushes along paths, and makes what corrects them.

    `n_models`: of the posterior, the most probable one among them; `n_asked`: models of the largest weight that a correction is computed
    for, twice as many judge contacts; `half_width`: of the corridor along the path [m].
    """

    def __init__(
        self, shape: ObjectShape, settings: PushSettings, *, n_models: int = 32, n_asked: int = 6, half_width: float = 0.08
    ) -> None:
        self._shape, self._settings = shape, settings
        self._n_models, self._n_asked, self._n_judging, self._half_width = n_models, n_asked, 2 * n_asked, half_width
        self._strokes = strokes(shape, settings)
        self._belief: Belief | None = None
        self._weights: ModelWeights | None = None

    def _weights_of(self, belief: Belief) -> ModelWeights:
        if self._weights is None or belief is not self._belief:
            models = belief.models(self._n_models - 1, np.random.default_rng(0))
            self._belief, self._weights = belief, ModelWeights(self._shape, models, self._settings.pusher_radius)
        return self._weights

    def follower(self, belief: Belief, path: PathGoal, corridor: Corridor, period: float) -> PathFollower:
        """Corrects a push at the rate of a camera with a period [s].

        The weights of the models are kept for later pushes as long as the belief stays the same.
        """
        weights = self._weights_of(belief)
        return PathFollower(self._settings, weights, path, corridor, camera=belief.camera, n_asked=self._n_asked, period=period)

    def plan(
        self,
        belief: Belief,
        pose: Float64Array,
        path: PathGoal,
        done: float,
        obstacles: Sequence[Float64Array] = (),
        failed: Sequence[PushPlan2D] = (),
    ) -> CurvedPush:
        """The next push; arguments as those of `PathPlanner.plan`."""
        camera_in_arm = inverse(belief.camera)
        observed, path = compose(camera_in_arm, pose), path.in_frame(camera_in_arm)
        reached, _ = path.error(observed, done, PATH_OPTIONS.look_ahead)
        now = max(done, float(reached))
        if path.length - now < PATH_OPTIONS.least_progress:
            return CurvedPush(PathStatus.ARRIVED, now)
        around = Surroundings([transform_points(camera_in_arm, outline) for outline in obstacles], failed)
        keep_out = KeepOut(self._shape, around.obstacles, self._settings) if around.obstacles else None
        numbers = _along(self._strokes, observed, path, now)
        if len(numbers) == 0:
            return CurvedPush(PathStatus.UNREACHABLE, now)
        horizon = Horizon.of(path.speed, _OPTIONS.travel, np.array([-self._settings.clearance / path.speed, 0.0]))
        pushes, models = CurvedPushes(self._settings, path), self._weights_of(belief).best(self._n_judging)
        coarse = [self._strokes.picked(int(number)) for number in numbers]
        first = int(np.searchsorted(path.speed * horizon.frames, min(FollowerOptions().look_ahead, path.length - now) - 1e-9))
        order = self._ranked(pushes, models.picked([0]), horizon, coarse, observed, now, first)[0]
        fine = [coarse[k].changed(along, 0.0) for k in order[: _OPTIONS.refined] for along in _OPTIONS.shifts]
        order, best = self._ranked(pushes, models.picked([0]), horizon, fine, observed, now, first)
        order = order[: _OPTIONS.judged]
        starts = [self._start(fine[k], observed, now) for k in order]
        judged = pushes.roll(models, horizon, starts, best[order][:, None])
        rate = _rate(judged, first)
        for k in np.argsort(np.min(rate, axis=-1).mean(axis=0)):
            cut = int(np.argmin(rate[:, k].mean(axis=0)))
            if not np.isfinite(rate[:, k, cut]).all():
                break
            contact = placed(fine[order[k]], 0, observed, _OPTIONS.straight_length, path.speed)
            motion = compose(inverse(observed), judged.poses[0, k, 0, cut])
            tool = judged.tool[k, 0]
            if (
                is_possible(self._shape, self._settings, contact, observed, motion, around)
                and self._is_free(tool, around)
                and (keep_out is None or keep_out.risk(_with_start(observed, judged.poses[:, k, 0, : cut + 1])) <= RISK)
            ):
                expected = now + float(judged.progress[:, k, 0, cut].mean())
                error = float(np.sqrt(np.mean(judged.error[0, k, 0, : cut + 1] ** 2)))
                corridor = self._corridor(tool, path, now)
                return CurvedPush(PathStatus.PUSH, now, contact, horizon.knots - horizon.knots[0], tool, corridor, error, expected)
        return CurvedPush(PathStatus.UNREACHABLE, now)

    def _ranked(
        self,
        pushes: CurvedPushes,
        models: ModelBatch,
        horizon: Horizon,
        contacts: Sequence[Strokes],
        observed: Float64Array,
        now: float,
        first: int,
    ) -> tuple[np.ndarray, Float64Array]:
        """Order of contacts by their cost, and the optimised unknowns of each, shape (n, N_SEGMENTS, 2)."""
        starts, nothing = [self._start(one, observed, now) for one in contacts], np.zeros((1, N_SEGMENTS, 2))
        around = np.concatenate([nothing, *guesses_around(nothing[0])])
        guesses = np.broadcast_to(around, (len(starts), *around.shape))
        best, rolled = pushes.improve(models, horizon, starts, guesses, _OPTIONS.iterations)
        return np.argsort(np.min(_rate(rolled, first)[0], axis=-1)), best

    def _start(self, contact: Strokes, observed: Float64Array, now: float) -> PushStart:
        plan = placed(contact, 0, observed, _OPTIONS.straight_length, 1.0)
        lead = np.array([plan.tool_start(self._settings.clearance), plan.tool_at_contact])
        return PushStart(observed, np.zeros(3), now, lead, face_of(self._shape.outline, contact.tool[0])[0])

    def _is_free(self, tool: Float64Array, around: Surroundings) -> bool:
        """Whether the tool stays in the workspace and away from other objects."""
        if self._settings.excess(tool) > 0.0:
            return False
        least = self._settings.pusher_radius
        return all(float(np.min(signed_distance(tool, outline))) > least for outline in around.obstacles)

    def _corridor(self, tool: Float64Array, path: PathGoal, now: float) -> Corridor:
        """Along the motion of a tool that is fixed to the object on its path."""
        offset = transform_points(inverse(path.at(now)), tool[1:2])
        later = path.at(np.append(np.arange(now, path.length, _OPTIONS.corridor_spacing), path.length))
        corridor = Corridor(np.vstack([tool[:1], transform_points(later, offset)[:, 0]]), self._half_width)
        # An object far from its path is led back by a tool that goes further aside.
        excess = float(np.max(corridor.excess(tool)))
        return Corridor(corridor.line, self._half_width + excess + _OPTIONS.corridor_margin) if excess > 0.0 else corridor


def _with_start(start: Float64Array, poses: Float64Array) -> Float64Array:
    """Poses under models, shape (n_models, n, 3), after one that all begin with, shape (3,)."""
    return np.concatenate([np.broadcast_to(start, (len(poses), 1, 3)), poses], axis=1)


def _along(contacts: Strokes, observed: Float64Array, path: PathGoal, now: float) -> np.ndarray:
    """Of each contact the stroke whose heading is nearest to the motion of that point of the object along the path; shape (n,)."""
    tool = transform_points(observed, contacts.tool)
    step = min(PATH_OPTIONS.least_progress, path.length - now)
    here, ahead = path.at(now), path.at(now + step)
    moved = transform_points(ahead, transform_points(inverse(here), tool)) - tool
    wanted = np.arctan2(moved[:, 1], moved[:, 0])
    inward = np.arctan2(contacts.tangent[:, 0], -contacts.tangent[:, 1]) + observed[2]
    pushable = np.abs(wrap_angle(wanted - inward)) < _OPTIONS.max_angle
    deviation = np.abs(wrap_angle(wanted - contacts.direction - observed[2]))
    _, contact = np.unique(np.round(contacts.tool, 9), axis=0, return_inverse=True)
    order = np.lexsort((deviation, contact.ravel()))
    _, first = np.unique(contact.ravel()[order], return_index=True)
    chosen = order[first]
    return np.asarray(chosen[pushable[chosen]])


def _rate(rolled: RolledPushes, first: int) -> Float64Array:
    """Cost per metre of path of pushes of one variant each, truncated at each frame, shape (n_models, n_starts, n_frames); infinite
    without progress, and where they are cut off before the frame of number `first`."""
    progress, square = rolled.progress[:, :, 0], rolled.error[:, :, 0] ** 2
    steps = np.maximum(np.diff(progress, axis=-1, prepend=0.0), 0.0)
    integral = np.cumsum(steps * square, axis=-1)
    rate = (PATH_OPTIONS.contact_cost + integral + PATH_OPTIONS.carried_length * square) / np.maximum(progress, 1e-9)
    rate[..., :first] = np.inf
    penalty = np.sum(rolled.residual[:, :, 0, -N_LIMITS:] ** 2, axis=-1)
    return np.where((progress > PATH_OPTIONS.least_progress) & (penalty[..., None] < 1.0), rate, np.inf)
