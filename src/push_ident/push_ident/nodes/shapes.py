"""Shapes of objects from two topics, cells and outline, that arrive in any order."""

from __future__ import annotations

from geometry_msgs.msg import PolygonStamped
from nav_msgs.msg import OccupancyGrid

from push_ident.nodes.convert import outline_from_msg, shape_from_msgs
from push_ident.types import ObjectShape

__all__ = ["ShapeInput"]


class ShapeInput:
    """Keeps the latest usable cells and outline of each object."""

    def __init__(self) -> None:
        self._cells: dict[str, OccupancyGrid] = {}
        self._outlines: dict[str, PolygonStamped] = {}

    def add(self, object_id: str, *, cells: OccupancyGrid | None = None, outline: PolygonStamped | None = None) -> ObjectShape | None:
        """The shape of the object with a new message of either topic; None while there are no cells.

        Raises InputError for a message that cannot be used, which then does not replace the one before.
        """
        if cells is not None:
            shape_from_msgs(cells)
            self._cells[object_id] = cells
        if outline is not None:
            outline_from_msg(outline)
            self._outlines[object_id] = outline
        return shape_from_msgs(self._cells[object_id], self._outlines.get(object_id)) if object_id in self._cells else None
