"""What perception refused, as markers for RViz, Foxglove and the viewer."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from push_ident.errors import InputError
from push_ident.limits import LIMITS, check_coordinates, plain_text
from push_ident.nodes.convert.marker import MARKERS, marker
from push_ident.nodes.convert.messages import TABLE_FRAME
from push_ident.perception.refusals import Refusal
from push_ident.types import Float64Array

__all__ = ["refusals_from_msg", "refusals_to_msg"]

_COLOUR: Final = ColorRGBA(r=0.84, g=0.37, b=0.0, a=1.0)


def refusals_to_msg(refusals: Iterable[Refusal], stamp: Time) -> MarkerArray:
    """Outline and reason of each; they replace the earlier ones."""
    markers = [marker(stamp, "refused", Marker.LINE_STRIP, _COLOUR)]
    markers[0].action = Marker.DELETEALL
    for number, refusal in enumerate(refusals):
        line = marker(stamp, "refused", Marker.LINE_STRIP, _COLOUR, number)
        line.scale.x = MARKERS.refusal_line
        line.points = [Point(x=float(x), y=float(y), z=float(refusal.height)) for x, y in [*refusal.outline, refusal.outline[0]]]
        text = marker(stamp, "refused_because", Marker.TEXT_VIEW_FACING, _COLOUR, number)
        text.scale.z, text.text = MARKERS.letter, refusal.why
        text.pose.position.x, text.pose.position.y = (float(value) for value in refusal.outline.mean(axis=0))
        text.pose.position.z = float(refusal.height + MARKERS.letter)
        markers += [line, text]
    return MarkerArray(markers=markers)


def refusals_from_msg(msg: MarkerArray) -> list[tuple[Float64Array, str]]:
    """Outline [m], shape (n, 3), table frame, and reason of each.

    Raises:
        InputError: Another frame, too many, or coordinates that are not on a table.
    """
    LIMITS.POINTS.check(sum(len(item.points) for item in msg.markers) + len(msg.markers), "Refusals")
    lines: dict[int, Float64Array] = {}
    words: dict[int, str] = {}
    for item in msg.markers:
        if item.action != Marker.ADD:
            continue
        if item.header.frame_id != TABLE_FRAME:
            raise InputError(f"A refusal is in frame {plain_text(item.header.frame_id)}, expected {TABLE_FRAME}.")
        if item.type == Marker.LINE_STRIP and len(item.points) > 1:
            lines[item.id] = np.array([(point.x, point.y, point.z) for point in item.points])
            check_coordinates(lines[item.id], "Outline of a refusal")
        elif item.type == Marker.TEXT_VIEW_FACING:
            words[item.id] = plain_text(item.text)
    return [(line, words.get(number, "")) for number, line in lines.items()]
