"""Time from an image, and from the pose, to the map: camera here, perception and identification as processes of their own."""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from shape_msgs.msg import SolidPrimitive

from push_ident.cli.supervisor import node_commands
from push_ident.errors import PushIdentError
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import cylinder_to_msg, depth_frame_to_msgs, position_to_msg, stamp_to_msg
from push_ident.pushing.push import PushSettings
from push_ident.types import DepthFrame
from push_ident_sim.cell.camera import DepthCamera, DepthNoise
from push_ident_sim.cell.robot import PUSHER_LENGTH, PUSHER_RADIUS
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object
from push_ident_sim.recordings.recording import standing_tool
from push_ident_sim.recordings.truth import TruthSettings, make_pushes
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.live_nodes import (
    IDENTIFICATION,
    PERCEPTION,
    NodeProcess,
    Observer,
    microseconds,
    observer,
    processor_time,
    until,
)
from push_ident_sim.studies.common.seeing import CAMERA_POSE, RATE

__all__ = ["delays", "measure_live_latency"]

FloatArray = NDArray[np.float64]
_Frame = tuple[Image, CameraInfo]

_OBJECT: Final = "o1"
"""Id that perception gives to the first object."""
_N_PUSHES: Final = 12
_CELLS: Final = 110
_PAUSE: Final = 1.5
"""Rest between two pushes, in which the estimate is refined [s]."""
_AT_REST: Final = 0.2
"""Time for which the lowered tool waits before and after each push [s]."""
_N_STILL: Final = 5
"""Number of different images of a rest, used in turn."""
_TOOL_RATE: Final = 120.0
_TIP_HEIGHT: Final = 0.012
_BEGIN: Final = 1.0
"""First stamp [s]."""
_PATIENCE: Final = 60.0
"""Longest time until the object is found [s]."""
_WARM_UP: Final = 8.0
"""From then to the first push: the processes load their compiled kernels [s]."""


@dataclass(frozen=True, slots=True)
class _Scene:
    """One push in images; times from its start [s]."""

    time: FloatArray
    """Of the images, shape (n,)."""
    images: Sequence[_Frame]
    tool_time: FloatArray
    tool: FloatArray
    """Shape (m, 2) [m]."""
    still: Sequence[_Frame]
    """After the push, without tool."""


class _Camera(Observer):
    """Publishes as a camera and an arm do."""

    def __init__(self, context: Context, object_id: str) -> None:
        super().__init__(context, object_id)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._images = self.create_publisher(Image, "depth/image_rect", qos_profile_sensor_data)
        self._infos = self.create_publisher(CameraInfo, "depth/camera_info", qos_profile_sensor_data)
        self._tool = self.create_publisher(PoseStamped, "tool/pose", 10)
        self._pusher = self.create_publisher(PoseStamped, "pusher/pose", 10)
        self._shape = self.create_publisher(SolidPrimitive, "pusher/shape", latched)
        self._shape.publish(cylinder_to_msg(PUSHER_RADIUS, PUSHER_LENGTH))
        self._started = time.monotonic()
        self.image_at: dict[int, float] = {}
        """Departure of the image with a stamp [µs]."""

    @property
    def now(self) -> float:
        """Stamp of this moment [s]."""
        return _BEGIN + time.monotonic() - self._started

    def show(self, frame: _Frame, stamp: float) -> None:
        """Wait for the moment and publish an image."""
        image, info = frame
        # Whole milliseconds, so that the stamp returns unchanged.
        image.header.stamp = info.header.stamp = stamp_to_msg(round(stamp, 3))
        self._wait(stamp)
        self._infos.publish(info)
        self.image_at[microseconds(image.header.stamp)] = time.monotonic()
        self._images.publish(image)

    def publish_tool(self, position: FloatArray, stamp: float) -> None:
        """Wait until `stamp` and publish the position of the tool."""
        msg = position_to_msg(stamp_to_msg(stamp), np.array([*position, _TIP_HEIGHT]))
        self._wait(stamp)
        self._tool.publish(msg)
        self._pusher.publish(msg)

    def _wait(self, stamp: float) -> None:
        time.sleep(max(0.0, stamp - self.now))


def measure_live_latency(object_name: str, model: int) -> Json:
    """Twelve pushes before the camera.

    Returns:
        `n_cells`; `delays` as of `delays`, from pose to map and from image to map; the node's own numbers (`counts`); the
        processor load of each process (`load`), 1 being one core.

    Raises:
        PushIdentError: the object is not found, or a process ends.
    """
    first, scenes = _film(make_object(object_name, model), [model, OBJECT_NAMES.index(object_name), 11])
    domain = own_domain()
    parameters = {PERCEPTION: {"cell_count": _CELLS}}
    both = {c.name: c for c in node_commands("arm", parameters=parameters, log_level="warn")}
    with tempfile.TemporaryDirectory(prefix="push_ident_live_") as name:
        logs = Path(name)
        with (
            observer(domain, _OBJECT, _Camera) as camera,
            NodeProcess(both[PERCEPTION], logs / "perception.log", domain) as perception,
            NodeProcess(both[IDENTIFICATION], logs / "identification.log", domain) as identification,
        ):
            pids = {"perception": perception.pid, "identification": identification.pid, "camera and observer": os.getpid()}
            _show_rest(camera, first, perception, identification)
            until(lambda: camera.reported, 10.0, "identification said nothing", identification)
            before, began = {n: processor_time(pid) for n, pid in pids.items()}, time.monotonic()
            spans = [_show_push(camera, scene) for scene in scenes]
            load = {n: round((processor_time(pid) - before[n]) / (time.monotonic() - began), 3) for n, pid in pids.items()}
            time.sleep(1.5)
            perception.check()
            identification.check()
            return {
                "n_cells": camera.n_cells,
                "period_s": 1.0 / RATE,
                "n_pushes": len(spans),
                "from_pose": delays(camera.pose_at, camera.map_at, spans),
                "from_image": delays(camera.image_at, camera.map_at, spans),
                "counts": dict(camera.counts),
                "load": load,
            }


