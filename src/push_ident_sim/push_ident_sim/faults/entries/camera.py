"""Faults of the depth camera. Its images are little-endian 16UC1."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from push_ident.cli.supervisor import node_commands
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.nodes.convert.messages import stamp_from_msg, stamp_to_msg
from push_ident_sim.cell.camera import INTRINSICS
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.cell import CAMERA_CELL
from push_ident_sim.faults.harness.proxy import changed, drop

__all__ = ["FAULTS"]

_NODE: Final = "perception_node"
_IMAGE, _INFO = "depth/image_rect", "depth/camera_info"
_LONG: Final = 1.5
"""How long the camera is wrong [s]: some twenty images."""
_CAMERA: Final = ([0.55, 0.0, 0.85], [0.67815377, 0.67815377, -0.20026847, -0.20026847])
"""Position [m] and quaternion of the camera in `table`, as in the parameter files."""
_APART: Final = 100.0
"""Between an image and its camera info [s]; less, and the image would find an earlier info."""
_UNKNOWN: Final = -1


def _wrong(trial: Trial, topic: str, change: Callable[[Any], Any], *words: str, node: str = _NODE) -> None:
    """Change every message of a topic for a while: perception says `words`, publishes nothing, and goes on afterwards."""
    cell = trial.cell
    poses = cell.watch_poses()
    since = cell.proxy.set(topic, changed(topic, change))
    trial.expect_report(node, *words, since=since)
    trial.wait(_LONG)
    late = sum(received > since + 0.5 for received, _ in poses)
    trial.expect(late == 0, f"{late} poses were published meanwhile")
    cleared = time.monotonic()
    cell.proxy.clear()
    trial.expect_soon(lambda: poses and poses[-1][0] > cleared, 5.0, "no poses came when the camera was right again")
    report = cell.monitor.report_of(node)
    trial.note = trial.note or (report.values.get("last_error", "") or report.values.get("last refusal", "") if report else "")


def _filled(value: int) -> Callable[[Any], Any]:
    def change(msg: Any) -> Any:
        msg.data = array("B", np.full(msg.height * msg.width, value, dtype="<u2").tobytes())
        return msg

    return change


def _partly(trial: Trial) -> None:
    """Without a depth in the left third of the image, the cells that it would see are unknown."""
    cell = trial.cell
    width = INTRINSICS.width // 3
    grids = cell.watch("workspace/occupancy")

    def hole(msg: Any) -> Any:
        pixels = np.frombuffer(msg.data, dtype="<u2").reshape(msg.height, msg.width).copy()
        pixels[:, :width] = 0
        msg.data = array("B", pixels.tobytes())
        return msg

    cell.proxy.set(_IMAGE, changed(_IMAGE, hole))
    trial.wait(1.0)
    del grids[:]
    trial.expect_soon(lambda: len(grids) > 0, 8.0, "no occupancy was published")
    if grids:
        grid = grids[-1][1]
        values = np.array(grid.data, dtype=np.int8).reshape(grid.info.height, grid.info.width)
        rows, columns = np.indices(values.shape)
        size, origin = grid.info.resolution, grid.info.origin.position
        points = np.stack([origin.x + (columns + 0.5) * size, origin.y + (rows + 0.5) * size, 0 * rows], axis=-1).reshape(-1, 3)
        camera = np.linalg.inv(pose_of_quaternion(*_CAMERA))
        in_camera = points @ camera[:3, :3].T + camera[:3, 3]
        u = INTRINSICS.fx * in_camera[:, 0] / in_camera[:, 2] + INTRINSICS.cx
        blind = (u < width - 8).reshape(values.shape)
        seen = int(np.sum(values[blind] != _UNKNOWN))
        trial.expect(blind.any(), "no cell of the grid is in the hole; the check is void")
        trial.expect((values[~blind] == 0).any(), "no cell beside the hole is free; the check is void")
        trial.expect(seen == 0, f"{seen} of {blind.sum()} cells without a depth are not unknown")
        trial.note = f"{blind.sum()} cells in the hole, {seen} of them not unknown"


def _encodings(trial: Trial) -> None:
    for encoding in ("mono16", "rgb8", "[/red]x"):
        _wrong(trial, _IMAGE, partial(_with, encoding=encoding), encoding, "16UC1")


def _with(msg: Any, **fields: Any) -> Any:
    for name, value in fields.items():
        setattr(msg, name, value)
    return msg


def _sizes(trial: Trial) -> None:
    def cut(msg: Any) -> Any:
        msg.data = msg.data[: len(msg.data) // 2]
        return msg

    _wrong(trial, _IMAGE, cut, "bytes")
    _wrong(trial, _IMAGE, lambda msg: _with(msg, step=1), "step")
    _wrong(trial, _IMAGE, lambda msg: _with(msg, height=2**32 - 1, width=2**32 - 1, step=2**32 - 1), "refused")


def _infos(trial: Trial) -> None:
    _wrong(trial, _INFO, lambda msg: _with(msg, width=320), "320")
    _wrong(trial, _INFO, lambda msg: _with(msg, k=[0.0] * 9, p=[0.0] * 12), "focal")

    def elsewhere(msg: Any) -> Any:
        msg.header.frame_id = "other_camera"
        return msg

    _wrong(trial, _INFO, elsewhere, "other_camera")


def _apart(trial: Trial) -> None:
    def later(msg: Any) -> Any:
        msg.header.stamp = stamp_to_msg(stamp_from_msg(msg.header.stamp) + _APART)
        return msg

    _wrong(trial, _INFO, later, "ms apart")


def _silent_camera(trial: Trial) -> None:
    cell = trial.cell
    since = cell.proxy.set(_IMAGE, drop)
    trial.expect_report(_NODE, "no depth image", since=since, patience=6.0)


def _extrinsics(trial: Trial) -> None:
    """A second perception that looks for a calibration mark that is not there, and one that wants tf."""
    cell = trial.cell
    for source, words in (("calibrate", ("extrinsics",)), ("tf", ("tf",))):
        parameters = {_NODE: {"extrinsics": source, "extrinsics_timeout": 2.0}}
        command = next(c for c in node_commands("sim", parameters=parameters) if c.name == _NODE)
        name = f"perception_{source}"
        process = cell.add(type(command)(name, (*command.argv, "-r", f"__node:={name}"), may_end=True))
        since = time.monotonic()

        def says(name: str = name, words: tuple[str, ...] = words, process: Any = process) -> bool:
            report = cell.monitor.report_of(name)
            text = process.output if not process.runs else "" if report is None else f"{report.message} {report.values}"
            return all(word in text for word in words) and ("still no" in text or not process.runs)

        trial.expect_soon(says, 15.0, f"with extrinsics:={source} nothing is said")
        trial.note += f"{source}: said after {time.monotonic() - since:.0f} s. "
        cell.remove(name)


FAULTS: Final = (
    Fault(
        number=1,
        name="depth-without-values",
        what="depth images all zero",
        holds="perception",
        expected="no pose, no grid; says 0 valid of N",
        run=lambda trial: _wrong(trial, _IMAGE, _filled(0), "0 valid of"),
        cell=CAMERA_CELL,
    ),
    Fault(
        number=2,
        name="depth-with-a-hole",
        what="no depth in a third of the image",
        holds="the occupancy grid of perception",
        expected="what it would show is unknown, never free",
        run=_partly,
        cell=CAMERA_CELL,
    ),
    Fault(
        number=3,
        name="encoding",
        what="images as mono16, as rgb8, and with markup as encoding",
        holds="the conversion of images",
        expected="refused; names it and the accepted ones",
        run=_encodings,
        cell=CAMERA_CELL,
    ),
    Fault(
        number=4,
        name="image-sizes",
        what="half the data; a step of 1; 2^32-1 in height, width and step",
        holds="the conversion of images",
        expected="dropped and counted",
        run=_sizes,
        cell=CAMERA_CELL,
    ),
    Fault(
        number=5,
        name="camera-info",
        what="camera info of another size, with K and P of zeros, of another frame",
        holds="the conversion of images",
        expected="frames refused",
        run=_infos,
        cell=CAMERA_CELL,
    ),
    Fault(
        number=6,
        name="stamps-apart",
        what="camera info stamped 100 s later than its image",
        holds="pairing of image and info",
        expected="dropped; the skew is reported",
        run=_apart,
        cell=CAMERA_CELL,
    ),
    Fault(
        number=7,
        name="no-extrinsics",
        what="extrinsics from a mark that is not there; from tf without tf2_ros",
        holds="extrinsics_timeout; the start of the node",
        expected="reported within the timeout, or one line",
        run=_extrinsics,
        cell=CAMERA_CELL,
    ),
    Fault(
        number=41,
        name="camera-silent",
        what="no image comes any more",
        holds="a timer on the wall clock",
        expected="/diagnostics names the topic",
        run=_silent_camera,
        cell=CAMERA_CELL,
    ),
)
