"""Find the tracked objects by the topics on which they are published."""

from __future__ import annotations

import re
from collections.abc import Callable

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from push_ident.limits import LIMITS, plain_text

__all__ = ["ObjectTopics"]

_POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"


class ObjectTopics:
    """Watches the ROS graph for `objects/<id>/pose` in the namespace of a node.

    Polled each second of wall time, since the graph changes whether or not simulated time runs.
    """

    def __init__(self, node: Node, on_new_object: Callable[[str], None], *, callback_group: CallbackGroup | None = None) -> None:
        """`on_new_object` is called once with the id of each object, as soon as its pose is published."""
        self._node = node
        self._on_new_object = on_new_object
        self._pattern = re.compile(re.escape(node.resolve_topic_name("objects")) + r"/([^/]+)/pose")
        self._ids: set[str] = set()
        node.create_timer(1.0, self.poll, callback_group=callback_group, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.poll()

    @property
    def ids(self) -> tuple[str, ...]:
        """Every object discovered so far, sorted."""
        return tuple(sorted(self._ids))

    def poll(self) -> None:
        """Check now instead of at the next second."""
        for topic, types in self._node.get_topic_names_and_types():
            match = self._pattern.fullmatch(topic)
            if match is None or _POSE_TYPE not in types or match[1] in self._ids or self._node.count_publishers(topic) == 0:
                continue
            if len(self._ids) >= LIMITS.OBJECTS.value or len(match[1]) > LIMITS.OBJECT_ID.value:
                self._node.get_logger().warning(
                    f"{plain_text(topic)} is ignored: more objects, or a longer name, than the suite takes", throttle_duration_sec=60.0
                )
                continue
            self._ids.add(match[1])
            self._on_new_object(match[1])
