"""Depth frames of a camera that runs now, for a command: an image topic and its camera info."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Final

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_topic_name import validate_topic_name
from sensor_msgs.msg import CameraInfo, Image

from push_ident.errors import FrameError, InputError, PushIdentError
from push_ident.limits import plain_text
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.network import RANGE
from push_ident.nodes.client.listen import start_ros
from push_ident.nodes.convert.messages import transform_from_msg
from push_ident.nodes.input.depth_pairs import DepthPairs
from push_ident.perception.frame.depth_image import ACCEPTED_ENCODINGS
from push_ident.types import DepthFrame, Float64Array

_IMAGE: Final = "sensor_msgs/msg/Image"
_INFO, _POSE = "camera_info", "camera_pose"
"""Last parts of the topics in the namespace of the image."""


class DepthCapture:
    """Listens to one camera, with the QoS of sensors. Use it as a context manager.

    The camera info is on the topic `camera_info` in the namespace of the image, as image_transport has it. A pose of the camera in the
    table frame that a running perception_node publishes on `camera_pose` there is kept.
    """

    def __init__(self, topic: str, *, seconds: float, on_progress: Callable[[str], None] = lambda line: None) -> None:
        """Start to listen.

        Args:
            seconds: Longest time until `frames` ends [s].
            on_progress: Called with a line of text when something is heard.

        Raises:
            InputError: The topic has no valid name.
            PushIdentError: ROS does not start.
        """
        self.camera_in_table: Float64Array | None = None
        """Pose of the optical frame, shape (4, 4); None until one is published."""
        self._seconds, self._on_progress = seconds, on_progress
        self._frames: deque[DepthFrame] = deque()
        self._n_images = self._n_infos = 0
        self._refused: list[tuple[str, str]] = []
        """Kind and reason of each."""
        self._encoding = self._wrong_pose = ""
        start_ros(signal_handler_options=SignalHandlerOptions.NO)
        try:
            self._node = Node("push_ident_look", enable_rosout=False, start_parameter_services=False)
            self._executor = SingleThreadedExecutor()
            self._executor.add_node(self._node)
            self._subscribe(topic)
        except BaseException:
            self._close()
            raise

    def __enter__(self) -> DepthCapture:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._close()

    def _close(self) -> None:
        self._executor.shutdown(timeout_sec=0.5)
        self._node.destroy_node()
        rclpy.try_shutdown()

    def _subscribe(self, topic: str) -> None:
        try:
            validate_topic_name(topic)
            self.topic = self._node.resolve_topic_name(topic)
        except InvalidTopicNameException as error:
            raise InputError(f"Topic {plain_text(topic)!r} is not a name that ROS allows: {' '.join(str(error).split())}.") from None
        beside, _, last = self.topic.rpartition("/")
        if last in (_INFO, _POSE):
            raise InputError(f"{self.topic} is the topic of what belongs to the images, expected that of the images beside it.")
        self.info_topic = f"{beside}/{_INFO}"
        self._pairs = DepthPairs(self.info_topic, on_frame=self._on_frame, refuse=self._refuse)
        self._node.create_subscription(CameraInfo, self.info_topic, self._on_info, qos_profile_sensor_data)
        self._node.create_subscription(PoseStamped, f"{beside}/{_POSE}", self._on_pose, LATCHED)
        self._node.create_subscription(Image, self.topic, self._on_image, qos_profile_sensor_data)

    def frames(self) -> Iterator[DepthFrame]:
        """Frames as they come, until the time is over; the caller stops when it has enough.

        Raises:
            InputError: Nobody publishes such images, several do, or no usable image with its info came in time.
            FrameError: The images have an encoding that is no depth.
        """
        deadline = time.monotonic() + self._seconds
        n_frames = 0
        self._on_progress(f"listening to {self.topic}")
        while time.monotonic() < deadline:
            try:
                self._executor.spin_once(timeout_sec=0.05)  # so soon Ctrl-C or another publisher is noticed
            except PushIdentError as error:  # such as a stamp that cannot be
                self._refuse("", str(error))
            self._check_publishers()
            if self._encoding:
                raise FrameError(
                    f"{self.topic} has images of encoding {plain_text(self._encoding)!r}, expected one of "
                    f"{', '.join(ACCEPTED_ENCODINGS)}; give the topic of the depth images. {self._other_topics()}"
                )
            while self._frames:
                n_frames += 1
                self._on_progress(f"{self.topic}: {n_frames} depth images")
                yield self._frames.popleft()
        if n_frames == 0:
            raise InputError(self._why_nothing())

    @property
    def notes(self) -> list[str]:
        """What was left out so far, one line each."""
        n = len(self._refused)
        refused = f"{n} of {self._n_images} images are not usable and left out; the first: {self._refused[0][1]}" if n else ""
        return [note for note in (refused, self._wrong_pose) if note]

    def _on_image(self, image: Image) -> None:
        self._n_images += 1
        if image.encoding not in ACCEPTED_ENCODINGS:
            self._encoding = image.encoding or "(none)"
            return
        self._pairs.on_image(image)

    def _on_info(self, info: CameraInfo) -> None:
        self._n_infos += 1
        self._pairs.on_info(info)

    def _on_pose(self, msg: PoseStamped) -> None:
        try:
            self.camera_in_table = transform_from_msg(msg)
        except InputError as error:
            self._wrong_pose = f"the published pose of the camera is not used: {error}"

    def _on_frame(self, frame: DepthFrame, stamp: Time) -> None:
        del stamp
        self._frames.append(frame)

    def _refuse(self, kind: str, why: str) -> None:
        self._refused.append((kind, why))

    def _check_publishers(self) -> None:
        """Raises InputError where others than one camera publish on the topic."""
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        kinds = sorted({info.topic_type for info in publishers} - {_IMAGE})
        if kinds:
            raise InputError(f"{self.topic} has messages of type {kinds[0]}, expected {_IMAGE}. {self._other_topics()}")
        if len(publishers) > 1:
            names = ", ".join(_name_of(info.node_namespace, info.node_name) for info in publishers)
            raise InputError(
                f"{len(publishers)} publishers send images on {self.topic} ({plain_text(names)}), expected one camera; stop all but one. "
                "A node that was killed is listed until its lease ends, some 20 s."
            )

    def _why_nothing(self) -> str:
        topic, within = self.topic, f"within {self._seconds:g} s"
        if self._node.count_publishers(self.topic) == 0:
            return f"{topic} has no publisher {within}; start the camera, or give the topic of its depth images. {self._other_topics()}"
        if self._n_images == 0:
            return f"{topic} has a publisher, but no image came {within}; see the log of the camera's driver."
        if self._n_infos == 0:
            n = self._node.count_publishers(self.info_topic)
            return (
                f"{self._n_images} images came on {topic}, but no camera info on {self.info_topic} ({n} publishers) {within}, "
                "expected sensor_msgs/msg/CameraInfo with each image; start it in the camera's driver, or remap it there."
            )
        self._pairs.end_wait()
        reasons = dict(self._refused)
        kinds = [kind for kind, _ in self._refused]
        why = reasons[max(reasons, key=kinds.count)] if reasons else "none has arrived whole"  # the last image may only lack its info yet
        return f"None of {self._n_images} images on {topic} is usable {within}: {why}"

    def _other_topics(self) -> str:
        topics = sorted(
            name for name, kinds in self._node.get_topic_names_and_types() if _IMAGE in kinds and self._node.count_publishers(name)
        )
        others = [name for name in topics if name != self.topic]
        if others:
            return plain_text(f"Topics with images: {', '.join(others)}.")
        domain = os.environ.get("ROS_DOMAIN_ID", "0, as it is not set")
        return f"No other topic has images; check ROS_DOMAIN_ID ({domain}) and {RANGE} ({os.environ.get(RANGE, 'not set')})."


def _name_of(namespace: str, name: str) -> str:
    """Of a node; rmw gives a name with UNKNOWN until its participant is discovered as well."""
    return "not known yet" if "UNKNOWN" in name else f"{namespace.rstrip('/')}/{name}"
