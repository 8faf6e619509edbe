"""Frames on /tf and /tf_static, with the topics and QoS of tf2_ros, which is not among the Python wheels of ROS."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from push_ident.bags.decode import homogeneous_of
from push_ident.geometry.frames import TABLE_FRAME
from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.limits import LIMITS
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.parameters import Parameter
from push_ident.types import Float64Array

PUBLISH_TF: Final = Parameter(
    "publish_tf", True, "Broadcast frames on /tf and /tf_static; false where another node gives them a parent", read_only=True
)
_MOVING_QOS: Final = QoSProfile(depth=100)
_STATIC_QOS: Final = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class MovingFrames:
    """Frames that move in `table`, on /tf."""

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(TFMessage, "/tf", _MOVING_QOS)

    def broadcast(self, stamp: Time, poses: Mapping[str, Pose]) -> None:
        """Publish where frames are at `stamp`, in one message."""
        self._publisher.publish(TFMessage(transforms=[_transform(stamp, TABLE_FRAME, name, pose) for name, pose in poses.items()]))


class StaticFrames:
    """Frames that stand still, on /tf_static: what others broadcast, and where in `table` this node knows one to be.

    A frame has one parent. Where another node gives it one, as the driver of a camera does to its optical frame, the root of that tree is
    placed in `table`; where that tree leads to `table` already, nothing is broadcast.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher: Publisher | None = None
        self._others: dict[str, tuple[str, Float64Array]] = {}
        self._placed: dict[str, tuple[Time, Float64Array]] = {}
        self._sent: deque[TransformStamped] = deque(maxlen=LIMITS.TRANSFORMS.value)
        self._latest: list[TransformStamped] = []
        node.create_subscription(TFMessage, "/tf_static", self._on_static, _STATIC_QOS)

    def __contains__(self, frame: str) -> bool:
        """Whether another node gives the frame a parent."""
        return frame in self._others

    def place(self, stamp: Time, frame: str, pose_in_table: Float64Array) -> None:
        """The frame is at this pose, homogeneous, shape (4, 4), in `table` from now on."""
        self._placed[frame.strip("/")] = (stamp, pose_in_table)
        self._broadcast()

    def _on_static(self, msg: TFMessage) -> None:
        LIMITS.TRANSFORMS.check(len(msg.transforms), "/tf_static")
        news = {}
        for stamped in msg.transforms:
            if stamped not in self._sent:
                parent, child = (name.strip("/") for name in (stamped.header.frame_id, stamped.child_frame_id))
                news[child] = (parent, homogeneous_of(stamped.transform))
        LIMITS.TRANSFORMS.check(len(self._others | news), "/tf_static")
        self._others |= news
        if news and self._placed:
            self._broadcast()

    def _root_of(self, frame: str) -> tuple[str, Float64Array]:
        """The first frame above this one that has no parent, and the pose of this one in it."""
        pose: Float64Array = np.eye(4)
        for _ in range(len(self._others)):  # a loop has no root; it is left where it closes
            if frame not in self._others:
                break
            frame, pose_in_parent = self._others[frame]
            pose = pose_in_parent @ pose
        return frame, pose

    def _broadcast(self) -> None:
        table_root, _ = self._root_of(TABLE_FRAME)
        found: dict[str, TransformStamped] = {}
        for frame, (stamp, pose_in_table) in self._placed.items():
            root, pose_in_root = self._root_of(frame)
            if root not in (table_root, TABLE_FRAME):
                found.setdefault(root, _transform(stamp, TABLE_FRAME, root, _pose_of(pose_in_table @ np.linalg.inv(pose_in_root))))
        if (transforms := list(found.values())) == self._latest:
            return
        self._latest = transforms
        self._sent.extend(transforms)
        if self._publisher is None:  # made with its first message: one that is silent would look like a fault
            self._publisher = self._node.create_publisher(TFMessage, "/tf_static", LATCHED)
        self._publisher.publish(TFMessage(transforms=transforms))


def _pose_of(matrix: Float64Array) -> Pose:
    """Of a homogeneous matrix, shape (4, 4)."""
    (x, y, z), turn = (float(value) for value in matrix[:3, 3]), quaternion_of_pose(matrix)
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(**dict(zip("xyzw", turn, strict=True))))


def _transform(stamp: Time, parent: str, child: str, pose: Pose) -> TransformStamped:
    msg = TransformStamped(header=Header(stamp=stamp, frame_id=parent), child_frame_id=child)
    at = msg.transform.translation
    at.x, at.y, at.z, msg.transform.rotation = pose.position.x, pose.position.y, pose.position.z, pose.orientation
    return msg
