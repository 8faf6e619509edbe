"""Do pusher and object meet where the object begins to move?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.geometry.outline import outline_distance
from push_ident.types import Float64Array, ObjectShape, PushRecord


@dataclass(frozen=True, slots=True)
class Contact:
    """Where the pusher is when the object begins to move; lengths to the pusher's surface [m], negative inside the outline."""

    moved: bool
    """Whether the object moves."""
    distance: float
    """At the first frame in which the object has moved; NaN where it never does, or where poses are too far apart in time to show it."""
    nearest: float
    """Least distance until then; over the whole push where the object never moves."""
    deepest: float
    """Least distance of the whole push; NaN where poses are too far apart in time to show it."""


def contact_tolerance(shape: ObjectShape, *, position_std: float, yaw_std: float) -> float:
    """Distance between pusher and outline that pose noise and outline error explain [m].

    Three standard deviations (3 in 1000 pushes of a right import) of the outline point farthest from the origin of the object frame, for
    poses with standard deviations `position_std` [m] and `yaw_std` [rad], and 1 mm for outline and clocks: 10 ms at 100 mm/s.
    """
    lever = float(np.linalg.norm(shape.outline, axis=1).max())
    return 1e-3 + 3.0 * float(np.hypot(position_std, lever * yaw_std))


def contact_tolerance_of(records: Sequence[PushRecord]) -> float:
    """The same of pushes of one object, at least one, by the median of their covariances [m].

    Three standard deviations of a traced outline and of the place of a camera add to it.
    """
    shape = records[0].shape
    stated = np.sqrt([np.median(np.diagonal(record.poses.covariance, axis1=1, axis2=2), axis=0) for record in records])
    position, yaw = float(np.median(stated[:, :2])), float(np.median(stated[:, 2]))
    camera = max(record.poses.camera.position for record in records)
    heading = max(record.poses.camera.heading for record in records)
    place = max(float(np.linalg.norm(record.poses.pose[:, :2], axis=1).max()) for record in records)
    shared = float(np.linalg.norm([shape.outline_error or 0.0, camera, heading * place]))
    return contact_tolerance(shape, position_std=float(np.hypot(position, shared)), yaw_std=yaw)


def contact_of(
    time: Float64Array, pose: Float64Array, path: Float64Array, *, shape: ObjectShape, radius: float, tolerance: float
) -> Contact:
    """Contact of one push, from poses (x, y, yaw) in `table`, shape (n, 3), at `time` [s], shape (n,); n at least 1.

    `path` has rows (time, x, y) of the pusher's axis [s, m, m], shape (m, 3). The object has moved when a point of its outline may be
    farther than `tolerance` from its place in the five frames before the pusher starts, in two frames that follow each other: one alone may
    be noise. Poses more than 0.2 s apart do not show when it begins to move.
    """
    first = np.median(pose[time <= max(path[0, 0], time[0])][-5:], axis=0)
    lever = float(np.linalg.norm(shape.outline, axis=1).max())
    moved = np.linalg.norm(pose[:, :2] - first[:2], axis=1) + lever * np.abs(pose[:, 2] - first[2]) > tolerance
    moved &= np.append(moved[1:], True)
    at = int(np.argmax(moved)) if moved.any() else len(time) - 1
    if at > 0 and time[at] - time[at - 1] > 0.2:
        # When it moved between two poses is unknown: the pusher must have come to where the object stood before.
        nearest = float(outline_distance(path[:, 1:], np.broadcast_to(first, (len(path), 3)), shape.outline).min()) - radius
        return Contact(bool(moved.any()), np.nan, nearest, np.nan)
    position = np.column_stack([np.interp(time, path[:, 0], path[:, axis]) for axis in (1, 2)])
    distance = outline_distance(position, pose, shape.outline) - radius
    return Contact(
        bool(moved.any()), float(distance[at]) if moved.any() else np.nan, float(distance[: at + 1].min()), float(distance.min())
    )


def contact_warnings(contacts: Mapping[int, Contact], tolerance: float) -> tuple[str, ...]:
    """Pushes in which the object moves before the pusher is there, or in which the pusher is inside it, by more than `tolerance` [m].

    `contacts`: by the number of the push, from 0.
    """
    found = []
    remedy = "check frames, units, the pusher's radius and the clocks of both"
    far = [k for k, c in contacts.items() if c.moved and c.nearest > tolerance]
    if far:
        most = max(contacts[k].nearest for k in far)
        found.append(
            f"the object moves while the pusher is still up to {1e3 * most:.1f} mm from its outline, expected at most "
            f"{1e3 * tolerance:.1f} mm, in {_pushes(far)}; {remedy}."
        )
    deep = [k for k, c in contacts.items() if c.deepest < -tolerance]
    if deep:
        most = -min(contacts[k].deepest for k in deep)
        found.append(
            f"the pusher is up to {1e3 * most:.1f} mm inside the outline, expected at most {1e3 * tolerance:.1f} mm, in {_pushes(deep)}; "
            f"{remedy}."
        )
    return (*found, *_no_contact([k for k, c in contacts.items() if not c.moved]))


def distance_warnings(distance: Float64Array, tolerance: float) -> tuple[str, ...]:
    """Pushes whose distance at first contact [m] exceeds `tolerance` [m]; for recordings in which the force shows the contact."""
    found = []
    wrong = [k for k, d in enumerate(distance) if abs(d) > tolerance]
    if wrong:
        most = max((float(distance[k]) for k in wrong), key=abs)
        found.append(
            f"the pusher is up to {1e3 * abs(most):.1f} mm {'inside' if most < 0 else 'outside'} the outline at first contact, expected at "
            f"most {1e3 * tolerance:.1f} mm, in {_pushes(wrong)}; another object, another tool or another calibration may have been used."
        )
    return (*found, *_no_contact([int(k) for k in np.flatnonzero(np.isnan(distance))]))


def _no_contact(missed: Sequence[int]) -> tuple[str, ...]:
    return (f"nothing shows that the pusher touches the object in {_pushes(missed)}.",) if missed else ()


def _pushes(numbers: Sequence[int], most: int = 5) -> str:
    """Pushes, `most` of them by number, as text for people, who count from 1; `numbers` are from 0."""
    named = ", ".join(str(number + 1) for number in numbers[:most]) + (", …" if len(numbers) > most else "")
    return f"{len(numbers)} pushes ({named})" if len(numbers) > 1 else f"push {named}"
