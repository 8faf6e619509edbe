"""Latest pose and shape of every tracked object."""

from __future__ import annotations

import time
from typing import Any

from geometry_msgs.msg import PolygonStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import CallbackGroup
from rclpy.qos import qos_profile_sensor_data

from push_ident.errors import PlanningError
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.base.cell_node import LATCHED, CellNode
from push_ident.nodes.base.stamps import StampCheck
from push_ident.nodes.convert.messages import planar_pose_from_msg
from push_ident.nodes.input.discovery import ObjectTopics
from push_ident.nodes.input.shapes import ShapeInput
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushCode
from push_ident.types import Float64Array, ObjectShape

__all__ = ["TrackedObjects"]


class TrackedObjects:
    """Subscribes to pose, cells and outline of each object that appears."""

    def __init__(self, node: CellNode, callback_group: CallbackGroup) -> None:
        self._node = node
        self._group = callback_group
        self._stamps = StampCheck()
        self._shape_input = ShapeInput()
        self._poses: dict[str, tuple[float, Float64Array, Float64Array, float]] = {}
        self._shapes: dict[str, ObjectShape] = {}
        self._topics = ObjectTopics(node, self._subscribe, callback_group=callback_group)

    @property
    def ids(self) -> tuple[str, ...]:
        """Objects with pose and shape, sorted."""
        # Other threads add to both: `set` copies in one step.
        return tuple(sorted(set(self._poses) & set(self._shapes)))

    def get(self, object_id: str, max_age: float) -> TrackedObject:
        """The object, or the only one when `object_id` is empty.

        Raises PlanningError UNKNOWN_OBJECT when there is none, several, or the pose was received more than `max_age` [s] ago.
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
        return TrackedObject(object_id, self._shapes[object_id], stamp, pose, covariance)

    def outlines_of_others(self, object_id: str) -> list[Float64Array]:
        """Outlines of all other objects, table frame [m], each of shape (n_vertices, 2)."""
        return [transform_points(self._poses[other][1], self._shapes[other].outline) for other in self.ids if other != object_id]

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
        self._poses[object_id] = (stamp, pose, covariance, time.monotonic())

    def _on_shape(self, object_id: str, **part: Any) -> None:
        shape = self._shape_input.add(object_id, **part)
        if shape is not None:
            self._shapes[object_id] = shape
