"""What a search for new and lost objects sees, worked out in parts over the frames that follow its own.

A search looks at the whole image, which takes longer than a fit of poses. It is of one frame and of what was known then; only its end, in
which lost objects are fitted again, is of the frame in which it ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.perception.contacts import Placed
from push_ident.perception.depth import points_in_table
from push_ident.perception.hollows import Covered, cover_hollows
from push_ident.perception.in_parts import InParts
from push_ident.perception.labels import ROBOT, TABLE, RobotPart, label_pixels
from push_ident.perception.segments import Segment, find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.shape import TracedObject
from push_ident.perception.table import TablePlane
from push_ident.perception.tracking import Template
from push_ident.types import DepthFrame, Float64Array

__all__ = ["N_PARTS", "Look", "Resting", "Seen", "look"]

N_PARTS = 3
"""Parts of a search: labels and hollows, segments, and what they are."""

Resting = tuple[TracedObject, Template, Float64Array]
"""An object at rest: how it is known, and its pose (x, y, yaw) [m, m, rad], table frame."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What stands on the table in one frame."""

    covered: Covered
    segments: list[Segment]
    counts: dict[str, int]
    """Of pixels `table`, `robot`, `object_pixels`, and of `segments`."""


@dataclass(frozen=True, slots=True)
class Look:
    """A search under way, with all that was known in its frame."""

    work: InParts[Seen]
    stamp: float
    """Of its frame [s]."""
    camera: Float64Array
    """Optical frame in the table frame, shape (4, 4)."""
    plane: TablePlane
    robot: tuple[RobotPart, ...]
    tracked: dict[str, Placed]
    """The objects that had a pose, by id."""
    at_rest: Mapping[str, Resting]
    """Those whose outlines this rest may show better, by id."""
    frames: tuple[DepthFrame, ...]
    """Frames of that rest."""


def look(frame: DepthFrame, camera: Float64Array, robot: Sequence[RobotPart], settings: PerceptionSettings) -> InParts[Seen]:
    """The segments of a frame; `camera`: optical frame in the table frame, shape (4, 4).

    Raises:
        FrameError: The size of the image differs from its camera info.
    """
    points = points_in_table(frame, camera)
    covered = cover_hollows(frame, points, label_pixels(points, robot, settings), camera, settings)
    yield
    segments, counts = find_segments(covered.frame, covered.points, covered.labels, settings)
    table, on_robot = (int(np.count_nonzero(covered.labels == label)) for label in (TABLE, ROBOT))
    yield
    return Seen(covered, segments, {"table": table, "robot": on_robot, **counts})
