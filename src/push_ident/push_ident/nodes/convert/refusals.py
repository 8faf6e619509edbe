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
from push_ident.nodes.convert.messages import TABLE_FRAME
from push_ident.perception.refusals import Refusal
from push_ident.types import Float64Array

__all__ = ["refusals_from_msg", "refusals_to_msg"]

_COLOUR: Final = ColorRGBA(r=0.84, g=0.37, b=0.0, a=1.0)
_LINE: Final = 0.002
"""Width of an outline [m]."""
_LETTER: Final = 0.015
"""Height of the text [m]."""


def refusals_to_msg(refusals: Iterable[Refusal], stamp: Time) -> MarkerArray:
    """Outline and reason of each, in place of all that were shown before."""
    markers = [_marker(stamp, 0, Marker.LINE_STRIP)]
    markers[0].action = Marker.DELETEALL
    for number, refusal in enumerate(refusals):
        line = _marker(stamp, number, Marker.LINE_STRIP)
        line.scale.x = _LINE
        line.points = [Point(x=float(x), y=float(y), z=float(refusal.height)) for x, y in [*refusal.outline, refusal.outline[0]]]
        text = _marker(stamp, number, Marker.TEXT_VIEW_FACING)
        text.ns, text.scale.z, text.text = "refused_because", _LETTER, refusal.why
        text.pose.position.x, text.pose.position.y = (float(value) for value in refusal.outline.mean(axis=0))
        text.pose.position.z = float(refusal.height + _LETTER)
        markers += [line, text]
    return MarkerArray(markers=markers)


def refusals_from_msg(msg: MarkerArray) -> list[tuple[Float64Array, str]]:
    """Outline [m], shape (n, 3), table frame, and reason of each.

    Raises:
        InputError: Another frame, too many, or coordinates that are not on a table.
    """
    LIMITS.POINTS.check(sum(len(marker.points) for marker in msg.markers) + len(msg.markers), "Refusals")
    lines: dict[int, Float64Array] = {}
    words: dict[int, str] = {}
    for marker in msg.markers:
        if marker.action != Marker.ADD:
            continue
        if marker.header.frame_id != TABLE_FRAME:
            raise InputError(f"A refusal is in frame {plain_text(marker.header.frame_id)}, expected {TABLE_FRAME}.")
        if marker.type == Marker.LINE_STRIP and len(marker.points) > 1:
            lines[marker.id] = np.array([(point.x, point.y, point.z) for point in marker.points])
            check_coordinates(lines[marker.id], "Outline of a refusal")
        elif marker.type == Marker.TEXT_VIEW_FACING:
            words[marker.id] = plain_text(marker.text)
    return [(line, words.get(number, "")) for number, line in lines.items()]


def _marker(stamp: Time, number: int, kind: int) -> Marker:
    marker = Marker(ns="refused", id=number, type=kind, action=Marker.ADD, color=_COLOUR)
    marker.header.frame_id, marker.header.stamp = TABLE_FRAME, stamp
    marker.pose.orientation.w = 1.0
    return marker
