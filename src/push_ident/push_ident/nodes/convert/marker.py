"""What markers for RViz, Foxglove and the viewer have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from builtin_interfaces.msg import Time
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from push_ident.geometry.frames import TABLE_FRAME

__all__ = ["MARKERS", "MarkerSettings", "marker"]


@dataclass(frozen=True, slots=True)
class MarkerSettings:
    """Sizes of what is drawn [m]."""

    goal_line: float = 0.003
    """Width of outlines and paths of a goal."""
    refusal_line: float = 0.002
    """Width of outlines of what perception refuses."""
    letter: float = 0.015
    """Height of text."""
    cell: float = 0.004
    """Thickness of the cells of an object above the table."""
    n_path_points: int = 500
    """Of a path at most: 1 mm apart on one of half a metre."""


MARKERS: Final = MarkerSettings()


def marker(stamp: Time, name: str, kind: int, colour: ColorRGBA, number: int = 0) -> Marker:
    """A marker in the frame `table`, to be added; `kind` is a type of visualization_msgs/Marker."""
    msg = Marker(ns=name, id=number, type=kind, action=Marker.ADD, color=colour, header=Header(stamp=stamp, frame_id=TABLE_FRAME))
    msg.pose.orientation.w = 1.0
    return msg
