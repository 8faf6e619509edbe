"""Reduce a recording of a cell to a small depth bag: `.venv/bin/python tools/make_example_bag.py RECORDING OUT [N_PUSHES]`.

Kept: the first successful pushes, with pusher, wrench, push records and extrinsics; every third depth image around the pushes (and enough
before the first to observe the object at rest), every second pixel of every second row. Dropped: poses, cells and outline, so that
perception has to run on the bag.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from push_ident.bags.contract import Role, role_of
from push_ident.bags.raw import raw_messages
from push_ident.bags.reader import read_bag
from push_ident.bags.writer import BagWriter
from push_ident.types import CameraIntrinsics

EVERY = 3
"""Every third depth image is kept."""
MARGIN = 0.6
"""Depth images kept before and after a push [s]."""
BEFORE = 30
"""Images kept at the start."""


def thin(source: Path, out: Path, n_pushes: int) -> None:
    """Write the reduced bag."""
    contents = read_bag(source)
    pushes = [p for p in contents.push_intervals if p.error_code == 0][:n_pushes]
    spans = [(p.start - MARGIN, p.end + MARGIN) for p in pushes]
    last = spans[-1][1]
    with BagWriter(out) as writer:
        assert contents.camera_in_table is not None
        writer.write_extrinsics(1e-9 * contents.origin_ns, contents.camera_in_table)
        for message in raw_messages(source):
            role = role_of(message.topic)
            time = 1e-9 * (message.stamp_ns - contents.origin_ns)
            inside = any(a <= time <= b for a, b in spans)
            if role is None or role.role in (Role.POSE, Role.CELLS, Role.OUTLINE, Role.DEPTH, Role.CAMERA_INFO, Role.TF_STATIC):
                continue
            if inside or role.role is Role.PUSHER_SHAPE or (role.role is Role.PUSH_RECORD and time <= last + 10.0):
                writer.write_raw(message.topic, message.msgtype, message.stamp_ns, message.data)
        for number, frame in enumerate(contents.depth_frames()):
            inside = any(a <= frame.stamp <= b for a, b in spans) and number % EVERY == 0
            if not inside and number >= BEFORE:
                continue
            half = np.ascontiguousarray(frame.depth[::2, ::2])
            camera = frame.intrinsics
            smaller = replace(
                camera, width=half.shape[1], height=half.shape[0], fx=camera.fx / 2, fy=camera.fy / 2, cx=camera.cx / 2, cy=camera.cy / 2
            )
            _write(writer, frame.stamp + 1e-9 * contents.origin_ns, half, smaller)


def _write(writer: BagWriter, stamp: float, depth: np.ndarray, camera: CameraIntrinsics) -> None:
    writer.write_camera_info(stamp, camera)
    writer.write_depth(stamp, np.nan_to_num(np.rint(depth * 1e3), nan=0.0).astype(np.uint16))


if __name__ == "__main__":
    thin(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 5)
