"""Which motions of an object a push can have caused, for any masses and frictions.

While an object is pushed quasi-statically, the force of the pusher is at most the sum of the support frictions, and its power is what they
dissipate: the mean speed of the support, weighted with friction, is at most that of the pusher. So a pose is impossible where

- the object moved although the pusher never came near it,
- it rests away from every point where the pusher can have left it, apart from coasting by v^2 / (2 mu g),
- the pusher rests inside of it, or
- it moved further than the pusher, times a factor for the cells that turn about a point of high friction.

Distances between two poses are root mean squares over the cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, transform_points, wrap_angle
from push_ident.types import CameraAccuracy, Float64Array, ObjectShape, PusherPath

UNDERSTATED: Final = 2.0
"""True standard deviation of a pose over the stated one, at most [1]: what recordings show where nothing checks a pose."""


@dataclass(frozen=True, slots=True)
class MotionBounds:
    """Bounds on what any push can do to any object, and on the errors of its observation."""

    motion_ratio: float = 2.0
    """Motion of an object over that of its pusher, at most [1]: 1 for the mean over the cells weighted with friction. Over all cells alike
    it was 1.1 at most in 450 simulated pushes of five uneven objects and in 640 recorded ones, and 1.3 with any effect of the catalogue at
    three times its usual size."""
    deviations: float = 6.7
    """Standard deviations of normal noise in three directions that are exceeded with odds of one to 10^9 [1]."""
    least_std: float = 1e-4
    """Least standard deviation of a pose [m]: rounding, and stamps that are rounded."""
    gap_std: float = math.hypot(2e-3, 2e-3)
    """Standard deviation of the gap between tool and outline in a calibrated cell [m]: 2 mm each, as in the priors of their effects."""
    least_friction: float = 0.05
    """Least friction coefficient on which an object coasts [1]: PTFE on polished steel."""
    clock_error: float = 0.5
    """Largest time between poses and pusher [s]: age of poses, lag of the tool, and coasting."""
    speed_window: float = 0.1
    """Time over which the speed of the pusher is averaged [s]: single samples are jittered."""
    spacing: float = 2e-3
    """Distance between the points of a path at which gaps are computed [m]."""
    standstill: float = 1e-3
    """Distance from the end of its path within which the pusher counts as at rest [m]."""


_BOUNDS: Final = MotionBounds()
_SHIFTS: Final = np.linspace(-_BOUNDS.clock_error, _BOUNDS.clock_error, 21)
"""Times by which poses and pusher are compared [s]."""
Frames = int | np.intp | NDArray[np.intp]
"""Index of one pose, or of several."""


def displacement(shape: ObjectShape, one: Float64Array, other: Float64Array) -> Float64Array:
    """Distance between poses [m], root mean square over the cells: shapes (..., 3) to (...). Whole turns count as none."""
    centre = shape.cells.centres.mean(axis=0)
    shift = (transform_points(one, centre[None]) - transform_points(other, centre[None]))[..., 0, :]
    spread2 = float(np.mean(np.sum((shape.cells.centres - centre) ** 2, axis=1)))
    return np.sqrt(np.sum(shift**2, axis=-1) + 2.0 * (1.0 - np.cos(one[..., 2] - other[..., 2])) * spread2)


def pose_std(shape: ObjectShape, covariance: Float64Array) -> Float64Array:
    """Standard deviation of such a distance by the noise of one pose [m]: shapes (..., 3, 3) to (...)."""
    arm2 = float(np.mean(np.sum(shape.cells.centres**2, axis=1)))
    return np.sqrt(_BOUNDS.least_std**2 + covariance[..., 0, 0] + covariance[..., 1, 1] + arm2 * covariance[..., 2, 2])


def noise_allowance(shape: ObjectShape, covariance: Float64Array) -> Float64Array:
    """How far noise can displace poses of these covariances [m]: shapes (..., 3, 3) to (...). Two of them add as squares."""
    return np.asarray(_BOUNDS.deviations * UNDERSTATED * pose_std(shape, covariance))


def moved_text(shape: ObjectShape, one: Float64Array, other: Float64Array) -> str:
    """Text: distance between two poses."""
    turn = math.degrees(abs(float(wrap_angle(other[2] - one[2]))))
    return f"{_mm(float(displacement(shape, one, other)))} (turned by {turn:.0f}°)"


class PusherTravel:
    """How far a pusher can have moved an object between any two times.

    Args:
        time: of the poses [s], shape (n,).
    """

    def __init__(self, pusher: PusherPath, time: Float64Array) -> None:
        # Stamps of arrival may lie closer together than the images: each step takes a median interval at least.
        late = np.maximum(time, np.append(time[0], time[:-1] + np.median(np.diff(time))))
        self._from, self._to = (np.interp(t[:, None] + _SHIFTS, pusher.time, _lengths(pusher)) for t in (time, late))

    def reach(self, one: Frames, other: Frames) -> Float64Array:
        """Distance that is possible from time `one` to the later `other` [m], shape of the broadcast indices."""
        return np.asarray(_BOUNDS.motion_ratio * np.max(self._to[other] - self._from[one], axis=-1))


def why_impossible(
    shape: ObjectShape,
    pusher: PusherPath,
    before: Float64Array,
    after: Float64Array,
    *,
    covariance_before: Float64Array,
    covariance_after: Float64Array,
    camera: CameraAccuracy | None = None,
    observed_at: float = math.inf,
) -> str:
    """Why no push along this path can have moved an object from one rest to the other; empty where one can.

    Args:
        pusher: path of the lowered tool, as it was measured or planned, from before the contact to where it stops or is lifted.
        before: pose of the object at rest before the push, table frame, shape (3,).
        after: the same after the push.
        covariance_before: of a single pose there, shape (3, 3).
        covariance_after: the same after the push.
        camera: how well it is known where the camera stands that measured them; None: exactly.
        observed_at: when the pose after the push was measured, on the clock of `pusher` [s]; soon after the stop it may be older.
    """
    camera = camera or CameraAccuracy()
    moved = float(displacement(shape, before, after))
    noise = float(np.linalg.norm(noise_allowance(shape, np.array([covariance_before, covariance_after]))))
    (_, first), (length, last) = (_gaps(shape, pusher, pose) for pose in (before, after))
    at_rest = last[length >= np.interp(observed_at - _BOUNDS.clock_error, pusher.time, _lengths(pusher))]
    near, coasting = _near(shape, after, covariance_after, camera), _coasting(pusher)
    if moved > noise and (least := float(np.min(first))) > _near(shape, before, covariance_before, camera):
        return f"it moved by {moved_text(shape, before, after)}, but the tool came no nearer to it than {_mm(least)}."
    if moved > noise and (distance := float(np.min(last))) > near + coasting:
        return f"it rests {_mm(distance)} from everything that the tool passed; {_mm(near + coasting)} are possible."
    if (depth := -float(np.max(at_rest)) - (pusher.shape.reach - pusher.radius)) > near:
        return f"the tool rests {_mm(depth)} inside of it; {_mm(near)} are possible."
    if moved > (possible := _BOUNDS.motion_ratio * travel_in_contact(shape, pusher, before, covariance_before, camera) + coasting + noise):
        return f"it moved by {moved_text(shape, before, after)}; with this tool {_mm(possible)} are possible."
    return ""


def travel_in_contact(
    shape: ObjectShape, pusher: PusherPath, before: Float64Array, covariance: Float64Array, camera: CameraAccuracy
) -> float:
    """Length of the path [m] from where the pusher may first touch the object at its first pose; 0 where it never may."""
    length, gap = _gaps(shape, pusher, before)
    touches = np.flatnonzero(gap <= _near(shape, before, covariance, camera))
    return float(length[-1] - length[touches[0]]) if len(touches) else 0.0


def stop_time(pusher: PusherPath) -> float:
    """When the pusher comes to rest [s]."""
    length = _lengths(pusher)
    return float(pusher.time[np.searchsorted(length, length[-1] - _BOUNDS.standstill)])


def _lengths(pusher: PusherPath) -> Float64Array:
    """Length of the path up to each sample [m], shape (n_samples,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pusher.position, axis=0), axis=1))])


