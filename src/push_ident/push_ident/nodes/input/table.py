"""Where the table ends: from a parameter of the node, from the topic `workspace/table`, and from the edges that goals give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from geometry_msgs.msg import PolygonStamped
from rclpy.callback_groups import CallbackGroup

from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points
from push_ident.geometry.table import Table
from push_ident.nodes.base.cell_node import LATCHED, CellNode
from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.convert.table import EDGE_TOPIC, TABLE_TOPIC, edge_from_msg, table_from_msg
from push_ident.physics.overhang import TableEdge
from push_ident.types import PushRecord

CORNERS: Final = Parameter(
    "table_corners",
    [0.0],
    "corners of the convex table top in `table`, x, y of one after the other [m]; [0.0]: as the topic workspace/table says, if anything",
    -100.0,
    100.0,
    any_length=True,
)
_UNKNOWN: Final = [0.0]


def table_of_corners(values: Sequence[float]) -> Table | None:
    """The table of the parameter; None where it is not set. Raises InputError for corners that are no table."""
    if list(values) == _UNKNOWN:
        return None
    if len(values) % 2:
        raise InputError(
            f"table_corners has {len(values)} numbers, expected x and y of each corner, as in [-0.8, -0.7, 0.8, -0.7, 0, 0.7]."
        )
    return Table(np.reshape(values, (-1, 2)))


class TableInput:
    """The table that a node knows; a message that cannot be used does not replace the one before.

    Args:
        node: with the parameter `CORNERS`, which comes before what is published.
        callback_group: of the subscription; None: that of the node.
    """

    def __init__(self, node: CellNode, callback_group: CallbackGroup | None = None) -> None:
        self._node = node
        self._published: Table | None = None
        self._edge: TableEdge | None = None
        for topic, callback in ((TABLE_TOPIC, self._on_table), (EDGE_TOPIC, self._on_edge)):
            node.create_subscription(PolygonStamped, topic, callback, LATCHED, callback_group=callback_group)

    def get(self) -> Table | None:
        """The table; None where its edges are unknown."""
        return table_of_corners(self._node.settings[CORNERS.name]) or self._published

    def beyond(self, record: PushRecord) -> float:
        """How far an object reached beyond the table during a push [m], or beyond the edge that the latest goal gave, between its ends;
        negative on the table, and where its edges are unknown."""
        points = transform_points(record.poses.pose, record.shape.outline).reshape(-1, 2)
        table, edge = self.get(), self._edge
        over = -np.inf if table is None else table.beyond(points)
        if edge is not None:
            along = points @ edge.along
            within_span = points[(along >= edge.span[0]) & (along <= edge.span[1])]
            over = max(over, float(np.max(edge.beyond(within_span), initial=-np.inf)))
        return float(over)

    def _on_table(self, msg: PolygonStamped) -> None:
        self._published = table_from_msg(msg)

    def _on_edge(self, msg: PolygonStamped) -> None:
        self._edge = edge_from_msg(msg)
