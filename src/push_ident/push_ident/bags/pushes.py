"""From the contents of a bag to push records."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from push_ident.bags.reader import BagContents, PushInterval
from push_ident.errors import BagError
from push_ident.types import BoolArray, Float64Array, PoseTrack, PusherPath, PushRecord, WrenchTrack

__all__ = ["split_pushes"]


def split_pushes(contents: BagContents, object_id: str, gap: float = 0.5) -> list[PushRecord]:
    """The pushes of a bag as seen on one object, in order of time.

    Pushes are told apart by push records where the bag has any (only those with error code 0 are taken), else by gaps over `gap` [s] in the
    pusher's stamps. A push gets the poses up to `gap` around it, or else the nearest one on that side, but none nearer to another push.

    Pushes with fewer than 2 pusher samples or 2 poses are left out with a line in `contents.notes`; `source` counts them nevertheless,
    from 0. Raises BagError for an unknown object, one without cells or poses, or a bag without a single usable push.
    """
    if object_id not in contents.objects:
        known = ", ".join(contents.objects) or "none"
        raise BagError(f"{contents.path}: no object {object_id!r}; the bag has {known}.")
    track = contents.objects[object_id]
    if track.shape is None or len(track.time) < 2:
        lacking = "usable cells" if track.shape is None else "poses"
        raise BagError(f"{contents.path}: object {object_id} has no {lacking}; track it in the depth images, or record `objects/<id>/*`.")
    intervals = contents.push_intervals or _intervals_by_gaps(contents.pusher.time, gap)
    records = []
    skipped: list[str] = []
    for number, interval in enumerate(intervals):
        # A failed push may have moved the object too, so it bounds its neighbours although it is not taken itself.
        earliest = 0.5 * (intervals[number - 1].end + interval.start) if number else -math.inf
        latest = 0.5 * (interval.end + intervals[number + 1].start) if number + 1 < len(intervals) else math.inf
        pusher = _within(contents.pusher.time, interval.start, interval.end)
        poses = _pose_indices(track.time, interval.start, interval.end, (earliest, latest), gap)
        if reason := _unusable(interval, int(np.count_nonzero(pusher)), len(poses)):
            skipped.append(f"push {number} of object {object_id} is left out: {reason}.")
            continue
        wrench = None
        if contents.wrench is not None and (felt := _within(contents.wrench.time, interval.start, interval.end)).any():
            wrench = WrenchTrack(contents.wrench.time[felt], contents.wrench.value[felt])
        records.append(
            PushRecord(
                object_id=object_id,
                shape=track.shape,
                poses=PoseTrack(track.time[poses], track.pose[poses], track.covariance[poses]),
                pusher=PusherPath(contents.pusher.time[pusher], contents.pusher.value[pusher], contents.pusher_radius),
                wrench=wrench,
                source=f"{contents.path.name} push {number}",
            )
        )
    contents.notes.extend(note for note in skipped if note not in contents.notes)
    if not records:
        raise BagError(f"{contents.path}: not one of {len(intervals)} pushes is usable; {skipped[0] if skipped else 'there are none'}")
    return records


def _intervals_by_gaps(time: Float64Array, gap: float) -> tuple[PushInterval, ...]:
    breaks = np.flatnonzero(np.diff(time) > gap)
    starts, ends = time[np.append(0, breaks + 1)], time[np.append(breaks, len(time) - 1)]
    return tuple(PushInterval(number, "", float(a), float(b), 0) for number, (a, b) in enumerate(zip(starts, ends, strict=True)))


def _unusable(interval: PushInterval, n_pusher: int, n_poses: int) -> str:
    """Why an interval gives no record; empty when it does."""
    if interval.error_code:
        return f"its push record has error code {interval.error_code}"
    if n_pusher < 2:
        return f"{n_pusher} pusher poses, expected at least 2"
    if n_poses < 2:
        return f"{n_poses} object poses, expected at least the two end poses"
    return ""


def _within(time: Float64Array, start: float, end: float) -> BoolArray:
    # Half a microsecond: stamps and interval ends went through different roundings.
    return (time >= start - 5e-7) & (time <= end + 5e-7)


def _pose_indices(time: Float64Array, start: float, end: float, window: tuple[float, float], gap: float) -> NDArray[np.intp]:
    """Frames of a push: during it, at rest around it, and where there are none at rest the nearest one on that side."""
    mine = (time > window[0]) & (time <= window[1])
    taken = mine & (time >= start - gap) & (time <= end + gap)
    if not (taken & (time <= start)).any():
        taken[np.flatnonzero(mine & (time < start))[-1:]] = True
    if not (taken & (time >= end)).any():
        taken[np.flatnonzero(mine & (time > end))[:1]] = True
    return np.flatnonzero(taken)