def _gaps(shape: ObjectShape, pusher: PusherPath, pose: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Lengths of a path [m], shape (n,), and the least gap there between pusher and object at a pose (of no cylinder: of its circle)."""
    length = _lengths(pusher)
    lengths = np.linspace(0.0, length[-1], 1 + math.ceil(length[-1] / _BOUNDS.spacing))
    position = np.column_stack([np.interp(lengths, length, pusher.position[:, axis]) for axis in (0, 1)])
    position[-1] = pusher.position[-1]
    distance = signed_distance(transform_points(inverse(pose), position), shape.outline)
    return lengths, distance - pusher.shape.reach


def _near(shape: ObjectShape, pose: Float64Array, covariance: Float64Array, camera: CameraAccuracy) -> float:
    """Gap at which the pusher may touch an object that is observed at this pose, or overlap at which it may just touch [m]."""
    camera_std = math.hypot(camera.position, camera.heading * float(np.hypot(*pose[:2])))
    geometry = _BOUNDS.deviations * math.hypot(_BOUNDS.gap_std, shape.outline_error or 0.0, camera_std)
    return math.hypot(geometry, float(noise_allowance(shape, covariance)))


def _coasting(pusher: PusherPath) -> float:
    """Distance over which an object comes to rest from the highest speed of its pusher [m]."""
    length, end = _lengths(pusher), float(pusher.time[-1])
    window = min(_BOUNDS.speed_window, end - float(pusher.time[0]))
    speed = float(np.max(length - np.interp(pusher.time - window, pusher.time, length))) / window
    return speed**2 / (2.0 * _BOUNDS.least_friction * 9.81)


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.0f} mm"
