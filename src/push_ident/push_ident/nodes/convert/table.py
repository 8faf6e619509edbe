"""Between the table and its message."""

from __future__ import annotations

from typing import Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point32, PolygonStamped
from std_msgs.msg import Header

from push_ident.errors import InputError
from push_ident.geometry.table import Table
from push_ident.limits import check_coordinates, plain_text
from push_ident.nodes.convert.messages import TABLE_FRAME, outline_from_msg
from push_ident.physics.overhang import TableEdge
from push_ident.types import Float64Array

TABLE_TOPIC: Final = "workspace/table"
"""Latched: a source that knows the table publishes it once."""
EDGE_TOPIC: Final = "workspace/edge"
"""Latched: the edge of the table in the latest goal that gave one, for nodes that know no table."""


def table_to_msg(table: Table, stamp: Time) -> PolygonStamped:
    """Corners of the table, counter-clockwise, in the frame `table`."""
    return _points_to_msg(table.corners, stamp)


def table_from_msg(msg: PolygonStamped) -> Table:
    """The table of a message. Raises InputError: another frame, or corners that are no convex table."""
    _check_frame(msg, "table")
    return Table(outline_from_msg(msg))


def edge_to_msg(edge: TableEdge, stamp: Time) -> PolygonStamped:
    """First and last point of an edge whose span is finite, with the table on the left, in the frame `table`."""
    return _points_to_msg(edge.ends, stamp)


def edge_from_msg(msg: PolygonStamped) -> TableEdge:
    """The edge of a message. Raises InputError: another frame, not two points, or points that are not finite or too near to each other."""
    _check_frame(msg, "edge")
    if len(msg.polygon.points) != 2:
        raise InputError(f"The edge has {len(msg.polygon.points)} points, expected two.")
    first, second = (np.array([point.x, point.y], dtype=np.float64) for point in msg.polygon.points)
    check_coordinates([first, second], "Edge of the table")
    return TableEdge.between(first, second)


def _points_to_msg(points: Float64Array, stamp: Time) -> PolygonStamped:
    msg = PolygonStamped(header=Header(stamp=stamp, frame_id=TABLE_FRAME))
    msg.polygon.points = [Point32(x=float(x), y=float(y), z=0.0) for x, y in points]
    return msg


def _check_frame(msg: PolygonStamped, what: str) -> None:
    if msg.header.frame_id != TABLE_FRAME:
        raise InputError(f"The {what} is in frame {plain_text(msg.header.frame_id)!r}, expected {TABLE_FRAME!r}; transform it first.")
