"""Publishers of load, a process of its own: `python -m push_ident_sim.studies.load.sources camera|streams RATE OBJECTS`.

`camera`: depth images of some objects at rest. `streams`: poses of some objects during pushes, pusher, wrench and joint states. Stamps are
the wall clock at publication, so that any listener on the machine knows the delay. SIGTERM ends it; it then prints what it has published.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import rclpy
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, JointState
from shape_msgs.msg import SolidPrimitive

from push_ident.nodes.convert.messages import (
    cylinder_to_msg,
    depth_frame_to_msgs,
    force_to_msg,
    planar_pose_to_msg,
    position_to_msg,
    shape_to_msgs,
    stamp_to_msg,
)
from push_ident.types import DepthFrame
from push_ident_sim.cell.camera import INTRINSICS, DepthCamera, DepthNoise
from push_ident_sim.cell.robot import JOINT_NAMES
from push_ident_sim.objects import SimObject, make_object
from push_ident_sim.recordings.truth import true_model
from push_ident_sim.studies.common.seeing import CAMERA_POSE

__all__ = ["object_ids", "places", "small_box"]

_LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_RELIABLE: Final = QoSProfile(depth=100)
_N_IMAGES: Final = 5
"""Images of different noise, used in turn."""
_PUSH: Final = 1.0
"""Duration of a push, and of the rest before and after it [s]."""
_SPEED: Final = 0.06
"""Of the pushed objects [m/s]."""
_RADIUS: Final = 0.008
_NOISE: Final = np.array([5e-4, 5e-4, 5e-3])
"""Standard deviation of the poses [m, m, rad]."""


def small_box() -> SimObject:
    """A box of 60 x 48 mm, of which ten have room in view."""
    cells = 6e-3 * np.stack(np.meshgrid(np.arange(10) - 4.5, np.arange(8) - 3.5), axis=-1).reshape(-1, 2)
    n = len(cells)
    return SimObject("box", 6e-3, cells, np.full(n, 0.05), np.full(n, 0.4 / n), np.full(n, 0.3), 0.3)


def places(n: int) -> NDArray[np.float64]:
    """Poses of `n` objects at rest, at most ten, shape (n, 3)."""
    return np.array([[x, y, 0.3] for x in (-0.05, 0.07) for y in (-0.2, -0.1, 0.0, 0.1, 0.2)])[:n]


def object_ids(n: int) -> list[str]:
    """Names of the objects of `streams`."""
    return [f"load{i}" for i in range(n)]


class _Source(Node):
    """What both kinds have: a clock and counts."""

    def __init__(self) -> None:
        super().__init__("load_source")
        self.counts: Counter[str] = Counter()
        self._topics: dict[str, Any] = {}

    def send(self, topic: str, kind: type, qos: QoSProfile, msg: Any) -> None:
        """Publish and count."""
        if topic not in self._topics:
            self._topics[topic] = self.create_publisher(kind, topic, qos)
        self._topics[topic].publish(msg)
        self.counts[topic] += 1


def _camera(source: _Source, n: int) -> Callable[[float], None]:
    camera, noise, rng = DepthCamera(small_box(), CAMERA_POSE), DepthNoise(), np.random.default_rng(0)
    depth = np.fmin.reduce([camera.render(pose, {}) for pose in places(n)])
    frames = []
    for _ in range(_N_IMAGES):
        frame = DepthFrame(0.0, noise.apply(depth, rng).astype(np.float32), INTRINSICS)
        frames.append(depth_frame_to_msgs(frame, stamp_to_msg(0.0)))
    number = 0

    def step(now: float) -> None:
        nonlocal number
        number += 1
        image, info = frames[number % _N_IMAGES]
        image.header.stamp = info.header.stamp = stamp_to_msg(now)
        source.send("depth/camera_info", CameraInfo, qos_profile_sensor_data, info)
        source.send("depth/image_rect", Image, qos_profile_sensor_data, image)

    return step


def _streams(source: _Source, n: int) -> Callable[[float], None]:
    shape, rng, began = true_model(make_object("toolbox", 0)).shape, np.random.default_rng(0), time.time()
    start = float(shape.outline[:, 0].min()) - _RADIUS
    for name in object_ids(n):
        cells, outline = shape_to_msgs(shape, name, stamp_to_msg(began))
        source.send(f"objects/{name}/cells", OccupancyGrid, _LATCHED, cells)
        source.send(f"objects/{name}/outline", PolygonStamped, _LATCHED, outline)
    source.send("pusher/shape", SolidPrimitive, _LATCHED, cylinder_to_msg(_RADIUS, 0.1))
    covariance = np.diag(_NOISE**2)

    def step(now: float) -> None:
        number, since = divmod(now - began, 3 * _PUSH)
        travel = _SPEED * float(np.clip(since - _PUSH, 0.0, _PUSH))
        stamp = stamp_to_msg(now)
        for name in object_ids(n):
            pose = np.array([travel, 0.0, 0.0]) + _NOISE * rng.normal(size=3)
            source.send(f"objects/{name}/pose", PoseWithCovarianceStamped, _RELIABLE, planar_pose_to_msg(stamp, pose, covariance))
        source.send("joint_states", JointState, _RELIABLE, _joints(stamp))
        if 0.5 * _PUSH < since < 2.5 * _PUSH:
            # All pushes go the same way: only the load counts here.
            tool = np.array([start + travel, 0.002 * (number % 3), 0.0])
            source.send("pusher/pose", PoseStamped, _RELIABLE, position_to_msg(stamp, tool))
            source.send("pusher/wrench", WrenchStamped, _RELIABLE, force_to_msg(stamp, np.array([1.0, 0.0])))

    return step


def _joints(stamp: Any) -> JointState:
    msg = JointState(name=list(JOINT_NAMES), position=[0.1] * len(JOINT_NAMES))
    msg.header.stamp = stamp
    return msg


def main(kind: str, rates: list[float], n: int) -> int:
    """Publish until SIGTERM; SIGUSR1 goes on to the next rate [Hz]."""
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    source, stopped = _Source(), []
    signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
    signal.signal(signal.SIGINT, lambda *_: stopped.append(True))
    changed: list[bool] = []
    signal.signal(signal.SIGUSR1, lambda *_: changed.append(True))
    step = (_camera if kind == "camera" else _streams)(source, n)
    print("ready", flush=True)
    first = began = time.monotonic()
    ticks = late = 0
    rate = rates.pop(0)
    while not stopped:
        if changed and rates:
            changed.clear()
            rate, began, ticks = rates.pop(0), time.monotonic(), 0
        wait = began + ticks / rate - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        elif wait < -1.0:
            # A source that cannot keep its rate must not make up for it later.
            late += round(-wait * rate)
            ticks += round(-wait * rate)
        step(time.time())
        ticks += 1
    seconds = time.monotonic() - first
    print(json.dumps({"seconds": seconds, "left_out": late, **source.counts}), flush=True)
    source.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], [float(rate) for rate in sys.argv[2].split(",")], int(sys.argv[3])))
