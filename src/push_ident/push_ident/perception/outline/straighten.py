"""Straight edges and sharp corners for a traced outline.

A contour traced in depth images has errors of half a millimetre over a few millimetres of length. That is a small distance, but it turns
the normal by ten degrees, and the normal is the direction of the contact force. Where the contour is straight within its noise, a line is
fitted; where two lines meet, their corner, which tracing rounds off, is restored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from push_ident.geometry.outline import polygon_area
from push_ident.types import Float64Array

__all__ = ["straighten"]

_COARSE: Final = 0.0016
"""Distance within which a stretch of contour may be straight [m]."""
_FINE: Final = 0.0007
"""Largest distance of the result from the contour where it is not straight [m]."""
_ROUNDED: Final = 0.0025
"""Length beside a corner that tracing rounds off [m]."""
_SHORTEST: Final = 0.008
"""Shorter stretches give no line [m]."""
_BOW: Final = 0.0006
"""Largest height of the arc of a stretch that counts as straight [m]; up to `_COARSE` where it bends inwards. An edge traced in two parts
at an angle has a dent there, in which a simulated pusher gets caught; a shallow hollow that becomes an edge hardly changes a contact."""
_RESTORED: Final = 0.004
"""Largest distance of a restored corner from the contour [m]."""
_PARALLEL: Final = 0.25
"""Two lines whose angle has a smaller sine have no corner."""
_SAME_POINT: Final = 1e-6
"""Points closer than this are one [m]: far above rounding, far below what a camera sees."""


@dataclass(frozen=True, slots=True)
class _Line:
    point: Float64Array
    direction: Float64Array

    def nearest(self, points: Float64Array) -> Float64Array:
        """Feet of the perpendiculars from one point, shape (2,), or several, shape (n, 2)."""
        return np.asarray(self.point + np.multiply.outer((points - self.point) @ self.direction, self.direction))


@dataclass(frozen=True, slots=True)
class _Stretch:
    """A run of contour points between two corners of the coarse outline."""

    points: Float64Array
    line: _Line | None


def straighten(contour: Float64Array) -> Float64Array:
    """Outline with straight edges where the contour is straight.

    Args:
        contour: closed, dense (points well below a millimetre apart) [m], shape (n, 2); either orientation, kept.

    Returns:
        Polygon, shape (n_vertices, 2), without edges of no length.
    """
    corners = _simplified(contour, _COARSE)
    if len(corners) < 3:
        return contour[_simplified(contour, _FINE)]
    ends = np.append(corners[1:], corners[0] + len(contour))
    inwards = 1.0 if polygon_area(contour) > 0.0 else -1.0
    runs = [np.take(contour, np.arange(a, b + 1), axis=0, mode="wrap") for a, b in zip(corners, ends, strict=True)]
    stretches = _without_chamfers(_merged([_stretch(run, inwards) for run in runs], inwards))
    vertices: list[Float64Array] = []
    for here, following in zip(stretches, stretches[1:] + stretches[:1], strict=True):
        if here.line is None:
            inner = here.points[_open_simplified(here.points)]
            vertices.extend(inner[1:-1])
        vertices.extend(_joint(here, following))
    outline = np.array(vertices)
    # Two stretches may end in the same point, or, by rounding, next to it; an edge without a length has no normal.
    outline = outline[np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1) > _SAME_POINT]
    return outline if len(outline) >= 3 else contour[_simplified(contour, _FINE)]


def _simplified(contour: Float64Array, tolerance: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Indices of the corners that are kept, ascending."""
    # approxPolyDP returns points, not indices; a unique index is found again by the point itself.
    kept = cv2.approxPolyDP(contour.astype(np.float32)[:, None], tolerance, True)[:, 0]
    index = {tuple(point): number for number, point in enumerate(contour.astype(np.float32).tolist())}
    return np.array(sorted(index[tuple(point)] for point in kept.tolist()), dtype=np.int64)


