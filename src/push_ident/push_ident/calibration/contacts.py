"""Frames in which a tool certainly touches an object, whatever is wrong with the calibration.

An object on a table moves only while it is pushed: in each frame strictly inside its motion the tool is tangent to its outline. Where the
tool has stopped so gently that the object cannot have coasted on, it still is at the rest that follows, to which no clock matters.

The calibration errs by five unknowns: (x, y) and heading of the camera, which shows what is at p at c + R(heading) (p - c) + (x, y) with c
the middle of the contacts; the surface that the tool touches, which lies outside of outline and radius by some length; and the clock of the
poses, which are stamped late.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.checking.overlap import moving_frames
from push_ident.checking.records import one_stream
from push_ident.errors import InputError
from push_ident.geometry.outline import outline_contact
from push_ident.geometry.se2 import inverse, rotation, transform_points
from push_ident.identification.observing.observation import Observation, observe_push
from push_ident.types import BoolArray, Float64Array, PushRecord

N_UNKNOWNS: Final = 5
"""Camera x, y [m] and heading [rad], surface [m], clock [s]; all are 0 where the calibration is right."""
_MOST: Final = 10
"""Frames of one motion that are used; the errors of neighbouring ones are alike."""
_CERTAIN: Final = 5.0
"""Standard deviations of a pose by which an object must have moved [-]."""
_COASTING_FRICTION: Final = 0.2
"""Support friction with which an object that is let go comes to rest [-]: low for wood, plastic or metal on a table."""
_GRAVITY: Final = 9.81
"""[m/s^2]"""


@dataclass(frozen=True, slots=True)
class Contacts:
    """The frames of one push in which the tool touches the object."""

    record: PushRecord
    time: Float64Array
    """When the tool was there [s], shape (n,)."""
    pose: Float64Array
    """Of the object as reported, shape (n, 3)."""
    covariance: Float64Array
    """Of each pose, shape (n, 3, 3)."""
    moves: BoolArray
    """False for the rest after the push: the clock does not matter there, shape (n,)."""
    centre: Float64Array
    """Middle of the contacts of all pushes, where the camera's x and y are those of [m], table frame, shape (2,)."""

    def __len__(self) -> int:
        return len(self.time)

    @property
    def shared_covariance(self) -> Float64Array:
        """Covariance that is stated of a single frame: that of an error which all frames may share, shape (3, 3)."""
        return np.asarray(self.record.poses.covariance.mean(axis=0))


@dataclass(frozen=True, slots=True)
class Gaps:
    """Gap between the tool and the surface of the object in frames with contact, where it should be 0."""

    gap: Float64Array
    """[m], shape (n,)."""
    by_unknown: Float64Array
    """Derivative by the unknowns of the calibration, shape (n, 5)."""
    by_pose: Float64Array
    """Derivative by an error of the pose, shape (n, 3)."""
    edge: NDArray[np.intp]
    """Edge of the outline that is nearest to the tool, shape (n,)."""
    tool: Float64Array
    """Axis of the tool in the frame of the camera [m], shape (n, 2)."""
    outward: Float64Array
    """Normal of the surface that is touched, table frame, shape (n, 2)."""
    normal: Float64Array
    """The same in the object frame, shape (n, 2)."""


def contacts_of(records: Sequence[PushRecord]) -> list[Contacts]:
    """Of each push of one object that shows a contact. Raises InputError for a tool that is no cylinder."""
    if any(not record.pusher.shape.is_cylinder for record in records):
        raise InputError("the pusher is no cylinder; a calibration is checked with pushes of an upright cylinder.")
    found = [contacts for record in records if len(contacts := _contacts(record))]
    if not found:
        return []
    middles = [[np.mean(np.interp(c.time, c.record.pusher.time, c.record.pusher.position[:, axis])) for axis in (0, 1)] for c in found]
    return [replace(contacts, centre=np.mean(middles, axis=0)) for contacts in found]


