"""Whether numbers from outside can be a push, where they come from a file: bags and messages are checked as they are decoded."""

from __future__ import annotations

from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.shape_check import check_pusher_radius
from push_ident.limits import LIMITS, Limit, check_coordinates
from push_ident.types import Float64Array, PoseTrack, PusherPath, PushRecord

__all__ = ["check_record"]

_REST: Final = 86_400.0
"""Time between a push and a pose before or after it [s]: a night. The simulation steps through it."""
_ASYMMETRY: Final = 1e-6
"""Difference of equal entries of a covariance that were sent in single precision, relative to the largest [-]."""


def check_record(record: PushRecord) -> PushRecord:
    """The same push; raises InputError where one of its numbers is beyond what a cell can send."""
    _check_path(record.pusher)
    _check_poses(record.poses)
    first, last = record.poses.time[0] - record.pusher.time[0], record.poses.time[-1] - record.pusher.time[-1]
    if not max(abs(first), abs(last)) <= _REST:
        raise InputError(f"Poses begin {first:.3g} s and end {last:.3g} s after the pusher, expected at most {_REST:g} s before or after.")
    if record.wrench is not None:
        _check_most(record.wrench.time, LIMITS.STAMP, "Forces")
        _check_most(record.wrench.force, LIMITS.FORCE, "Forces")
    return record


def _check_path(path: PusherPath) -> None:
    _check_most(path.time, LIMITS.STAMP, "Pusher path")
    check_coordinates(path.position, "Pusher path")
    check_pusher_radius(path.radius)
    for values, most in ((path.polygon, LIMITS.PUSHER_RADIUS), (path.yaw, LIMITS.YAW)):
        if values is not None:
            _check_most(values, most, "Pusher path")
    LIMITS.PUSH_SECONDS.check(float(path.time[-1] - path.time[0]), "Pusher path")
    LIMITS.PUSH_TRAVEL.check(float(np.sum(np.linalg.norm(np.diff(path.position, axis=0), axis=1))), "Pusher path")


def _check_poses(poses: PoseTrack) -> None:
    _check_most(poses.time, LIMITS.STAMP, "Poses")
    check_coordinates(poses.pose[:, :2], "Poses")
    _check_most(poses.pose[:, 2], LIMITS.YAW, "Poses")
    check_coordinates(poses.camera.position, "Deviation of the camera")
    largest = np.max(np.abs(poses.covariance), axis=(1, 2), keepdims=True)
    asymmetry = np.abs(poses.covariance - np.swapaxes(poses.covariance, 1, 2))
    most = LIMITS.COORDINATE.value**2
    if np.any(largest > most) or np.any(asymmetry > _ASYMMETRY * largest):
        raise InputError(f"A covariance of a pose is not symmetric, or has entries over {most} m^2 or rad^2; leave such poses out.")


def _check_most(values: Float64Array, most: Limit, what: str) -> None:
    most.check(float(np.max(np.abs(values), initial=0.0)), what, remedy="Give SI units.")
