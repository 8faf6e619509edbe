"""Between the table and its message."""

from __future__ import annotations

from typing import Final

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point32, PolygonStamped

from push_ident.errors import InputError
from push_ident.geometry.table import Table
from push_ident.limits import plain_text
from push_ident.nodes.convert import TABLE_FRAME, outline_from_msg

__all__ = ["TABLE_TOPIC", "table_from_msg", "table_to_msg"]

TABLE_TOPIC: Final = "workspace/table"
"""Latched: a source that knows the table publishes it once."""


def table_to_msg(table: Table, stamp: Time) -> PolygonStamped:
    """Corners of the table, counter-clockwise, in the frame `table`."""
    msg = PolygonStamped()
    msg.header.frame_id, msg.header.stamp = TABLE_FRAME, stamp
    msg.polygon.points = [Point32(x=float(x), y=float(y), z=0.0) for x, y in table.corners]
    return msg


def table_from_msg(msg: PolygonStamped) -> Table:
    """The table of a message.

    Raises:
        InputError: another frame, or corners that are no convex table.
    """
    if msg.header.frame_id != TABLE_FRAME:
        raise InputError(f"The table is in frame {plain_text(msg.header.frame_id)!r}, expected {TABLE_FRAME!r}; transform it first.")
    return Table(outline_from_msg(msg))
