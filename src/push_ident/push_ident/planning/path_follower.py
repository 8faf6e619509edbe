"""Follows a path in one contact: at the rate of the camera the motion of the tool is corrected.

At each frame the motion up to the next one can no longer change. From there on `CurvedPushes` improves the last plan for a stretch of
the path ahead, under the models of the largest weight; the result is executed until the next frame.

The pose of the object is tracked by a Kalman filter with a variance for each of (x, y, yaw): the model predicts, the camera corrects. The
position of the tool is much better known than that of the object, so a pose that would have the tool inside the object, or just in front
of it, is moved until they touch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, Final, NamedTuple

import numpy as np

from push_ident.geometry.se2 import compose, inverse, rotation, transform_points, wrap_angle
from push_ident.physics.batch import BatchClock, BatchModel, ModelBatch
from push_ident.physics.effect_values import driven_path
from push_ident.planning.curved import N_LIMITS, N_SEGMENTS, CurvedPushes, Face, Horizon, PushStart, face_of
from push_ident.planning.path_goal import PathGoal
from push_ident.pushing.push import PushSettings
from push_ident.pushing.tool_path import Corridor
from push_ident.types import Float64Array, ObjectShape

_MOTION_STD: Final = np.array([0.1, 2.0])
"""Standard deviation of the predicted motion, as a share of the motion [1], and of its turn by its length [rad/m]."""
_REST_STD: Final = np.array([1e-4, 1e-4, 2e-3])
"""Standard deviation of the motion of an object at rest between frames [m, m, rad]."""


@dataclass(frozen=True, slots=True)
class FollowerOptions:
    """Numbers of `PathFollower` and its tracker."""

    look_ahead: float = 0.08
    """Distance along the path that a correction looks ahead [m]: an object beside the path must turn, move over, and turn back."""
    lead_spacing: float = 0.02
    """Time between the points of the motion that can no longer change [s]: earlier corrections may have bent it."""
    iterations: int = 1
    """Gauss-Newton iterations of a correction: the next frame continues from there."""
    swing_iterations: int = 2
    """Gauss-Newton iterations from a motion that makes the contact slide."""
    arrival_distance: float = 0.0015
    """Distance from the end of the path at which the object has arrived [m]."""
    frame_travel: float = 0.05
    """Largest progress of the object along the path between two frames [m]."""
    improvement: float = 0.85
    """A contact corrects an error only where that at the end of the look-ahead is below this share of the present one [1]."""
    bearable_error: float = 2.0
    """Root mean square error over the look-ahead up to which a contact is kept [tolerances]."""
    bearable_ratio: float = 1.3
    """Ratio of the error to that expected when the contact was chosen, up to which it is kept [1]."""
    patience: int = 6
    """Frames in a row after which a contact is given up: pose errors fluctuate."""
    progress_length: float = 0.04
    """Travel along the path in which an error that is not bearable must fall to `progress_share` [m]."""
    progress_share: float = 0.9
    """[1]"""
    lost_gap: float = 0.012
    """Gap at which the contact is lost [m]."""
    step: float = 1.0 / 120.0
    """Time step of the tracker's simulation between frames [s]."""
    gate: float = 30.0
    """Squared Mahalanobis distance of a frame that the model does not explain [1]: one right frame in a million."""
    displaced_frames: int = 2
    """Such frames in a row that are accepted: the object was displaced."""
    contact_gap: float = 1e-3
    """A smaller gap counts as contact [m]: the error of a pose in a frame."""
    max_overlap: float = 5e-3
    """Largest overlap of tool and object that is explained by an error of the pose [m]."""


_OPTIONS: Final = FollowerOptions()