def _open_simplified(points: Float64Array) -> list[int]:
    """Indices of the corners that are kept of an open run, both ends included, ascending."""
    kept = cv2.approxPolyDP(points.astype(np.float32)[:, None], _FINE, False)[:, 0]
    index = {tuple(point): number for number, point in enumerate(points.astype(np.float32).tolist())}
    return sorted({0, len(points) - 1} | {index[tuple(point)] for point in kept.tolist()})


def _stretch(points: Float64Array, inwards: float) -> _Stretch:
    """Fit a line to a run of points if it is straight. `inwards` is 1 where the inside lies to the left of the contour, else -1."""
    arc_length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    inner = points[(arc_length >= _ROUNDED) & (arc_length <= arc_length[-1] - _ROUNDED)]
    if arc_length[-1] < _SHORTEST or len(inner) < 5:
        return _Stretch(points, None)
    middle = inner.mean(axis=0)
    direction = np.linalg.svd(inner - middle, full_matrices=False)[2][0]
    direction = direction if direction @ (points[-1] - points[0]) > 0 else -direction
    along = (inner - middle) @ direction
    across = (inner - middle) @ np.array([-direction[1], direction[0]])
    half = 0.5 * float(np.ptp(along))
    bow = inwards * float(np.polyfit(along / half, across, 2)[0])
    return _Stretch(points, _Line(middle, direction) if -_COARSE <= bow <= _BOW else None)


def _merged(stretches: list[_Stretch], inwards: float) -> list[_Stretch]:
    """Join neighbours that form one straight stretch: the coarse outline may break an edge where the contour is noisiest."""
    i = 0
    while len(stretches) > 3 and i < len(stretches):
        here, following = stretches[i], stretches[(i + 1) % len(stretches)]
        joined = _stretch(np.concatenate([here.points, following.points[1:]]), inwards)
        if joined.line is None or np.max(np.linalg.norm(joined.points - joined.line.nearest(joined.points), axis=1)) > _COARSE:
            i += 1
        elif i + 1 < len(stretches):
            stretches = [*stretches[:i], joined, *stretches[i + 2 :]]
        else:
            stretches = [joined, *stretches[1:-1]]
    return stretches


def _without_chamfers(stretches: list[_Stretch]) -> list[_Stretch]:
    """Drop short stretches between two lines whose corner lies beside them: tracing rounded that corner off."""
    n = len(stretches)
    kept = []
    for i, here in enumerate(stretches):
        before, after = stretches[i - 1].line, stretches[(i + 1) % n].line
        corner = _crossing(before, after) if here.line is None and before is not None and after is not None else None
        if corner is None or np.min(np.linalg.norm(here.points - corner, axis=1)) > _RESTORED:
            kept.append(here)
    return kept if len(kept) >= 3 else stretches


def _joint(here: _Stretch, following: _Stretch) -> list[Float64Array]:
    """Vertices where one stretch ends and the next begins."""
    end, begin = here.points[-1], following.points[0]
    if here.line is None and following.line is None:
        return [end]
    if here.line is None or following.line is None:
        line = here.line or following.line
        assert line is not None
        return [line.nearest(end if here.line is not None else begin)]
    corner = _crossing(here.line, following.line)
    if corner is not None and min(np.linalg.norm(corner - end), np.linalg.norm(corner - begin)) <= _RESTORED:
        return [corner]
    return [here.line.nearest(end), following.line.nearest(begin)]


def _crossing(a: _Line | None, b: _Line | None) -> Float64Array | None:
    """Where two lines cross; None where they are nearly parallel."""
    if a is None or b is None:
        return None
    sine = a.direction[0] * b.direction[1] - a.direction[1] * b.direction[0]
    if abs(sine) < _PARALLEL:
        return None
    between = b.point - a.point
    return np.asarray(a.point + (between[0] * b.direction[1] - between[1] * b.direction[0]) / sine * a.direction)