def gaps_of(contacts: Contacts, unknowns: Float64Array) -> Gaps:
    """Gaps and their derivatives at a calibration that errs by `unknowns`, shape (5,)."""
    x, y, heading, surface, clock = unknowns
    path, turn = contacts.record.pusher, rotation(heading)
    time = contacts.time - clock * contacts.moves
    velocity = np.gradient(path.position, path.time, axis=0)
    at = np.column_stack([np.interp(time, path.time, path.position[:, axis]) for axis in (0, 1)])
    speed = np.column_stack([np.interp(time, path.time, velocity[:, axis]) for axis in (0, 1)]) * contacts.moves[:, None]
    arm = (at - contacts.centre) @ turn.T
    tool = np.add(contacts.centre + arm, (x, y))
    in_object = transform_points(inverse(contacts.pose), tool[:, None])[:, 0]
    distance, normal, edge = outline_contact(in_object, contacts.record.shape.outline)
    outward = np.einsum("nij,nj->ni", rotation(contacts.pose[:, 2]), normal)
    by_unknown = np.column_stack([outward, _moment(arm, outward), -np.ones(len(at)), -np.sum(outward * (speed @ turn.T), axis=1)])
    by_pose = np.column_stack([-outward, -_moment(tool - contacts.pose[:, :2], outward)])
    return Gaps(distance - path.radius - surface, by_unknown, by_pose, edge, tool, outward, normal)


def _moment(arm: Float64Array, direction: Float64Array) -> Float64Array:
    """Derivative by a rotation of what moves along `direction` at `arm`, both shape (n, 2), shape (n,)."""
    return np.asarray(arm[:, 0] * direction[:, 1] - arm[:, 1] * direction[:, 0])


def _contacts(record: PushRecord) -> Contacts:
    poses = record.poses
    frames = moving_frames(one_stream([record], 0.0))
    start = min(poses.time[0], record.pusher.time[0])
    chosen = np.searchsorted(poses.time, frames.time + start - 1e-9)
    if len(chosen) > _MOST:
        chosen = chosen[np.linspace(0, len(chosen) - 1, _MOST).round().astype(int)]
    time, pose, covariance = poses.time[chosen], poses.pose[chosen], poses.covariance[chosen]
    moves = np.ones(len(time), dtype=np.bool_)
    observed = observe_push(record)
    stop = _stop(record, observed)
    if np.isfinite(stop):
        time, moves = np.append(time, stop), np.append(moves, False)
        pose, covariance = np.vstack([pose, observed.pose[-1]]), np.concatenate([covariance, observed.last_covariance[None]])
    return Contacts(record, time, pose, covariance, moves, np.zeros(2))


def _stop(record: PushRecord, observed: Observation) -> float:
    """When the tool has stopped at an object that then rests against it [s]; NaN where the object may have left it."""
    path, poses = record.pusher, record.poses
    moved = observed.pose[-1] - observed.pose[0]
    distance2 = moved @ np.linalg.solve(observed.first_covariance + observed.last_covariance, moved)
    speed = np.linalg.norm(np.gradient(path.position, path.time, axis=0), axis=1)
    top = float(np.max(speed))
    if distance2 < _CERTAIN**2 or top == 0.0:
        return np.nan
    drives = int(np.flatnonzero(speed > 0.05 * top)[-1])
    stops = np.append(np.flatnonzero(speed[drives:] < 1e-3 * top), len(speed) - 1 - drives)
    stop = float(path.time[drives + stops[0]])
    slowing = int(np.flatnonzero(speed >= 0.95 * top)[-1])
    of_tool = float(np.sum(np.linalg.norm(np.diff(path.position[slowing:], axis=0), axis=1)))
    coasting = top**2 / (2.0 * _COASTING_FRICTION * _GRAVITY) - of_tool
    noise = float(np.sqrt(np.max(observed.last_covariance[:2, :2])))
    followed = coasting < noise and poses.time[-1] >= stop and _followed(record, observed)
    return stop if followed else np.nan


def _followed(record: PushRecord, observed: Observation) -> bool:
    """Whether the object still moved in the last part of the tool's way; of one that did not, the tool has slid off.

    True where only the ends of the push were seen: no frame shows it.
    """
    path, poses = record.pusher, record.poses
    steps = np.linalg.norm(np.diff(path.position, axis=0), axis=1)
    left = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    during = 1 + np.flatnonzero((poses.time[1:-1] > path.time[0]) & (np.interp(poses.time[1:-1], path.time, left) > 0.0))
    if not len(during):
        return True
    covariance = poses.covariance[during] + observed.last_covariance
    noise = np.sqrt(np.max(covariance[:, :2, :2], axis=(1, 2)))
    far = np.flatnonzero(np.interp(poses.time[during], path.time, left) > 2.0 * _CERTAIN * noise)
    if not len(far):
        return False
    moved = observed.pose[-1] - poses.pose[during[far[-1]]]
    return bool(moved @ np.linalg.solve(covariance[far[-1]], moved) > _CERTAIN**2)