class ContactTracker:
    """Tracks the pose of an object that a tool of a radius [m] pushes, by the most probable model.

    `pose`: of the object at rest, table frame of the arm, shape (3,), with its covariance, shape (3, 3).
    """

    def __init__(self, model: ModelBatch, radius: float, pose: Float64Array, covariance: Float64Array) -> None:
        self._radius = radius
        self.model = model
        """Most probable model: predicts the motion of the object."""
        self.pose: Float64Array = np.array(pose, dtype=np.float64)
        """Shape (3,)."""
        self.velocity: Float64Array = np.zeros(3)
        """Of the object frame [m/s, m/s, rad/s], shape (3,)."""
        self._variance: Float64Array = np.diagonal(covariance).copy()
        self._unexplained = 0
        self.was_displaced = False
        """Whether the last frame was accepted against the model."""
        self.gap = np.inf
        """Between tool and object [m], after the last frame."""

    def advance(self, time: Float64Array, tool: Float64Array) -> None:
        """The tool has moved: `time` [s], shape (n,), ascending; `tool`, its axis [m], shape (n, 2)."""
        end = float(time[-1])
        ends = np.array([end - min(_OPTIONS.step, 0.5 * (end - time[0])), end])
        poses = self.model.roll(BatchClock.of(time, ends, _OPTIONS.step), tool[None], self.pose[None], self.velocity[None])[0, 0]
        if not np.all(np.isfinite(poses)):
            self.velocity = np.zeros(3)
            return
        moved = poses[1] - self.pose
        length = float(np.linalg.norm(moved[:2]))
        std = np.array([_MOTION_STD[0] * length, _MOTION_STD[0] * length, _MOTION_STD[0] * abs(moved[2]) + _MOTION_STD[1] * length])
        self._variance = self._variance + std**2 + _REST_STD**2
        self.velocity = (poses[1] - poses[0]) / (ends[1] - ends[0])
        self.pose = poses[1]

    def observe(self, pose: Float64Array, covariance: Float64Array, tool: Float64Array) -> Face:
        """A frame: pose, shape (3,), its covariance, shape (3, 3), and the axis of the tool then as the arm reports it
        [m], shape (2,).

        Returns the face that the tool is at.
        """
        noise = np.diagonal(covariance)
        difference = np.append((pose - self.pose)[:2], wrap_angle(pose[2] - self.pose[2]))
        unexplained = float(np.sum(difference**2 / (self._variance + noise))) > _OPTIONS.gate
        self._unexplained = self._unexplained + 1 if unexplained else 0
        self.was_displaced = self._unexplained >= _OPTIONS.displaced_frames
        if self.was_displaced:
            self.pose, self._variance, self.velocity, self._unexplained = self.pose + difference, noise.copy(), np.zeros(3), 0
        elif not unexplained:
            gain = self._variance / (self._variance + noise)
            self.pose = self.pose + gain * difference
            self._variance = (1.0 - gain) * self._variance
        return self._touch(tool)

    def _touch(self, tool: Float64Array) -> Face:
        model = self.model.models[0]
        # The model may include an offset of the tool from its reported position.
        at = driven_path(model.effects.of_motion, np.zeros(0), np.append(tool, 0.0)[None])[0][0, :2]
        face, distance = face_of(self.model.shape.outline, transform_points(inverse(self.pose), at[None])[0])
        self.gap = distance - self._radius - model.surface
        if -_OPTIONS.max_overlap < self.gap < _OPTIONS.contact_gap:
            self.pose = self.pose + np.append(rotation(float(self.pose[2])) @ face.normal * self.gap, 0.0)
            self.gap = 0.0
        return face


_SWINGS: Final = np.array([[[0.0, 0.4], [0.0, 0.0]], [[-0.5, 0.5], [0.0, 0.0]], [[-0.8, 0.25], [0.4, -0.1]], [[-0.25, 0.85], [0.2, -0.4]]])
"""Of the velocity in the first two segments, along and across the path [1, in its speed]: changes that are tried to either side. Small
steps from a contact that sticks never find that it may slide; these make it slide, by up to some 5 mm, with and without a move back."""


class FollowStatus(Enum):
    """State of the following."""

    GOING = "the tool goes on"
    ARRIVED = "the object is at the end of the path"
    NO_BETTER = "this contact does not keep the object on the path any more: push it elsewhere"
    LEAVES = "the tool would leave the workspace or its corridor"


