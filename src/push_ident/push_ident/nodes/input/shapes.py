"""Shapes of objects from their topics, cells, outline and its deviations, that arrive in any order."""

from __future__ import annotations

from geometry_msgs.msg import PolygonStamped
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Float32MultiArray

from push_ident.nodes.convert.messages import outline_from_msg, outline_std_from_msg, shape_from_msgs
from push_ident.types import ObjectShape

__all__ = ["ShapeInput"]


class ShapeInput:
    """Keeps the latest usable messages of each object."""

    def __init__(self) -> None:
        self._cells: dict[str, OccupancyGrid] = {}
        self._outlines: dict[str, PolygonStamped] = {}
        self._deviations: dict[str, Float32MultiArray] = {}

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
        if cells is not None:
            shape_from_msgs(cells)
            self._cells[object_id] = cells
        if outline is not None:
            outline_from_msg(outline)
            self._outlines[object_id] = outline
        if outline_std is not None:
            outline_std_from_msg(outline_std)
            self._deviations[object_id] = outline_std
        if object_id not in self._cells:
            return None
        return shape_from_msgs(self._cells[object_id], self._outlines.get(object_id), self._deviations.get(object_id))
