"""Perception's occupancy of the workspace as a node of goals uses it: what stands beside the tracked objects."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Final

from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import CallbackGroup

from push_ident.nodes.base.cell_node import LATCHED, CellNode
from push_ident.nodes.convert.messages import workspace_from_msg
from push_ident.nodes.input.objects import TrackedObjects
from push_ident.planning.obstacle import Obstacle
from push_ident.planning.untracked import UntrackedThings

TOPIC: Final = "workspace/occupancy"


class OccupancyInput:
    """Subscribes to the occupancy; a message that cannot be used does not replace the one before.

    Args:
        workspace: of the tool, as of `UntrackedThings`.
    """

    def __init__(self, node: CellNode, callback_group: CallbackGroup, objects: TrackedObjects, workspace: Sequence[float]) -> None:
        x_min, x_max, y_min, y_max = workspace
        self._objects, self._things, self._lock = objects, UntrackedThings((x_min, x_max, y_min, y_max)), threading.Lock()
        node.create_subscription(OccupancyGrid, TOPIC, self._on_grid, LATCHED, callback_group=callback_group)

    def beside(self, object_id: str) -> list[Obstacle]:
        """What an object must not touch: the other objects, and what belongs to none."""
        with self._lock:
            return self._objects.obstacles(object_id) + self._things.obstacles(self._objects.obstacles())

    def _on_grid(self, msg: OccupancyGrid) -> None:
        grid = workspace_from_msg(msg)
        with self._lock:
            self._things.take(grid, self._objects.poses(), self._objects.obstacles())