@dataclass(frozen=True, slots=True)
class Correction:
    """Motion of the tool from a frame on."""

    status: FollowStatus
    time: Float64Array
    """[s], shape (n,), from that of the frame on; in the first period nothing was changed."""
    tool: Float64Array
    """Axis of the tool then, table frame of the arm [m], shape (n, 2)."""
    done: float
    """Length of path that is behind [m]."""
    pose: Float64Array
    """Estimated pose of the object, table frame of the arm, shape (3,)."""


def guesses_around(unknowns: Float64Array) -> Float64Array:
    """Alternatives to given unknowns, shape (N_SEGMENTS, 2): to the left and to the right, shape (2, n, N_SEGMENTS, 2)."""
    tried = np.broadcast_to(unknowns, (2, len(_SWINGS), N_SEGMENTS, 2)).copy()
    tried[:, :, :2] += np.array([[1.0, 1.0], [1.0, -1.0]])[:, None, None] * _SWINGS
    return np.clip(tried, -1.0, 1.0)


class PathFollower:
    """Corrects the motion of a tool that pushes one object along a path (table frame of the camera), within a corridor (that of the arm).

    The push changes the weights of the models while it is made. `camera`: the table frame of the arm in that of the camera, shape (3,);
    `n_asked`: models that a correction is made for, those that explain the push best; `period`: from a frame to the motion that it
    corrects, at least that of the camera [s].
    """

    def __init__(
        self,
        settings: PushSettings,
        weights: ModelWeights,
        path: PathGoal,
        corridor: Corridor,
        *,
        camera: Float64Array | None = None,
        n_asked: int = 8,
        period: float = 1.0 / 30.0,
    ) -> None:
        self._camera_in_arm = inverse(np.zeros(3) if camera is None else camera)
        self._path = path.in_frame(self._camera_in_arm)
        self._pushes = CurvedPushes(settings, self._path, corridor)
        self._settings, self._weights, self._period, self._n_asked = settings, weights, period, n_asked
        self._unknowns, self._bad = np.zeros((N_SEGMENTS, 2)), 0
        self._errors: list[float] = []
        """In tolerances, of the latest frames."""
        self._n_errors = max(_OPTIONS.patience, round(_OPTIONS.progress_length / (path.speed * period)))
        lead = np.linspace(-period, 0.0, max(2, int(np.ceil(period / _OPTIONS.lead_spacing)) + 1))
        self._horizon = Horizon.of(path.speed, _OPTIONS.look_ahead, lead)

    def begin(
        self, time: Float64Array, tool: Float64Array, pose: Float64Array, covariance: Float64Array, done: float, expected_error: float
    ) -> None:
        """A push begins that is corrected later.

        `time` [s], shape (n,), and `tool`: axis of the tool then, as planned [m], shape (n, 2), table frame of the arm; `pose`: of the
        object at rest, that of the camera, shape (3,), with its covariance, shape (3, 3); `done`: length of path that is behind [m];
        `expected_error`: of the contact [tolerances], it is not given up for another of no less error.
        """
        self._bearable = max(_OPTIONS.bearable_error, _OPTIONS.bearable_ratio * expected_error)
        self._time, self._tool, self._done, self._now = time, tool, done, float(time[0])
        self._weights.restart()
        self._errors = []
        model, radius = self._weights.best(1), self._settings.pusher_radius
        self._tracker = ContactTracker(model, radius, compose(self._camera_in_arm, pose), covariance)

    def correct(self, time: float, pose: Float64Array, covariance: Float64Array, is_late: Callable[[], bool] = lambda: False) -> Correction:
        """The motion from a frame on, later than the last one [s], by the pose of the object, shape (3,), and its covariance, shape (3, 3).

        `is_late`: whether an answer is due: the last plan is then not improved further.
        """
        tracker = self._tracker
        lead = time + self._period + self._horizon.lead
        settled = self._tool_at(lead)
        since = np.append(np.append(self._now, self._time[(self._time > self._now) & (self._time < time)]), time)
        tracker.advance(since, self._tool_at(since))
        face = tracker.observe(compose(self._camera_in_arm, pose), covariance, settled[0])
        reached, error = self._path.error(tracker.pose, self._done, _OPTIONS.frame_travel)
        self._done, elapsed, self._now = float(reached), time - self._now, time
        start = PushStart(tracker.pose, tracker.velocity, self._done + self._path.speed * self._period, settled, face)
        if tracker.gap == 0.0 and not tracker.was_displaced:
            self._weights.observe(since, self._tool_at(since), tracker.pose, tracker.velocity, face)
        else:
            self._weights.restart()
        asked = self._weights.best(self._n_asked)
        tracker.model = asked.picked([0])
        models, onward = touching(asked, face), self._horizon.later(self._unknowns, elapsed)
        guesses = np.stack([onward, np.zeros((N_SEGMENTS, 2))])
        if not is_late():
            # The most probable model alone decides whether the contact should slide.
            around, first = guesses_around(onward), models.picked([0])
            swung, _ = self._pushes.improve(first, self._horizon, [start, start], around, _OPTIONS.swing_iterations, is_late)
            guesses = np.concatenate([guesses, swung])
        best, rolled = self._pushes.improve(models, self._horizon, [start], guesses[None], _OPTIONS.iterations, is_late)
        self._unknowns = best[0]
        now = float(np.hypot(error[0] / self._path.position, error[1] / self._path.yaw))
        ahead = float(np.sqrt(np.mean(rolled.error[:, 0, 0] ** 2)))
        hopeless = ahead > max(self._bearable, _OPTIONS.improvement * now) or tracker.gap > _OPTIONS.lost_gap
        # A correction without time for improvement is no evidence.
        self._bad = (self._bad + (not is_late())) if hopeless else 0
        self._errors = [now] if tracker.was_displaced else [*self._errors, now][-self._n_errors :]
        self._time, self._tool = time + self._period + self._horizon.knots, rolled.tool[0, 0]
        return Correction(self._status(rolled.residual[0, 0, 0, -N_LIMITS:]), self._time, self._tool, self._done, tracker.pose)

    def _status(self, limits: Float64Array) -> FollowStatus:
        if self._path.length - self._done < _OPTIONS.arrival_distance:
            return FollowStatus.ARRIVED
        if np.any(limits > 1.0):
            return FollowStatus.LEAVES
        # A planned improvement may be postponed again and again: the error must have decreased as well.
        stays = len(self._errors) == self._n_errors and self._errors[-1] > max(self._bearable, _OPTIONS.progress_share * self._errors[0])
        return FollowStatus.NO_BETTER if stays or self._bad >= _OPTIONS.patience else FollowStatus.GOING

    def _tool_at(self, time: Float64Array) -> Float64Array:
        return np.column_stack([np.interp(time, self._time, column) for column in self._tool.T])


