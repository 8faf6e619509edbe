"""Follows a path in one contact: at the rate of the camera the next motion of the tool is chosen anew.

At each frame the motion up to the next one is settled already. From there on `CurvedPushes` improves what was planned before, for
a stretch of the path ahead, under the models that explain the push so far best; what it plans is carried out until the next frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from push_ident.geometry.se2 import compose, inverse
from push_ident.planning.contact_tracking import ContactTracker
from push_ident.planning.curved import N_LIMITS, N_SEGMENTS, CurvedPushes, Horizon, PushStart, never_late
from push_ident.planning.model_weights import ModelWeights, touching
from push_ident.planning.path_goal import PathGoal
from push_ident.pushing.push import PushSettings
from push_ident.pushing.tool_path import Corridor
from push_ident.types import Float64Array

__all__ = ["LOOK_AHEAD", "Correction", "FollowStatus", "PathFollower", "guesses_around"]

LOOK_AHEAD: Final = 0.08
"""How far ahead along the path a correction looks [m]: an object that is beside the path must turn, move over, and turn back."""
_SETTLED: Final = 0.02
"""Between the points of the motion that is settled [s]: earlier corrections may have bent it."""
_ITERATIONS: Final = 1
"""Of Gauss-Newton in a correction: the next frame goes on from there."""
_OF_SWINGS: Final = 2
"""And from a motion that makes the contact slide."""
_ARRIVED: Final = 0.0015
"""From the end of the path [m]."""
_AHEAD: Final = 0.05
"""How far along the path the object may have come since the last frame [m]."""
_NOT_BETTER: Final = 0.85
"""A contact brings the object back only where the error at the end of the look ahead is below this share of the present one [1]."""
_BAD: Final = 2.0
"""Root of the mean square error over the look ahead that another contact is worth [tolerances]."""
_WORSE: Final = 1.3
"""And of that which was expected when the contact was chosen [1]."""
_IN_A_ROW: Final = 6
"""Frames after which a contact is given up: estimates of a pose come and go."""
_STAYED, _STAYS = 0.04, 0.9
"""Travel along the path [m] in which an error that is not bearable must fall to this share [1]."""
_APART: Final = 0.012
"""Gap at which the contact is lost [m]."""


_SWINGS: Final = np.array(
    [
        [[0.0, 0.4], [0.0, 0.0]],
        [[-0.5, 0.5], [0.0, 0.0]],
        [[-0.8, 0.25], [0.4, -0.1]],
        [[-0.25, 0.85], [0.2, -0.4]],
    ]
)
"""Of the velocity in the first two segments, along and across the path [1, in its speed]: changes that are tried to either side. Small
steps from a contact that sticks never find that it may slide; these make it slide, by up to some 5 mm, with and without a move back."""


class FollowStatus(Enum):
    """How it goes on."""

    GOING = "the tool goes on"
    ARRIVED = "the object is at the end of the path"
    NO_BETTER = "this contact does not keep the object on the path any more: push it elsewhere"
    LEAVES = "the tool would leave the workspace or its corridor"


@dataclass(frozen=True, slots=True)
class Correction:
    """What the tool does from now on."""

    status: FollowStatus
    time: Float64Array
    """[s], shape (n,): the first is the frame's; for the period after it nothing was changed."""
    tool: Float64Array
    """Axis of the tool then, table frame of the arm [m], shape (n, 2)."""
    done: float
    """Length of path that is behind [m]."""
    pose: Float64Array
    """Of the object as it is believed now, table frame of the arm, shape (3,)."""


def guesses_around(unknowns: Float64Array) -> Float64Array:
    """Unknowns that are worth a try beside given ones, shape (N_SEGMENTS, 2): to the left and to the right, shape (2, n, N_SEGMENTS, 2)."""
    tried = np.broadcast_to(unknowns, (2, len(_SWINGS), N_SEGMENTS, 2)).copy()
    tried[:, :, :2] += np.array([[1.0, 1.0], [1.0, -1.0]])[:, None, None] * _SWINGS
    return np.clip(tried, -1.0, 1.0)


