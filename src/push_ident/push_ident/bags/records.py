"""Write push records as a contract bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.bags.writer import BagWriter
from push_ident.errors import InputError
from push_ident.types import PushRecord

LATE: Final = 1.0
"""By which a message may come after later ones, as those of a network do [s]; more is another clock, or another recording."""
FIRST_STAMP: Final = 1.0
"""Earliest stamp written [s]; a stamp of zero would mean that there is none."""


def write_records(path: Path, records: Sequence[PushRecord]) -> None:
    """Write pushes as a new bag that reads back as the same records, up to the origin of time of each push.

    Times within a push are kept; a push that would start within 2 s of the end of the previous one is moved to that distance.
    Records of several objects with the same pusher path are one push. Raises InputError for records that cannot share a bag.
    """
    if not records:
        raise InputError("there are no push records to write; a bag needs at least one.")
    tools = {(record.pusher.radius, *record.pusher.shape.core.ravel(), record.pusher.fingers is None): record for record in records}
    if len(tools) > 1:
        shapes_of_tools = ", ".join(f"{record.pusher.shape}" for record in tools.values())
        raise InputError(f"records have different pushers ({shapes_of_tools}); a bag has one pusher, write one bag for each.")
    shapes = {record.object_id: record.shape for record in records}
    for record in records:
        shape = shapes[record.object_id]
        if not (np.array_equal(shape.outline, record.shape.outline) and np.array_equal(shape.cells.centres, record.shape.cells.centres)):
            raise InputError(f"records of object {record.object_id} differ in its shape; a bag has one shape for each object.")
    clearance = 2.0  # [s]
    with BagWriter(path) as writer:
        writer.write_pusher_shape(FIRST_STAMP, records[0].pusher.shape)
        for object_id, shape in sorted(shapes.items()):
            writer.write_shape(object_id, shape, FIRST_STAMP)
        end = FIRST_STAMP - clearance
        for push_id, push in enumerate(_by_push(records), start=1):
            first = min(min(record.poses.time[0], record.pusher.time[0]) for record in push)
            shift = max(0.0, end + clearance - first)
            end = _write_push(writer, push_id, push, shift)


def _by_push(records: Sequence[PushRecord]) -> list[list[PushRecord]]:
    pushes: list[list[PushRecord]] = []
    for record in records:
        same = pushes[-1] if pushes else []
        if same and np.array_equal(same[0].pusher.time, record.pusher.time) and record.object_id not in {other.object_id for other in same}:
            same.append(record)
        else:
            pushes.append([record])
    return pushes


def _write_push(writer: BagWriter, push_id: int, push: Sequence[PushRecord], shift: float) -> float:
    """Write the observations and the interval of one push; returns its end [s]."""
    times = np.concatenate([push[0].pusher.time, *(record.poses.time for record in push)]) + shift
    start, end = float(times.min()), float(times.max())
    for record in push:
        for time, pose, covariance in zip(record.poses.time, record.poses.pose, record.poses.covariance, strict=True):
            writer.write_pose(record.object_id, float(time) + shift, pose, covariance)
    yaw = np.zeros(len(push[0].pusher.time)) if push[0].pusher.yaw is None else push[0].pusher.yaw
    for time, position, heading in zip(push[0].pusher.time, push[0].pusher.position, yaw, strict=True):
        writer.write_pusher(float(time) + shift, position, yaw=float(heading))
    if (wrench := push[0].wrench) is not None:
        for time, force in zip(wrench.time, wrench.force, strict=True):
            writer.write_wrench(float(time) + shift, force)
    writer.write_push_record(push_id, push[0].object_id, start, end)
    return end
