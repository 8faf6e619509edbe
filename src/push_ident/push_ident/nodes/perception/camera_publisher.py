"""What perception tells of its main camera."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.qos import QoSProfile

from push_ident.bags.contract import Role
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.convert.messages import camera_accuracy_to_msg, transform_to_msg
from push_ident.perception.pipeline import Perception
from push_ident.types import CameraAccuracy, Float64Array

__all__ = ["CameraPublisher"]


class CameraPublisher:
    """Publishes where the camera stands, and how well that is known, each when it changes.

    Args:
        node: the node of perception.
        latched: quality of service of both topics.
    """

    def __init__(self, node: CellNode, latched: QoSProfile) -> None:
        self._pose = node.create_publisher(PoseStamped, "depth/camera_pose", latched)
        self._accuracy = node.create_publisher(PoseWithCovarianceStamped, Role.CAMERA_ACCURACY.value.name, latched)
        self._published: tuple[Float64Array | None, CameraAccuracy | None] = (None, None)

    def publish(self, perception: Perception, stamp: Time) -> None:
        """Publish what differs from what was published last."""
        pose, accuracy = self._published
        if perception.camera_in_table is not pose:
            self._pose.publish(transform_to_msg(stamp, perception.camera_in_table))
        if perception.settings.camera_accuracy != accuracy:
            self._accuracy.publish(camera_accuracy_to_msg(perception.settings.camera_accuracy, stamp))
        self._published = perception.camera_in_table, perception.settings.camera_accuracy
