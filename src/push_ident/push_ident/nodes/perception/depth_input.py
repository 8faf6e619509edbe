"""Depth frames of one camera: each image with the camera info that belongs to it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident.nodes.input.depth_pairs import DepthPairs
from push_ident.types import DepthFrame

__all__ = ["EVERY_IMAGE", "EVERY_POSE", "DepthInput"]

EVERY_IMAGE: Final = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
"""Of images of a source that waits: nothing is lost. The source sees to it that little is under way."""
EVERY_POSE: Final = QoSProfile(
    history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""Of the poses in these images: a node that discovers an object late gets its poses from the first one on."""


class DepthInput:
    """Subscribes to `depth/image_rect` and `depth/camera_info` below a prefix, with the QoS of sensors."""

    def __init__(
        self,
        node: CellNode,
        prefix: str,
        *,
        max_skew: Callable[[], float],
        on_frame: Callable[[DepthFrame, Time], None],
        refuse: Callable[[str, str], None],
        every_image: bool = False,
    ) -> None:
        """Subscribe.

        Args:
            prefix: Of the topics; empty, or such as `side/`.
            max_skew, on_frame, refuse: As of `DepthPairs`.
            every_image: Lose none, and publish the stamp of each image that is done: for a source that waits for this node.
        """
        self.image_topic = node.resolve_topic_name(f"{prefix}depth/image_rect")
        self.n_images = 0
        self.received = time.perf_counter()
        """When the latest image came, or this began to wait [s], receive time."""
        info_topic = f"{prefix}depth/camera_info"
        self._pairs = DepthPairs(node.resolve_topic_name(info_topic), max_skew=max_skew, on_frame=on_frame, refuse=refuse)
        qos = EVERY_IMAGE if every_image else qos_profile_sensor_data
        node.create_subscription(CameraInfo, info_topic, self._pairs.on_info, qos)
        self._progress = node.create_publisher(Time, f"~/{prefix}done_until", EVERY_IMAGE) if every_image else None
        self.arrivals = node.arrivals_of(f"{prefix}depth/image_rect")
        """What was lost because this node is slower than the camera."""
        node.create_subscription(Image, f"{prefix}depth/image_rect", self._on_image, qos, arrivals=self.arrivals)

    @property
    def silence(self) -> float:
        """Since the latest image [s]."""
        return time.perf_counter() - self.received

    def _on_image(self, image: Image) -> None:
        stamp_from_msg(image.header.stamp)  # one that cannot be refuses the message before it counts
        self.received = time.perf_counter()
        self.n_images += 1
        try:
            self._pairs.on_image(image)
        finally:
            if self._progress is not None:
                self._progress.publish(image.header.stamp)
