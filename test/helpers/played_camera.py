"""A depth camera that a test plays before perception_node, and that node."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.context import Context
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from visualization_msgs.msg import MarkerArray

from helpers.depth_scene import HAMMER, Prism, circle, look_at, rectangle, render
from helpers.paths import CONFIG
from push_ident.nodes.convert.messages import (
    depth_frame_to_msgs,
    position_to_msg,
    stamp_to_msg,
)
from push_ident.types import DepthFrame

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SIDE = look_at((0.0, -0.6, 0.8), (0.0, 0.0, 0.0))
POSE = np.array([0.03, -0.02, 0.4])
SECOND, THIRD = np.array([-0.03, 0.05, 1.0]), np.array([-0.09, -0.02, 1.6])
"""Where it rests later."""
PARAMETERS = CONFIG / "push_ident.yaml"
TOOL = np.array([-0.15, 0.15, 0.004])


class Camera(Node):
    """Publishes depth of a hammer at rest beside the lowered tool; keeps what comes back."""

    def __init__(self, context: Context) -> None:
        super().__init__("camera", context=context)
        rng = np.random.default_rng(0)
        scene = [prism.at(POSE) for prism in HAMMER] + [Prism(circle(0.018) + TOOL[:2], 0.11, TOOL[2])]
        self.frames = [render(scene, rng=rng) for _ in range(4)]
        over_the_border = Prism(rectangle(-0.1, 0.36, -0.02, 0.44), 0.04)
        self.with_more = [render([*scene, over_the_border], rng=rng) for _ in range(4)]
        self.images = self.create_publisher(Image, "depth/image_rect", qos_profile_sensor_data)
        self.infos = self.create_publisher(CameraInfo, "depth/camera_info", qos_profile_sensor_data)
        self.tool = self.create_publisher(PoseStamped, "tool/pose", 10)
        self.cells: list[OccupancyGrid] = []
        self.outlines: list[PolygonStamped] = []
        self.poses: list[PoseWithCovarianceStamped] = []
        self.workspace: list[OccupancyGrid] = []
        self.refused: list[MarkerArray] = []
        self.diagnostics: list[DiagnosticArray] = []
        self.accuracies: list[PoseWithCovarianceStamped] = []
        for kind, topic, kept, qos in (
            (OccupancyGrid, "objects/o1/cells", self.cells, LATCHED),
            (PolygonStamped, "objects/o1/outline", self.outlines, LATCHED),
            (PoseWithCovarianceStamped, "objects/o1/pose", self.poses, 10),
            (OccupancyGrid, "workspace/occupancy", self.workspace, LATCHED),
            (MarkerArray, "workspace/refused", self.refused, LATCHED),
            (DiagnosticArray, "/diagnostics", self.diagnostics, 10),
            (PoseWithCovarianceStamped, "depth/camera_accuracy", self.accuracies, LATCHED),
        ):
            self.create_subscription(kind, topic, kept.append, qos)
        self.further: list[tuple[Publisher, Publisher, list[DepthFrame]]] = []
        self.stamp = 100.0
        self._n = 0

    def add(self, name: str, frames: list[DepthFrame]) -> None:
        """Publish the frames of a further camera as well."""
        images = self.create_publisher(Image, f"{name}/depth/image_rect", qos_profile_sensor_data)
        infos = self.create_publisher(CameraInfo, f"{name}/depth/camera_info", qos_profile_sensor_data)
        self.further.append((images, infos, frames))

    def send(self, *, change: Callable[[Image, CameraInfo], None] | None = None, info_first: bool = False) -> float:
        self.stamp += 1 / 15
        self._n += 1
        stamp = stamp_to_msg(self.stamp)
        image, info = depth_frame_to_msgs(self.frames[self._n % len(self.frames)], stamp)
        info.header = type(info.header)(stamp=stamp, frame_id=info.header.frame_id)
        if change is not None:
            change(image, info)
        self.tool.publish(position_to_msg(stamp, TOOL))
        for images, infos, frames in self.further:
            for publisher, msg in zip((images, infos), depth_frame_to_msgs(frames[self._n % len(frames)], stamp), strict=True):
                publisher.publish(msg)
        for publisher, msg in ((self.infos, info), (self.images, image)) if info_first else ((self.images, image), (self.infos, info)):
            publisher.publish(msg)
        return self.stamp

    def values(self) -> dict[str, str]:
        return {value.key: value.value for msg in self.diagnostics[-1:] for value in msg.status[0].values}


def wait_for(condition: Callable[[], object], timeout: float = 60.0) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.005)


def send_until(camera: Camera, condition: Callable[[], object], **how: object) -> None:
    deadline = time.monotonic() + 120.0  # the node may have to start first
    while not condition():
        assert time.monotonic() < deadline, camera.values()
        camera.send(**how)  # type: ignore[arg-type]
        time.sleep(1 / 15)