_STD: Final = np.array([1e-3, 1e-3, 8e-3])
"""Of the difference of two filtered poses from that of the right model [m, m, rad]."""


def touching(models: ModelBatch, face: Face) -> ModelBatch:
    """Models with different surfaces, each displaced so that the tool touches it as it touches the first one."""
    surface = np.array([model.surface for model in models.models])
    return models.displaced(np.column_stack([-(surface - surface[0])[:, None] * face.normal, np.zeros(len(models))]))


class _Stretch(NamedTuple):
    """A completed stretch that is being simulated."""

    models: ModelBatch
    """As they touch its face."""
    clock: BatchClock
    tool: Float64Array
    """Shape (1, n, 2)."""
    first: Float64Array
    """Pose at its beginning, shape (1, 3), and velocity."""
    velocity: Float64Array
    end: Float64Array
    """Pose at its end, shape (3,)."""
    n_frames: int
    """That it lasted."""


class ModelWeights:
    """Weighs the models of a posterior by one push.

    A push of a few centimetres determines little of the maps, but the turn of the object. Each stretch of it is simulated with every model
    from the pose at its beginning; the distance of its end from the observed pose lowers the weight of a model:

        log w_m <- log w_m - 1/2 min(sum ((x_m - x) / sigma)^2, c)

    A stretch is simulated model by model during the frames of the next one: a frame has no time for all models. Of the models the most
    probable one comes first; all are equally likely at first. `radius`: of the tool [m].
    """

    stretch: ClassVar[float] = 0.025
    """Travel of the tool in a stretch [m]: long enough that models differ by more than the errors of the poses."""
    step: ClassVar[float] = 1.0 / 80.0
    """Time step of the simulation [s]."""
    max_distance2: ClassVar[float] = 12.0
    """Largest squared distance of a model in one stretch [1]: a wrong pose must not decide for good."""

    def __init__(self, shape: ObjectShape, models: Sequence[BatchModel], radius: float) -> None:
        self._models = ModelBatch(shape, models, radius)
        self.log_weight: Float64Array = np.zeros(len(models))
        """Up to a constant, shape (n_models,)."""
        self._time: list[float] = []
        self._tool: list[Float64Array] = []
        self._n_frames = 0
        self._begun: tuple[Float64Array, Float64Array, Face] | None = None
        """Pose, velocity and face at the beginning of the stretch."""
        self._waiting: _Stretch | None = None
        self._squares: list[Float64Array] = []
        """Of the models of the stretch that waits, as far as they were simulated."""

    def restart(self) -> None:
        """A stretch ended for another reason: the contact was lost, or the object displaced."""
        self._begun = None

    def best(self, n: int) -> ModelBatch:
        """The `n` that explain the push best, in that order."""
        return self._models.picked([int(k) for k in np.argsort(-self.log_weight, kind="stable")[:n]])

    def observe(self, time: Float64Array, tool: Float64Array, pose: Float64Array, velocity: Float64Array, face: Face) -> None:
        """A frame of an object in contact, with its pose, shape (3,), its velocity [m/s, m/s, rad/s], shape (3,), and the face touched.

        `time`: since the frame before [s], shape (n,), ascending, the frame's last; `tool`: axis of the tool then [m], shape (n, 2).
        """
        self.work()
        if self._begun is not None:
            self._time.extend(time[1:].tolist())
            self._tool.extend(tool[1:])
            self._n_frames += 1
            travel = float(np.sum(np.linalg.norm(np.diff(self._tool, axis=0), axis=1)))
            if travel < self.stretch:
                return
            self.work(all_of_it=True)
            first, first_velocity, first_face = self._begun
            knots, models = np.array(self._time), touching(self._models, first_face)
            clock = BatchClock.of(knots, knots[-1:], self.step)
            self._waiting = _Stretch(models, clock, np.array(self._tool)[None], first[None], first_velocity[None], pose, self._n_frames)
        self._time, self._tool, self._n_frames = [float(time[-1])], [np.array(tool[-1])], 0
        self._begun = pose, velocity, face

    def work(self, *, all_of_it: bool = False) -> None:
        """Simulate some models in the stretch that is over, or all that are left; with the last one, all are weighed."""
        stretch = self._waiting
        if stretch is None:
            return
        done, n = sum(len(part) for part in self._squares), len(self._models)
        # Models per frame: all are done before the next stretch ends, if that lasts as long.
        last = n if all_of_it else min(n, done + -(-n // max(stretch.n_frames - 1, 1)))
        ends = stretch.models.picked(range(done, last)).roll(stretch.clock, stretch.tool, stretch.first, stretch.velocity)[:, 0, 0]
        errors = np.column_stack([ends[:, :2] - stretch.end[:2], wrap_angle(ends[:, 2] - stretch.end[2])]) / _STD
        self._squares.append(np.where(np.isfinite(errors).all(axis=1), np.sum(np.nan_to_num(errors) ** 2, axis=1), self.max_distance2))
        if last == n:
            self.log_weight = self.log_weight - 0.5 * np.minimum(np.concatenate(self._squares), self.max_distance2)
            self._waiting, self._squares = None, []