def delays(came: dict[int, float], mapped: dict[int, float], spans: Sequence[tuple[float, float]]) -> Json:
    """From frames to their maps, of the frames of each push from the first that changed the map on.

    Args:
        came: when a frame was there, by stamp [µs].
        mapped: when the map of a stamp came.
        spans: first and last stamp of each push [s].
    """
    values, n_frames = [], 0
    for start, end in spans:
        frames = sorted(stamp for stamp in came if 1e6 * start <= stamp <= 1e6 * end)
        touched = next((i for i, stamp in enumerate(frames) if stamp in mapped), len(frames))
        n_frames += len(frames) - touched
        values += [mapped[stamp] - came[stamp] for stamp in frames[touched:] if stamp in mapped]
    if not values:
        raise PushIdentError("No frame of any push gave a map; did the tool touch the object?")
    return {
        "frames": n_frames,
        "with_map": len(values),
        "median_s": round(float(np.median(values)), 5),
        "p99_s": round(float(np.quantile(values, 0.99)), 5),
        "worst_s": round(max(values), 5),
        "all_s": [round(v, 4) for v in sorted(values)],
    }


def _show_rest(camera: _Camera, still: Sequence[_Frame], *processes: NodeProcess) -> None:
    """Until identification knows the shape, and for the warm-up."""
    known_at = np.inf
    begin = camera.now
    for number in itertools.count():
        stamp = begin + number / RATE
        camera.show(still[number % len(still)], stamp)
        for process in processes:
            process.check()
        if camera.count("shapes"):
            known_at = min(known_at, stamp)
        elif stamp > begin + _PATIENCE:
            raise PushIdentError(f"The object was not found within {_PATIENCE:.0f} s; perception and identification must both run.")
        if stamp > known_at + _WARM_UP:
            return


def _show_push(camera: _Camera, scene: _Scene) -> tuple[float, float]:
    """A push and the rest after it; first and last stamp of the push."""
    start = camera.now + 0.05
    events: list[tuple[float, Any]] = [(float(t), position) for t, position in zip(scene.tool_time, scene.tool, strict=True)]
    events += [(float(t), frame) for t, frame in zip(scene.time, scene.images, strict=True)]
    for when, what in sorted(events, key=lambda event: event[0]):
        if isinstance(what, tuple):
            camera.show(what, start + when)
        else:
            camera.publish_tool(what, start + when)
    end = start + float(scene.tool_time[-1])
    for number in range(1, round(_PAUSE * RATE)):
        camera.show(scene.still[number % len(scene.still)], start + float(scene.time[-1]) + number / RATE)
    return start, end


def _film(thing: SimObject, seed: Sequence[int]) -> tuple[list[_Frame], list[_Scene]]:
    """Images of the object at rest, and the pushes, each from where the last one ended."""
    settings = TruthSettings(n_train=_N_PUSHES, n_test=0, pushes=PushSettings(pusher_radius=PUSHER_RADIUS))
    motions = make_pushes(thing, seed, settings, in_a_row=True)
    rng, camera, noise = np.random.default_rng([*seed, 1]), DepthCamera(thing, CAMERA_POSE), DepthNoise()

    def look(pose: FloatArray, tool: FloatArray | None) -> _Frame:
        depth = noise.apply(camera.render(pose, {} if tool is None else {"hand_pusher": standing_tool(tool)}), rng)
        return depth_frame_to_msgs(DepthFrame(0.0, depth, camera.intrinsics), stamp_to_msg(0.0))

    first = [look(motions[0].pose[0], None) for _ in range(4 * _N_STILL)]
    return first, [_scene(motion, look) for motion in motions]


def _scene(motion: TrueMotion, look: Any) -> _Scene:
    lasts = _AT_REST + float(motion.time[-1]) + _AT_REST
    clock = np.arange(0.0, lasts, 1.0 / RATE)
    tool_clock = np.arange(0.0, lasts, 1.0 / _TOOL_RATE)
    images = [look(motion.pose_at(t - _AT_REST), motion.pusher_at(t - _AT_REST)) for t in clock]
    tool = np.array([motion.pusher_at(t - _AT_REST) for t in tool_clock])
    return _Scene(clock, images, tool_clock, tool, [look(motion.pose[-1], None) for _ in range(_N_STILL)])
