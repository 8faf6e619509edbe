"""An outline of as few straight edges and arcs as the noise of the camera allows.

A matcher of windows makes straight edges ragged, with teeth as long as a window. Each tooth that stays in an outline turns the direction in
which a pusher pushes there by some degrees, and that moves an object by more than an edge does that is displaced.

Neighbouring pieces are joined to one line or arc, those first that lose least, as long as the Bayesian information criterion gains by it:
-2 log likelihood may rise by ln n for each number that is saved, of which a line has two and an arc three (Schwarz, "Estimating the
Dimension of a Model", 1978). Deviations of the contour within a window are one measurement, so that n is the length of the outline in
windows. Arcs are fitted as by Kasa ("A circle fitting procedure and its error analysis", 1976).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.geometry.outline import line_crossing
from push_ident.geometry.shape_check import crossing_edges
from push_ident.types import Float64Array

_STEP: Final = 5e-4
"""Distance of the points of the contour [m]."""
_TURN: Final = 0.1
"""Turn from edge to edge of an arc [rad]: a pusher takes it for round."""


@dataclass(frozen=True, slots=True)
class _Piece:
    """A stretch of the contour, as a line or an arc."""

    points: Float64Array
    """Ends and the points between, in their order [m], shape (n, 2)."""
    windows: Float64Array
    """Share of a window that each stands for [-], shape (n,)."""
    weights: Float64Array
    """Of their squared distances [1/m^2], shape (n,)."""
    misfit: float
    """Twice the negative log likelihood of the points [-]."""
    numbers: int
    """By which it is described."""
    direction: Float64Array
    """Of the line, shape (2,)."""
    centre: Float64Array
    """A point of the line, or the centre of the arc [m], shape (2,)."""
    radius: float
    """Of the arc [m]; 0 for a line."""

    def nearest(self, point: Float64Array) -> Float64Array:
        """Its point nearest to another one."""
        away = point - self.centre
        if self.radius == 0.0:
            return np.asarray(self.centre + self.direction * (self.direction @ away))
        return np.asarray(self.centre + self.radius * away / max(float(np.linalg.norm(away)), 1e-12))

    def between(self, first: Float64Array, last: Float64Array) -> Float64Array:
        """The corners of its edges from one of its ends to the other, without these, shape (n, 2)."""
        if self.radius == 0.0:
            return np.empty((0, 2))
        around = np.unwrap(np.arctan2(*(self.points - self.centre).T[::-1]))
        begin, turn = np.arctan2(*(first - self.centre)[::-1]), around[-1] - around[0]
        end = begin + turn + np.angle(np.exp(1j * (np.arctan2(*(last - self.centre)[::-1]) - begin - turn)))
        angle = np.linspace(begin, end, max(1, int(np.ceil(abs(end - begin) / _TURN))) + 1)[1:-1]
        return np.asarray(self.centre + self.radius * np.column_stack([np.cos(angle), np.sin(angle)]))


def with_fewest_pieces(outline: Float64Array, noise: Float64Array, windows: Float64Array) -> Float64Array:
    """The outline, shape (n, 2), with edges joined that only noise tells apart; the outline itself where they would cross each other.

    Args:
        noise: Standard deviation of the points of each edge about what they show [m], shape (n,).
        windows: Length of each edge in windows of a matcher, within which deviations are the same [-], shape (n,).
    """
    if np.any(noise <= 0.0):
        return outline
    price, pieces = float(np.log(max(np.e, float(windows.sum())))), []
    for a, b, std, n_windows in zip(outline, np.roll(outline, -1, axis=0), noise, windows, strict=True):
        points = _points_of(a, b)
        share = np.full(len(points), n_windows / len(points))
        pieces.append(_piece(points, share, share / std**2, price))
    joined = [_joined(a, b, price) for a, b in zip(pieces, pieces[1:] + pieces[:1], strict=True)]
    while len(pieces) > 1:
        n = len(pieces)
        gain = [_cost(pieces[i], price) + _cost(pieces[(i + 1) % n], price) - _cost(joined[i], price) for i in range(n)]
        i = int(np.argmax(gain))
        if gain[i] < 0.0:
            break
        if i == n - 1:  # the contour begins anew where the last piece does
            pieces, joined = [pieces[-1], *pieces[:-1]], [joined[-1], *joined[:-1]]
            i = 0
        pieces[i : i + 2] = [joined[i]]
        del joined[i]
        for k in {i - 1, i % len(pieces)} if len(pieces) > 1 else ():
            joined[k] = _joined(pieces[k], pieces[(k + 1) % len(pieces)], price)
    polygon = _outline_of(pieces, float(np.median(noise)))
    return polygon if len(polygon) >= 3 and crossing_edges(polygon) is None else outline


def _points_of(a: Float64Array, b: Float64Array) -> Float64Array:
    """Points on an edge, evenly spaced, both ends among them, shape (n, 2)."""
    return np.linspace(a, b, max(2, round(float(np.linalg.norm(b - a)) / _STEP)) + 1)


def _cost(piece: _Piece, price: float) -> float:
    return piece.misfit + price * piece.numbers


def _joined(a: _Piece, b: _Piece, price: float) -> _Piece:
    points = np.vstack([a.points, b.points[1:]])
    return _piece(points, np.append(a.windows, b.windows[1:]), np.append(a.weights, b.weights[1:]), price)


def _piece(points: Float64Array, windows: Float64Array, weights: Float64Array, price: float) -> _Piece:
    """The line or the arc of some points, whichever costs less; an arc has at least as many windows as numbers."""
    middle = weights @ points / weights.sum()
    x, y = (points - middle).T
    values, vectors = np.linalg.eigh((points - middle).T @ (weights[:, None] * (points - middle)))
    line = _Piece(points, windows, weights, max(0.0, float(values[0])), 2, vectors[:, 1], middle, 0.0)
    if line.misfit <= price or windows.sum() < 3.0:
        return line
    root = np.sqrt(weights)
    a, b, c = np.linalg.lstsq(root[:, None] * np.column_stack([x, y, np.ones_like(x)]), root * (x * x + y * y))[0]
    centre = 0.5 * np.array([a, b])
    radius = float(np.sqrt(max(c + centre @ centre, 0.0)))
    misfit = float(weights @ (np.hypot(x - centre[0], y - centre[1]) - radius) ** 2)
    arc = _Piece(points, windows, weights, misfit, 3, vectors[:, 1], middle + centre, radius)
    return arc if _cost(arc, price) < _cost(line, price) else line


def _outline_of(pieces: list[_Piece], noise: float) -> Float64Array:
    """The polygon of some pieces, one after the other."""
    if len(pieces) == 1:
        whole = pieces[0]
        return np.vstack([whole.nearest(whole.points[0]), whole.between(whole.points[0], whole.points[-1])])
    corners = [_corner(before, piece, noise) for before, piece in zip(pieces[-1:] + pieces[:-1], pieces, strict=True)]
    ends = corners[1:] + corners[:1]
    parts = [(first, piece.between(first[-1], last[0])) for piece, first, last in zip(pieces, corners, ends, strict=True)]
    return np.vstack([part for both in parts for part in both])


def _corner(before: _Piece, after: _Piece, noise: float) -> Float64Array:
    """Where two pieces meet, shape (1, 2): where two lines cross, else between their points nearest to the end that they share; both of
    these, shape (2, 2), where they are further apart than noise puts them."""
    if before.radius == after.radius == 0.0:
        corner = line_crossing(before.centre, before.direction, after.centre, after.direction)
        if corner is not None:
            return corner[None]
    end = after.points[0]
    both = np.array([before.nearest(end), after.nearest(end)])
    return both if np.linalg.norm(both[1] - both[0]) > 2.0 * noise else both.mean(axis=0, keepdims=True)
