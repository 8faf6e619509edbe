"""A push that nobody has made yet, predicted from a pose of the object and a path of the pusher."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.geometry.outline import outline_distance
from push_ident.geometry.shape_check import check_pusher_radius
from push_ident.identification.predicting.prediction import Outcome, Prediction, outcomes_of, predict
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.limits import LIMITS, check_coordinates
from push_ident.physics.scenario import PushScenario
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, ObjectShape, PusherPath, short_repr

PUSHER_RADIUS: Final = PushSettings().pusher_radius
"""Where none is given: that of the executor [m]."""


@dataclass(frozen=True, slots=True)
class PlannedPush:
    """Prediction of a push that was not made."""

    shape: ObjectShape
    pose: Float64Array
    """Of the object before the push, table frame [m, m, rad], shape (3,)."""
    path: PusherPath
    prediction: Prediction
    """Frames from the start of the path until half a second after its end."""
    outcomes: tuple[Outcome, ...]
    """One, or two where the drawn models disagree about what happens, the likelier first; none where the prediction failed."""

    __repr__ = short_repr


def predict_planned(
    posterior: ModelPosterior, pose: ArrayLike, path: PusherPath, *, n_frames: int = 51, n_samples: int = 128
) -> PlannedPush:
    """Predict what a path of the pusher does to an object that rests at `pose`, (x, y, yaw) [m, m, rad], table frame.

    `n_frames`: evenly spread over the path; one more is at rest. `n_samples`: models drawn from the posterior; a chance is their share.

    Raises:
        InputError: a pose of another form, or a pusher that starts inside the object.
    """
    first, shape = np.array(pose, dtype=np.float64), posterior.unknowns.shape
    if first.shape != (3,) or not np.isfinite(first).all():
        raise InputError(f"The pose of the object is {first.tolist()}, expected three finite numbers (x, y, yaw) in metres and radians.")
    check_coordinates(first[:2], "Pose of the object")
    gap = float(outline_distance(path.position[:1], first[None], shape.outline)[0]) - path.radius
    if gap < -PushSettings().contact_tolerance:
        raise InputError(
            f"The pusher starts {-1e3 * gap:.0f} mm inside the object, expected outside; "
            "give pose and path in the table frame, or begin the path further away."
        )
    rest = 0.5  # [s] in which any object comes to rest: at 1 m/s one with a friction coefficient of 0.3 does in 0.34 s
    time = np.append(np.linspace(path.time[0], path.time[-1], n_frames), path.time[-1] + rest)
    prediction = predict(posterior, PushScenario(path, first, time), n_samples=n_samples)
    return PlannedPush(shape, first, path, prediction, tuple(outcomes_of(shape.cells, prediction)))


def pusher_path(points: ArrayLike, radius: float, speed: float | None = None) -> PusherPath:
    """Path of a cylinder of this radius [m] in the table frame.

    Args:
        points: of its axis, joined by straight lines: rows time, x, y [s, m, m], or rows x, y [m] that are driven along at `speed` [m/s].

    Raises:
        InputError: another form, a speed beside times or neither, or numbers that are out of the limits of a push.
    """
    rows = np.array(points, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] not in (2, 3) or not np.isfinite(rows).all():
        raise InputError(f"The path of the pusher has the shape {rows.shape}, expected finite rows of time, x, y, or of x, y with a speed.")
    LIMITS.POINTS.check(len(rows), "Path of the pusher")
    position = rows[:, -2:]
    check_coordinates(position, "Path of the pusher")
    step = np.linalg.norm(np.diff(position, axis=0), axis=1)
    LIMITS.PUSH_TRAVEL.check(float(np.sum(step)), "Path of the pusher")
    if (rows.shape[1] == 3) != (speed is None):
        found, remedy = ("no times", "give the speed") if speed is None else ("times", "leave out the speed")
        raise InputError(f"The path of the pusher has {found}, expected either times or a speed; {remedy}.")
    if speed is None:
        time = rows[:, 0]
    else:
        if not (np.isfinite(speed) and speed > 0):
            raise InputError(f"The speed of the pusher is {speed} m/s, expected a finite number above 0.")
        moves = np.append(True, step > 0)
        position, time = position[moves], np.append(0.0, np.cumsum(step[step > 0])) / speed
    path = PusherPath(time, position, check_pusher_radius(radius))
    LIMITS.PUSH_SECONDS.check(float(time[-1] - time[0]), "Path of the pusher")
    return path