class PathFollower:
    """Corrects the motion of a tool that pushes one object along a path.

    Args:
        settings: limits of the tool.
        weights: of the models that may be true; the push changes them while it is made.
        path: to be followed, table frame of the camera.
        corridor: that the tool must not leave, table frame of the arm.
        camera: the table frame of the arm in that of the camera, shape (3,).
        n_asked: how many models a correction is made for: those that explain the push best.
        period: from a frame to the motion that it corrects, at least that of the camera [s].
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
        self._away = inverse(np.zeros(3) if camera is None else camera)
        self._path = path.seen_from(self._away)
        self._pushes = CurvedPushes(settings, self._path, corridor)
        self._settings, self._weights, self._period, self._n_asked = settings, weights, period, n_asked
        self._unknowns, self._bad = np.zeros((N_SEGMENTS, 2)), 0
        self._errors: list[float] = []
        """In tolerances, of the latest frames."""
        self._n_errors = max(_IN_A_ROW, round(_STAYED / (path.speed * period)))
        lead = np.linspace(-period, 0.0, max(2, int(np.ceil(period / _SETTLED)) + 1))
        self._horizon = Horizon.of(path.speed, LOOK_AHEAD, lead)

    def begin(
        self, time: Float64Array, tool: Float64Array, pose: Float64Array, covariance: Float64Array, done: float, expected_error: float
    ) -> None:
        """A push begins that is corrected later.

        Args:
            time: [s], shape (n,), of the tool's motion as it is planned.
            tool: axis of the tool then [m], shape (n, 2), table frame of the arm.
            pose: of the object at rest, table frame of the camera, shape (3,).
            covariance: of it, shape (3, 3).
            done: length of path that is behind [m].
            expected_error: of the contact, so that it is not given up for another that does no better [tolerances].
        """
        self._bearable = max(_BAD, _WORSE * expected_error)
        self._time, self._tool, self._done, self._now = time, tool, done, float(time[0])
        self._weights.restart()
        self._errors = []
        model, radius = self._weights.best(1), self._settings.pusher_radius
        self._tracker = ContactTracker(model, radius, compose(self._away, pose), covariance)

    def correct(self, time: float, pose: Float64Array, covariance: Float64Array, is_late: Callable[[], bool] = never_late) -> Correction:
        """The motion from a frame on.

        Args:
            time: of the frame [s], later than the last one.
            pose: of the object, shape (3,).
            covariance: of it, shape (3, 3).
            is_late: whether an answer is due: what was planned before is then improved no further, the next frame goes on from there.
        """
        tracker = self._tracker
        lead = time + self._period + self._horizon.lead
        settled = self._where(lead)
        since = np.append(np.append(self._now, self._time[(self._time > self._now) & (self._time < time)]), time)
        tracker.advance(since, self._where(since))
        face = tracker.see(compose(self._away, pose), covariance, settled[0])
        place, error = self._path.error(tracker.pose, self._done, _AHEAD)
        self._done, elapsed, self._now = float(place), time - self._now, time
        start = PushStart(tracker.pose, tracker.velocity, self._done + self._path.speed * self._period, settled, face)
        if tracker.gap == 0.0 and not tracker.was_displaced:
            self._weights.see(since, self._where(since), tracker.pose, tracker.velocity, face)
        else:
            self._weights.restart()
        asked = self._weights.best(self._n_asked)
        tracker.model = asked.picked([0])
        models, onward = touching(asked, face), self._horizon.later(self._unknowns, elapsed)
        guesses = np.stack([onward, np.zeros((N_SEGMENTS, 2))])
        if not is_late():
            # Whether to slide is found by the most probable model alone.
            around, first = guesses_around(onward), models.picked([0])
            swung, _ = self._pushes.improve(first, self._horizon, [start, start], around, _OF_SWINGS, is_late)
            guesses = np.concatenate([guesses, swung])
        best, rolled = self._pushes.improve(models, self._horizon, [start], guesses[None], _ITERATIONS, is_late)
        self._unknowns = best[0]
        now = float(np.hypot(error[0] / self._path.position, error[1] / self._path.yaw))
        ahead = float(np.sqrt(np.mean(rolled.error[:, 0, 0] ** 2)))
        hopeless = ahead > max(self._bearable, _NOT_BETTER * now) or tracker.gap > _APART
        # Of what had no time to get better nothing is concluded.
        self._bad = (self._bad + (not is_late())) if hopeless else 0
        self._errors = [now] if tracker.was_displaced else [*self._errors, now][-self._n_errors :]
        self._time, self._tool = time + self._period + self._horizon.knots, rolled.tool[0, 0]
        return Correction(self._status(rolled.residual[0, 0, 0, -N_LIMITS:]), self._time, self._tool, self._done, tracker.pose)

    def _status(self, limits: Float64Array) -> FollowStatus:
        if self._path.length - self._done < _ARRIVED:
            return FollowStatus.ARRIVED
        if np.any(limits > 1.0):
            return FollowStatus.LEAVES
        # What is planned may be put off again and again: the error must have become less as well.
        stays = len(self._errors) == self._n_errors and self._errors[-1] > max(self._bearable, _STAYS * self._errors[0])
        return FollowStatus.NO_BETTER if stays or self._bad >= _IN_A_ROW else FollowStatus.GOING

    def _where(self, time: Float64Array) -> Float64Array:
        return np.column_stack([np.interp(time, self._time, column) for column in self._tool.T])
