"""What the camera sees now, for whoever draws on its picture."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from push_ident.nodes.convert.messages import transform_from_msg
from push_ident.nodes.input.depth_pairs import MAX_SKEW, DepthPairs
from push_ident.types import DepthFrame, Float64Array

__all__ = ["CameraView"]

_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class CameraView:
    """Keeps the latest depth frame and the pose of its camera, as perception publishes it.

    Args:
        node: whose executor handles the messages.
    """

    def __init__(self, node: Node) -> None:
        self.frame: DepthFrame | None = None
        self.camera_in_table: Float64Array | None = None
        """Pose of the optical frame, shape (4, 4)."""
        info_topic = node.resolve_topic_name("depth/camera_info")
        pairs = DepthPairs(info_topic, max_skew=lambda: MAX_SKEW, on_frame=self._on_frame, refuse=lambda kind, why: None)
        node.create_subscription(CameraInfo, info_topic, pairs.on_info, qos_profile_sensor_data)
        node.create_subscription(Image, "depth/image_rect", pairs.on_image, qos_profile_sensor_data)
        node.create_subscription(PoseStamped, "depth/camera_pose", self._on_pose, _LATCHED)

    def _on_frame(self, frame: DepthFrame, stamp: Time) -> None:
        del stamp
        self.frame = frame

    def _on_pose(self, msg: PoseStamped) -> None:
        self.camera_in_table = transform_from_msg(msg)
