"""Push records from the contents of a bag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.bags.contract import Role
from push_ident.bags.reader import BagContents
from push_ident.errors import BagError
from push_ident.limits import LIMITS
from push_ident.pushing.cutter import PushCutter
from push_ident.pushing.pose_noise import PAUSE
from push_ident.pushing.regular_path import stamps_jitter
from push_ident.types import CameraAccuracy, PusherShape, PushRecord

_OTHER_NOISE: Final = "`push-ident identify`, `predict`, `selftest`, `diagnose` and `fleet` take others with --pose-std METRES,RADIANS."


def split_pushes(contents: BagContents, object_id: str) -> list[PushRecord]:
    """The pushes of one object in a bag, in order of time, cut by the rules of `pushing/cutter.py`.

    Where the bag has push records, they give the intervals of the pushes, and only those with error code 0 are used. Else a pause of the
    pusher over 0.5 s ends a push; a single push beside the topic of the records, without a record, was broken off and is left out.

    Failed pushes and those with fewer than 2 pusher samples or 2 poses are left out with a line in `contents.notes`; `source` still
    counts them, from 1. Raises BagError for an unknown object, one without cells or poses, or a bag without a single usable push.
    """
    if object_id not in contents.objects:
        known = ", ".join(contents.objects) or "none"
        raise BagError(f"{contents.path}: no object {object_id!r}; the bag has {known}.")
    track = contents.objects[object_id]
    if track.shape is None or len(track.time) < 2:
        if track.shape is None and (reasons := [note for note in contents.notes if note.startswith(f"object {object_id}: its cells")]):
            raise BagError(f"{contents.path}: {reasons[0]}")
        lacking = "cells" if track.shape is None else "poses"
        raise BagError(f"{contents.path}: object {object_id} has no {lacking}; track it in the depth images, or record `objects/<id>/*`.")
    cutter = _cutter_of(contents, [object_id])
    pushes = cutter.finished(flush=True)
    LIMITS.PUSHES.check(len(pushes), str(contents.path), error=BagError, remedy="Split the bag.")
    records = [
        replace(record, source=f"{contents.path.name} push {number}") for number, push in enumerate(pushes, 1) for record in push.records
    ]
    skipped = [
        f"push {number} of object {object_id} is left out: {reason}."
        for number, push in enumerate(pushes, 1)
        for reason in push.left_out.values()
    ]
    skipped += _jitter_note(contents, records)
    if records:
        skipped += [f"object {object_id}: {text}. {_OTHER_NOISE}" for text in cutter.noise_texts().values()]
    contents.notes.extend(note for note in skipped if note not in contents.notes)
    if not records:
        remedy = f" Record rests around pushes; {_OTHER_NOISE}" if cutter.noise_texts() else ""
        raise BagError(f"{contents.path}: none of {len(pushes)} pushes is usable; {skipped[0] if skipped else 'there are none'}{remedy}")
    return records


def _jitter_note(contents: BagContents, records: Sequence[PushRecord]) -> list[str]:
    time, position = contents.pusher.time, contents.pusher.value[:, :2]
    within = [(time >= record.pusher.time[0]) & (time <= record.pusher.time[-1]) for record in records]
    n = sum(stamps_jitter(time[chosen], position[chosen]) for chosen in within)
    return [f"the stamps of the pusher jitter in {n} of {len(records)} pushes: their paths are smoothed"] if n else []


def pushes_by_object(contents: BagContents) -> dict[str, list[PushRecord]]:
    """The usable pushes of every object that has cells and poses, cut once for all of them."""
    usable = [object_id for object_id, track in contents.objects.items() if track.shape is not None and len(track.time) >= 2]
    found: dict[str, list[PushRecord]] = {object_id: [] for object_id in usable}
    for push in _cutter_of(contents, usable).finished(flush=True):
        for record in push.records:
            found[record.object_id].append(record)
    return found


def count_pushes(contents: BagContents) -> int:
    """Pushes that a bag has, whether or not anything was seen of them: its records without an error, else its motions of the pusher."""
    if contents.push_intervals:
        return sum(interval.error_code == 0 for interval in contents.push_intervals)
    return 1 + int(np.sum(np.diff(contents.pusher.time) > PAUSE))


def _cutter_of(contents: BagContents, object_ids: Sequence[str]) -> PushCutter:
    """A cutter with all samples of the bag for these objects."""
    cutter = PushCutter(PAUSE, capacity=None, find_runs=not contents.push_intervals, pose_std=contents.options.pose_std)
    cutter.expects_records = _has_record_topic(contents) and int(np.sum(np.diff(contents.pusher.time) > PAUSE)) == 0
    cutter.set_pusher_shape(contents.pusher_shape or PusherShape(0.0))
    cutter.set_camera(contents.camera_accuracy or CameraAccuracy())
    for interval in contents.push_intervals:
        cutter.add_record(interval)
    for time, position in zip(contents.pusher.time.tolist(), contents.pusher.value, strict=True):
        cutter.add_pusher(time, position)
    for object_id in object_ids:
        track = contents.objects[object_id]
        assert track.shape is not None
        cutter.set_shape(object_id, track.shape)
        for time, pose, covariance in zip(track.time.tolist(), track.pose, track.covariance, strict=True):
            cutter.add_pose(object_id, time, pose, covariance)
    if contents.wrench is not None:
        for time, force in zip(contents.wrench.time.tolist(), contents.wrench.value, strict=True):
            cutter.add_wrench(time, force)
    return cutter


def _has_record_topic(contents: BagContents) -> bool:
    """Whether an executor was there, even one that wrote no record.

    One that died in its first push leaves one push without a record. Several of them are not an executor's: it would have left a record
    of all but the last.
    """
    return any((found := contents.options.role_of(topic)) is not None and found.role is Role.PUSH_RECORD for topic in contents.topics)
