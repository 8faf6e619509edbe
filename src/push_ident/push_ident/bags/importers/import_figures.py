"""Figures of an import: where the pusher is while the object moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from push_ident.bags.importers.overlap import Overlap
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.pages.outline_chart import Placed, outline_panel
from push_ident.pages.time_chart import Line, time_chart
from push_ident.types import Float64Array

__all__ = ["overlap_figures"]

_Centre = Callable[[int], Float64Array]
_CIRCLE: Final = np.linspace(0.0, 2.0 * np.pi, 41)[:-1]


def overlap_figures(overlap: Overlap, most: int = 12) -> list[tuple[str, str]]:
    """Caption and drawing of the first pushes in the table frame, in the object frame, and over time. There is one frame at least.

    `most`: pushes that are drawn; with more, circles and outlines cover each other.
    """
    pushes = np.unique(overlap.push)[:most]
    n = len(np.unique(overlap.push))
    some = "" if n == len(pushes) else f" (the first {len(pushes)} of {n} pushes)"
    captions = (
        f"As the object begins to move, on the table: each circle, the pusher, should touch its outline{some}",
        f"The same in the object frame: the circles should lie against the outline, outside of it{some}",
        f"While the object moves, the distance of pusher and outline should stay in the green band{some}",
    )
    drawings = (
        _on_table(captions[0], overlap, pushes),
        _in_object_frame(captions[1], overlap, pushes),
        _over_time(captions[2], overlap, pushes),
    )
    return list(zip(captions, drawings, strict=True))


def _on_table(title: str, overlap: Overlap, pushes: Float64Array) -> str:
    placed = []
    for push in pushes:
        k = _first(overlap, push)
        text = f"object as push {push + 1:.0f} begins to move it"
        placed.append(Placed(transform_points(overlap.pose[k], overlap.shape.outline), "outline", text))
    for push in pushes:
        path = overlap.pusher[overlap.push == push]
        placed.append(Placed(path, "trace", f"path of the pusher while push {push + 1:.0f} moves the object", closed=False))
    return _panel(title, placed, overlap, pushes, lambda k: overlap.pusher[k])


def _in_object_frame(title: str, overlap: Overlap, pushes: Float64Array) -> str:
    def centre(k: int) -> Float64Array:
        return transform_points(inverse(overlap.pose[k]), overlap.pusher[k : k + 1])[0]

    return _panel(title, [Placed(overlap.shape.outline, "outline", "outline of the object")], overlap, pushes, centre)


def _panel(title: str, placed: list[Placed], overlap: Overlap, pushes: Float64Array, centre: _Centre) -> str:
    """What is placed already, and a circle for each push where `centre` has the pusher in a frame; one that is a point is seen as well."""
    first = [_first(overlap, push) for push in pushes]
    centres = np.array([centre(k) for k in first])
    every = np.vstack([*(one.corners for one in placed), centres - overlap.radius, centres + overlap.radius])
    frame = np.array([every.min(axis=0), every.max(axis=0)])
    radius = max(overlap.radius, 0.006 * float(np.max(frame[1] - frame[0])))
    circle = radius * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    for push, k, middle in zip(pushes, first, centres, strict=True):
        style = "meets" if abs(overlap.distance[k]) <= overlap.tolerance else "missed"
        text = f"pusher of push {push + 1:.0f}: {1e3 * overlap.distance[k]:.1f} mm from the outline"
        placed.append(Placed(middle + circle, style, text, label=f"{push + 1:.0f}"))
    return outline_panel(title, placed, frame)


def _over_time(title: str, overlap: Overlap, pushes: Float64Array) -> str:
    lines = []
    for push in pushes:
        own = overlap.push == push
        distance = 1e3 * overlap.distance[own]
        style = "trace" if abs(np.median(distance)) <= 1e3 * overlap.tolerance else "missed"
        lines.append(Line(overlap.time[own], distance, style, f"push {push + 1:.0f}: {np.median(distance):.1f} mm in the median"))
    return time_chart(
        title,
        lines,
        x_axis="since the object began to move [s]",
        y_axis="pusher to outline [mm], negative: inside",
        band=1e3 * overlap.tolerance,
    )


def _first(overlap: Overlap, push: float) -> int:
    """The first frame in which a push moves the object: one far before the next, by twice the median step, is noise."""
    own = np.flatnonzero(overlap.push == push)
    step = np.diff(overlap.time[own])
    return int(own[np.argmax(step <= 2.0 * np.median(step))]) if len(step) else int(own[0])
