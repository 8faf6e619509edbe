"""What a push can have made of an object, whatever its masses and frictions are.

While an object is pushed quasi-statically, the force of the pusher is at most the sum of the support frictions, and its power is what they
dissipate: the mean speed of the support, weighted with friction, is at most that of the pusher. So a pose is impossible where

- the object moved although the pusher never came near it,
- it rests away from every place where the pusher can have left it, apart from coasting by v^2 / (2 mu g),
- the pusher rests inside of it, or
- it moved further than the pusher, times a factor for the cells that turn about a place of high friction.

Distances between two poses are root mean squares over the cells.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, transform_points, wrap_angle
from push_ident.types import CameraAccuracy, Float64Array, ObjectShape, PusherPath

__all__ = [
    "UNDERSTATED",
    "Frames",
    "PusherTravel",
    "displacement",
    "moved_text",
    "noise_allowance",
    "pose_std",
    "stop_time",
    "travel_in_contact",
    "why_impossible",
]

_LEVER: Final = 2.0
"""Motion of an object over that of its pusher, at most [-]: 1 for the mean over the cells that is weighted with friction. Over all cells
alike it was 1.1 at most in 450 simulated pushes of five uneven objects and in 640 recorded ones, and 1.3 with any effect of the catalogue
at three times its usual size."""
_DEVIATIONS: Final = 6.7
"""Standard deviations of normal noise in three directions that are exceeded with odds of one to 10^9 [-]."""
UNDERSTATED: Final = 2.0
"""True standard deviation of a pose over the stated one, at most [-]: what recordings show where nothing checks a pose."""
_FLOOR_STD: Final = 1e-4
"""Least standard deviation of a pose [m]: rounding, and stamps that are rounded."""
_GEOMETRY_STD: Final = math.hypot(2e-3, 2e-3)
"""Standard deviation of the gap between tool and outline in a calibrated cell [m]: 2 mm each, as the priors of the effects that displace
them."""
_SLIPPERIEST: Final = 0.05
"""Least friction coefficient on which an object coasts [-]: PTFE on polished steel."""
_GRAVITY: Final = 9.81
"""[m/s^2]"""
_CLOCKS: Final = 0.5
"""Time by which poses and pusher are apart, at most [s]: age of poses, lag of the tool, and coasting."""
_SHIFTS: Final = np.linspace(-_CLOCKS, _CLOCKS, 21)
"""Times by which they are compared [s]."""
_SPEED_OVER: Final = 0.1
"""Time over which the speed of the pusher is a mean [s]: single samples are jittered."""
_SPACING: Final = 2e-3
"""Of the places along a path at which gaps are looked at [m]."""
_STANDS: Final = 1e-3
"""Way from its end within which the pusher counts as standing [m]."""

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
    return np.sqrt(_FLOOR_STD**2 + covariance[..., 0, 0] + covariance[..., 1, 1] + arm2 * covariance[..., 2, 2])


def noise_allowance(shape: ObjectShape, covariance: Float64Array) -> Float64Array:
    """How far noise can displace poses of these covariances [m]: shapes (..., 3, 3) to (...). Two of them add as squares."""
    return np.asarray(_DEVIATIONS * UNDERSTATED * pose_std(shape, covariance))


def moved_text(shape: ObjectShape, one: Float64Array, other: Float64Array) -> str:
    """Distance between two poses for people."""
    turn = math.degrees(abs(float(wrap_angle(other[2] - one[2]))))
    return f"{_mm(float(displacement(shape, one, other)))} (turned by {turn:.0f}°)"


class PusherTravel:
    """How far a pusher can have moved an object between any two times.

    Args:
        pusher: its path.
        time: of the poses [s], shape (n,).
    """

    def __init__(self, pusher: PusherPath, time: Float64Array) -> None:
        # Stamps of arrival may lie closer together than the images: each step takes a median interval at least.
        late = np.maximum(time, np.append(time[0], time[:-1] + np.median(np.diff(time))))
        self._from, self._to = (np.interp(t[:, None] + _SHIFTS, pusher.time, _lengths(pusher)) for t in (time, late))

    def reach(self, one: Frames, other: Frames) -> Float64Array:
        """Distance that is possible from time `one` to the later `other` [m], shape of the broadcast indices."""
        return np.asarray(_LEVER * np.max(self._to[other] - self._from[one], axis=-1))


def why_impossible(
    shape: ObjectShape,
    pusher: PusherPath,
    before: Float64Array,
    after: Float64Array,
    *,
    covariance_before: Float64Array,
    covariance_after: Float64Array,
    camera: CameraAccuracy | None = None,
    seen: float = math.inf,
) -> str:
    """Why no push along this path can have moved an object from one rest to the other; empty where one can.

    Args:
        shape: of the object.
        pusher: path of the lowered tool, as it was measured or planned, from before the contact to where it stops or is lifted.
        before: pose of the object at rest before the push, table frame, shape (3,).
        after: the same after the push.
        covariance_before: of a single pose there, shape (3, 3).
        covariance_after: the same after the push.
        camera: how well it is known where the camera stands that measured them; None: exactly.
        seen: when the pose after the push was measured, on the clock of `pusher` [s]. Soon after the tool has stopped it may be older.
    """
    camera = camera or CameraAccuracy()
    moved = float(displacement(shape, before, after))
    noise = float(np.linalg.norm(noise_allowance(shape, np.array([covariance_before, covariance_after]))))
    (_, first), (place, last) = (_gaps(shape, pusher, pose) for pose in (before, after))
    at_rest = last[place >= np.interp(seen - _CLOCKS, pusher.time, _lengths(pusher))]
    near, coasting = _near(shape, after, covariance_after, camera), _coasting(pusher)
    if moved > noise and (least := float(np.min(first))) > _near(shape, before, covariance_before, camera):
        return f"it moved by {moved_text(shape, before, after)}, but the tool came no nearer to it than {_mm(least)}."
    if moved > noise and (apart := float(np.min(last))) > near + coasting:
        return f"it rests {_mm(apart)} from everything that the tool passed; {_mm(near + coasting)} are possible."
    if (depth := -float(np.max(at_rest)) - _corners(pusher)) > near:
        return f"the tool rests {_mm(depth)} inside of it; {_mm(near)} are possible."
    if moved > (possible := _LEVER * travel_in_contact(shape, pusher, before, covariance_before, camera) + coasting + noise):
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
    return float(pusher.time[np.searchsorted(length, length[-1] - _STANDS)])


def _lengths(pusher: PusherPath) -> Float64Array:
    """Length of the path up to each sample [m], shape (n_samples,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pusher.position, axis=0), axis=1))])


