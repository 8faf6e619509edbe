"""Objects of a cell: found by their topics, their shapes, and the latest pose and shape of each."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Any, Final

from geometry_msgs.msg import PolygonStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import Float32MultiArray

from push_ident.errors import PlanningError
from push_ident.geometry.se2 import transform_points
from push_ident.limits import LIMITS, plain_text
from push_ident.nodes.base.arrivals import StampCheck
from push_ident.nodes.base.cell_node import LATCHED, CellNode
from push_ident.nodes.convert.messages import outline_from_msg, outline_std_from_msg, planar_pose_from_msg, shape_from_msgs
from push_ident.planning.obstacle import Obstacle
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.pose_noise import PAUSE, PoseNoise
from push_ident.pushing.push import PushCode
from push_ident.types import Float64Array, ObjectShape

_POSE_TYPE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"


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


class ShapeInput:
    """Keeps the latest usable messages of each object: cells, outline and its deviations, which arrive in any order."""

    def __init__(self) -> None:
        self._parts: dict[str, dict[str, Any]] = {}

    def add(
        self,
        object_id: str,
        *,
        cells: OccupancyGrid | None = None,
        outline: PolygonStamped | None = None,
        outline_std: Float32MultiArray | None = None,
    ) -> ObjectShape | None:
        """The shape of the object with a new message of any of its topics; None while there are no cells.

        Raises InputError for a message that cannot be used, which then does not replace the one before.
        """
        parts = self._parts.setdefault(object_id, {})
        for name, msg, check in (
            ("cells", cells, shape_from_msgs),
            ("outline", outline, outline_from_msg),
            ("outline_std", outline_std, outline_std_from_msg),
        ):
            if msg is not None:
                check(msg)
                parts[name] = msg
        return shape_from_msgs(**parts) if "cells" in parts else None


class TrackedObjects:
    """Subscribes to pose, cells and outline of each object that appears.

    Args:
        is_pushing: whether an object may move now; in the other frames it rests, and these show the noise of poses without a covariance.
    """

    def __init__(self, node: CellNode, callback_group: CallbackGroup, is_pushing: Callable[[], bool] = lambda: False) -> None:
        self._is_pushing = is_pushing
        self._node = node
        self._group = callback_group
        self._stamps = StampCheck()
        self._shape_input = ShapeInput()
        self._poses: dict[str, tuple[float, Float64Array, Float64Array | None, float]] = {}
        self._noise: dict[str, PoseNoise] = {}
        self._lack_covariance: dict[str, str] = {}
        self._shapes: dict[str, ObjectShape] = {}
        self._topics = ObjectTopics(node, self._subscribe, callback_group=callback_group)

    @property
    def ids(self) -> tuple[str, ...]:
        """Objects with pose and shape, sorted."""
        # Other threads add to both: `set` copies in one step.
        return tuple(sorted(set(self._poses) & set(self._shapes)))

    @property
    def notes(self) -> dict[str, str]:
        """For diagnostics, of each object whose poses lack a covariance: what is taken for it, or what is missing."""
        return {f"covariance of {object_id}": text for object_id, text in list(self._lack_covariance.items())}

    def get(self, object_id: str, max_age: float) -> TrackedObject:
        """The object, or the only one when `object_id` is empty.

        Raises PlanningError UNKNOWN_OBJECT when there is none, several, the pose was received more than `max_age` [s] ago, or its
        covariance is not known yet.
        """
        known = ", ".join(self.ids) or "none (is perception running?)"
        if not object_id:
            if len(self.ids) != 1:
                raise PlanningError(PushCode.UNKNOWN_OBJECT, f"object_id is empty and the known objects are: {known}; name one.")
            object_id = self.ids[0]
        if object_id not in self.ids:
            raise PlanningError(PushCode.UNKNOWN_OBJECT, f"no object `{object_id}` with pose and cells; known: {known}.")
        stamp, pose, covariance, received = self._poses[object_id]
        age = time.monotonic() - received
        if age > max_age:
            raise PlanningError(PushCode.UNKNOWN_OBJECT, f"the pose of `{object_id}` was received {age:.1f} s ago, limit {max_age:.1f} s.")
        if covariance is None:
            why = f"`{object_id}`: {self._lack_covariance[object_id]}; wait, or publish covariances."
            raise PlanningError(PushCode.UNKNOWN_OBJECT, why)
        return TrackedObject(object_id, self._shapes[object_id], stamp, pose, covariance)

    def outlines_of_others(self, object_id: str) -> list[Float64Array]:
        """Outlines of all other objects, table frame [m], each of shape (n_vertices, 2)."""
        return [transform_points(self._poses[other][1], self._shapes[other].outline) for other in self.ids if other != object_id]

    def poses(self) -> dict[str, Float64Array]:
        """Latest pose of each object, table frame, shape (3,)."""
        return {object_id: self._poses[object_id][1] for object_id in self.ids}

    def obstacles(self, object_id: str = "") -> list[Obstacle]:
        """All objects but one, each with the clearance that its latest covariance asks for."""
        others = [other for other in self.ids if other != object_id]
        return [Obstacle.of_object(other, self._shapes[other].outline, *self._poses[other][1:3]) for other in others]

    def _subscribe(self, object_id: str) -> None:
        for kind, name, callback, qos in (
            (OccupancyGrid, "cells", lambda msg: self._on_shape(object_id, cells=msg), LATCHED),
            (PolygonStamped, "outline", lambda msg: self._on_shape(object_id, outline=msg), LATCHED),
            (PoseWithCovarianceStamped, "pose", lambda msg: self._on_pose(object_id, msg), qos_profile_sensor_data),
        ):
            self._node.create_subscription(kind, f"objects/{object_id}/{name}", callback, qos, callback_group=self._group)

    def _on_pose(self, object_id: str, msg: PoseWithCovarianceStamped) -> None:
        stamp, pose, covariance = planar_pose_from_msg(msg)
        self._stamps.check(object_id, stamp)
        noise = self._noise.setdefault(object_id, PoseNoise())
        noise.state(covariance)
        if noise.is_needed:
            noise.add(stamp, pose, moves=self._is_pushing(), pause=PAUSE)
            self._lack_covariance[object_id] = noise.text()
        self._poses[object_id] = (stamp, pose, noise.filled(covariance), time.monotonic())

    def _on_shape(self, object_id: str, **part: Any) -> None:
        shape = self._shape_input.add(object_id, **part)
        if shape is not None:
            self._shapes[object_id] = shape
