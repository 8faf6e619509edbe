"""The bag contract: which topic has which role, under any namespace."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from typing import Final

from push_ident.limits import LIMITS, Limit

_LARGE: Final = frozenset({"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "nav_msgs/msg/OccupancyGrid"})


@dataclass(frozen=True, slots=True)
class _Entry:
    name: str
    """Relative topic; `{id}` stands for the object id."""
    msgtype: str


class Role(Enum):
    """A role in the contract, with its default topic and message type."""

    DEPTH = _Entry("depth/image_rect", "sensor_msgs/msg/Image")
    CAMERA_INFO = _Entry("depth/camera_info", "sensor_msgs/msg/CameraInfo")
    CAMERA_ACCURACY = _Entry("depth/camera_accuracy", "geometry_msgs/msg/PoseWithCovarianceStamped")
    POSE = _Entry("objects/{id}/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
    CELLS = _Entry("objects/{id}/cells", "nav_msgs/msg/OccupancyGrid")
    OUTLINE = _Entry("objects/{id}/outline", "geometry_msgs/msg/PolygonStamped")
    OUTLINE_STD = _Entry("objects/{id}/outline_std", "std_msgs/msg/Float32MultiArray")
    PUSHER = _Entry("pusher/pose", "geometry_msgs/msg/PoseStamped")
    PUSHER_SHAPE = _Entry("pusher/shape", "shape_msgs/msg/SolidPrimitive")
    WRENCH = _Entry("pusher/wrench", "geometry_msgs/msg/WrenchStamped")
    PUSH_RECORD = _Entry("push_record", "push_ident_msgs/msg/PushRecord")
    TF_STATIC = _Entry("tf_static", "tf2_msgs/msg/TFMessage")

    @property
    def msgtype(self) -> str:
        """Message type, as `package/msg/Name`."""
        return self.value.msgtype


OBJECT_ROLES: Final = frozenset({Role.POSE, Role.CELLS, Role.OUTLINE, Role.OUTLINE_STD})
"""Roles that exist once per object."""

_ID: Final = r"(?P<id>[^/\r\n]+)"
_PATTERNS: Final = {role: re.compile(r"(?:^|/)" + re.escape(role.value.name).replace(r"\{id\}", _ID) + r"\Z") for role in Role}


@dataclass(frozen=True, slots=True)
class TopicRole:
    """Role of a recorded topic, and its object."""

    role: Role
    object_id: str = ""
    """Empty for the roles that belong to no object."""

    def __str__(self) -> str:
        return topic_of(self.role, self.object_id or "<id>")


def topic_of(role: Role, object_id: str = "") -> str:
    """Relative topic of a role, such as `objects/7/pose`."""
    name: str = role.value.name
    return name.replace("{id}", object_id)


def role_of(topic: str) -> TopicRole | None:
    """Role of a recorded topic by the end of its name, so any namespace fits; None for topics outside the contract."""
    for role, pattern in _PATTERNS.items():
        if match := pattern.search(topic):
            return TopicRole(role, match.groupdict().get("id") or "")
    return None


def size_limit(msgtype: str) -> Limit:
    """Of a message of this type [bytes]."""
    return LIMITS.MESSAGE if msgtype in _LARGE else LIMITS.SMALL_MESSAGE