def _gaps(shape: ObjectShape, pusher: PusherPath, pose: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Lengths of the path [m], shape (n,), and the least gap there between pusher and object at a pose; of a polygon that of its circle."""
    length = _lengths(pusher)
    places = np.linspace(0.0, length[-1], 1 + math.ceil(length[-1] / _SPACING))
    position = np.column_stack([np.interp(places, length, pusher.position[:, axis]) for axis in (0, 1)])
    position[-1] = pusher.position[-1]
    distance = signed_distance(transform_points(inverse(pose), position), shape.outline)
    return places, distance - pusher.radius - _corners(pusher)


def _corners(pusher: PusherPath) -> float:
    """How far the corners of a polygon are from its origin [m]; 0 for a cylinder."""
    return 0.0 if pusher.polygon is None else float(np.max(np.linalg.norm(pusher.polygon, axis=1)))


def _near(shape: ObjectShape, pose: Float64Array, covariance: Float64Array, camera: CameraAccuracy) -> float:
    """Gap at which the pusher may touch an object that is seen at this pose, or overlap at which it may just touch [m]."""
    seen = math.hypot(camera.position, camera.heading * float(np.hypot(*pose[:2])))
    geometry = _DEVIATIONS * math.hypot(_GEOMETRY_STD, shape.outline_error or 0.0, seen)
    return math.hypot(geometry, float(noise_allowance(shape, covariance)))


def _coasting(pusher: PusherPath) -> float:
    """Way on which an object comes to rest that has the highest speed of its pusher [m]."""
    length, end = _lengths(pusher), float(pusher.time[-1])
    over = min(_SPEED_OVER, end - float(pusher.time[0]))
    speed = float(np.max(length - np.interp(pusher.time - over, pusher.time, length))) / over
    return speed**2 / (2.0 * _SLIPPERIEST * _GRAVITY)


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.0f} mm"
