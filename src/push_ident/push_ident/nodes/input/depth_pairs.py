"""Depth images of a camera, each with the camera info that belongs to it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Final

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from push_ident.errors import PushIdentError
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.convert.messages import depth_frame_from_msgs, stamp_from_msg
from push_ident.types import DepthFrame

_NEAREST, _NEIGHBOUR = 0.5, 1.5
"""Periods of the camera info [-]: no other info can be nearer to an image; and where its own one was lost, that of the image before or
after it is as near, with half a period of jitter."""


class DepthPairs:
    """Finds the camera info of each image.

    It may arrive before or after its image; one without a stamp is of a camera that never changes. Where it was lost, its neighbour is
    taken. The limits follow from the period of the infos, as their stamps show it; before there are two, stamps must be equal.
    """

    def __init__(
        self,
        info_topic: str,
        *,
        on_frame: Callable[[DepthFrame, Time], None],
        refuse: Callable[[str, str], None],
        max_skew: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Begin without any.

        Args:
            info_topic: For texts.
            max_skew: Largest difference of the stamps of an image and its info in force [s]; 0: by the period of the infos.
            on_frame: Called with each frame and the stamp of its image; a PushIdentError raised there refuses the frame.
            refuse: Called with a key for diagnostics and the reason, for each image that comes to nothing.
        """
        self._info_topic = info_topic
        self._max_skew, self._on_frame, self._refuse = max_skew, on_frame, refuse
        self._infos: deque[tuple[float, CameraInfo]] = deque(maxlen=10)
        """With their stamps [s]."""
        self._unpaired: Image | None = None

    def on_info(self, info: CameraInfo) -> None:
        """Take a camera info."""
        self._infos.append((stamp_from_msg(info.header.stamp), info))
        self._pair(_NEAREST)

    def on_image(self, image: Image) -> None:
        """Take an image; one whose info has not come waits for it, until the next image comes."""
        stamp_from_msg(image.header.stamp)  # one that cannot be refuses the message before it counts
        self.end_wait()
        self._unpaired = image
        self._pair(_NEAREST)

    def end_wait(self) -> None:
        """Take the image that still waits with the info of its neighbour, or refuse it."""
        if self._unpaired is None or self._pair(_NEIGHBOUR):
            return
        stamp, self._unpaired = stamp_from_msg(self._unpaired.header.stamp), None
        if not self._infos:
            self._refuse("dropped_without_info", f"no camera info on {self._info_topic} yet; start the camera driver")
            return
        skew, limit = min(_skew(stamp, at) for at, _ in self._infos), self._limit(_NEIGHBOUR)
        self._refuse(
            "dropped_skew", f"depth image and nearest camera info are {skew * 1e3:.0f} ms apart, expected at most {limit * 1e3:.0f} ms"
        )

    def _limit(self, periods: float) -> float:
        """Largest difference of stamps [s]."""
        steps = np.diff(np.unique([at for at, _ in self._infos if at]))
        return self._max_skew() or (periods * float(np.median(steps)) if len(steps) else 0.0)

    def _pair(self, periods: float) -> bool:
        """Take the image that waits with the nearest info within so many periods; whether there is one."""
        if self._unpaired is None or not self._infos:
            return False
        stamp = stamp_from_msg(self._unpaired.header.stamp)
        skew, info = min(((_skew(stamp, at), info) for at, info in self._infos), key=lambda pair: pair[0])
        if skew > self._limit(periods):
            return False
        image, self._unpaired = self._unpaired, None
        self._take(image, info)
        return True

    def _take(self, image: Image, info: CameraInfo) -> None:
        try:
            self._on_frame(depth_frame_from_msgs(image, info), image.header.stamp)
        except PushIdentError as error:
            self._refuse("frames_refused", str(error))


def _skew(stamp: float, at: float) -> float:
    return abs(stamp - at) if at else 0.0


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
