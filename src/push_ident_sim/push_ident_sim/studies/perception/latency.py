"""How long perception takes from a depth image to the pose, measured between processes.

This process plays a camera: rendered frames of a sliding object, 640 x 480 at 30 Hz, with time stamps. `perception_node` runs as a
process of its own, held to one core. The clock starts before an image is published and stops when the pose with its stamp arrives
here, so that it includes transport in both directions.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from typing import Final

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from push_ident.errors import PerceptionError
from push_ident.nodes.convert.messages import depth_frame_to_msgs, stamp_from_msg, stamp_to_msg
from push_ident.types import DepthFrame
from push_ident_sim.cell.camera import DepthCamera, DepthNoise
from push_ident_sim.objects import make_object
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.live_nodes import processor_time
from push_ident_sim.studies.common.seeing import CAMERA_POSE, RATE, views_of_pushes

__all__ = ["measure_latency"]

_WARM_UP: Final = 90
"""Frames before the measurement."""
_PATIENCE: Final = 20.0
"""For the first pose [s]."""


class _Player(Node):
    """Publishes frames forwards and backwards at the camera's rate; records when the poses arrive."""

    def __init__(self, context: Context, frames: list[tuple[Image, CameraInfo]]) -> None:
        super().__init__("latency_player", context=context)
        self._frames = [*frames, *frames[-2:0:-1]]
        self._images = self.create_publisher(Image, "depth/image_rect", qos_profile_sensor_data)
        self._infos = self.create_publisher(CameraInfo, "depth/camera_info", qos_profile_sensor_data)
        self.create_subscription(PoseWithCovarianceStamped, "objects/o1/pose", self._on_pose, 100)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.sent: dict[int, float] = {}
        self.arrived: dict[int, float] = {}
        self.said: dict[str, str] = {}

    def send(self, number: int) -> None:
        image, info = self._frames[number % len(self._frames)]
        # Whole milliseconds, so that the stamp returns unchanged.
        stamp = stamp_to_msg(1.0 + round(1000 * number / RATE) / 1000)
        image.header.stamp = info.header.stamp = stamp
        self._infos.publish(info)
        self.sent[number] = time.perf_counter()
        self._images.publish(image)

    def _on_pose(self, msg: PoseWithCovarianceStamped) -> None:
        now = time.perf_counter()
        self.arrived[round((stamp_from_msg(msg.header.stamp) - 1.0) * RATE)] = now

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        self.said = {value.key: value.value for value in msg.status[0].values}


def measure_latency(object_name: str, seed: int, n_frames: int = 900) -> Json:
    """Play so many frames and measure.

    Returns:
        `n_frames`, `n_poses`, `median_s`, `p99_s`, `worst_s`, `cpu_per_frame_s` of the perception process for each pose, and `load`, the
        processes that wanted to run meanwhile.

    Raises:
        PerceptionError: No pose came.
    """
    frames = _frames(object_name, seed)
    context = Context()
    domain = random.randint(1, 100)
    rclpy.init(context=context, domain_id=domain)
    player = _Player(context, frames)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(player)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    cores = sorted(os.sched_getaffinity(0))
    node = subprocess.Popen(
        [sys.executable, "-m", "push_ident.nodes", "perception_node"],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.sched_setaffinity(node.pid, {cores[-1]})
    try:
        return _measured(player, node.pid, n_frames)
    finally:
        node.send_signal(signal.SIGINT)
        try:
            node.wait(3.0)
        except subprocess.TimeoutExpired:
            node.kill()
        executor.shutdown()
        thread.join(2.0)
        player.destroy_node()
        context.try_shutdown()


def _measured(player: _Player, pid: int, n_frames: int) -> Json:
    start, number, first_pose_at = time.perf_counter(), 0, None
    cpu_at_start = 0.0
    while first_pose_at is None or number < first_pose_at + _WARM_UP + n_frames:
        player.send(number)
        number += 1
        if first_pose_at is None and player.arrived:
            first_pose_at = number
        if first_pose_at is None and time.perf_counter() - start > _PATIENCE:
            raise PerceptionError(
                f"No pose within {_PATIENCE:.0f} s of images; perception reports: {player.said.get('why_no_pose', 'nothing')}."
            )
        if first_pose_at is not None and number == first_pose_at + _WARM_UP:
            cpu_at_start = processor_time(pid)
        time.sleep(max(0.0, start + number / RATE - time.perf_counter()))
    time.sleep(0.3)
    assert first_pose_at is not None
    begin = first_pose_at + _WARM_UP
    delays = np.array([player.arrived[n] - player.sent[n] for n in range(begin, number) if n in player.arrived])
    if len(delays) == 0:
        raise PerceptionError("No pose came during the measurement; the object was lost.")
    return {
        "n_frames": number - begin,
        "n_poses": len(delays),
        "median_s": round(float(np.median(delays)), 5),
        "p99_s": round(float(np.quantile(delays, 0.99)), 5),
        "worst_s": round(float(delays.max()), 5),
        "cpu_per_frame_s": round((processor_time(pid) - cpu_at_start) / len(delays), 5),
        "load": round(os.getloadavg()[0], 2),
    }


def _frames(object_name: str, seed: int) -> list[tuple[Image, CameraInfo]]:
    rng = np.random.default_rng(seed)
    camera, noise = DepthCamera(make_object(object_name, seed), CAMERA_POSE), DepthNoise()
    views = views_of_pushes(rng)
    return [
        depth_frame_to_msgs(DepthFrame(0.0, noise.apply(camera.render(view.pose, {}), rng), camera.intrinsics), stamp_to_msg(0.0))
        for view in views
    ]
