"""Motions of the disc: actions that lead it from rest to rest along a line, and ways around the block.

The disc follows an action u as its controller says, 100 (u - p) - 20 v, in steps of 10 ms; nothing holds it back. So position and velocity
after a tick are linear in those before it and in u. A line of given length and number of ticks is driven by the actions of least change,
sum of (u_k - u_{k-1})^2, with which it ends at rest at its end.
"""

from __future__ import annotations

import heapq
from functools import lru_cache
from typing import Final

import numpy as np

from push_ident.geometry.outline import edge_normals, signed_distance
from push_ident.types import Float64Array
from push_ident_sim.studies.pusht.game import RADIUS, TICK, WORKSPACE

__all__ = ["actions", "way_around"]

_STIFFNESS, _DAMPING, _STEP = 100.0, 20.0, 0.01
"""Of the controller [1/s^2, 1/s], and its time step [s]."""
_SETTLING: Final = 2
"""Ticks beyond those at the mean speed: fewer than two cannot end at rest."""
_MARGIN: Final = 0.004
"""Between disc and block on ways around it [m]."""
_SAMPLES: Final = 0.004
"""Distance of places on a way at which the gap is measured [m]."""


def _tick() -> tuple[Float64Array, Float64Array]:
    """A and b of (p, v) after a tick = A (p, v) + b u."""
    one = np.array([[1.0, _STEP], [0.0, 1.0]]) @ np.array([[1.0, 0.0], [-_STIFFNESS * _STEP, 1.0 - _DAMPING * _STEP]])
    push = np.array([[1.0, _STEP], [0.0, 1.0]]) @ np.array([0.0, _STIFFNESS * _STEP])
    state, by_action = np.eye(2), np.zeros(2)
    for _ in range(round(TICK / _STEP)):
        state, by_action = one @ state, one @ by_action + push
    return state, by_action


@lru_cache
def _profile(n: int) -> Float64Array:
    """Actions of `n` ticks that move the disc by 1 from rest to rest, shape (n,)."""
    state, by_action = _tick()
    reach = np.array([np.linalg.matrix_power(state, n - 1 - k) @ by_action for k in range(n)]).T
    change = np.eye(n) - np.eye(n, k=-1)
    # At the end the last action is that of rest, too.
    weight = change.T @ change
    weight[-1, -1] += 1.0
    aim = np.zeros(n)
    aim[-1] = 1.0
    system = np.block([[weight, reach.T], [reach, np.zeros((2, 2))]])
    return np.asarray(np.linalg.solve(system, np.concatenate([aim, [1.0, 0.0]]))[:n])


def actions(start: Float64Array, end: Float64Array, speed: float) -> Float64Array:
    """Actions that lead a disc at rest along a line, to rest at its end, shape (n_ticks, 2) [m].

    `speed` is that of the mean, apart from two ticks to start and to stop [m/s].
    """
    n = int(np.ceil(float(np.linalg.norm(end - start)) / (speed * TICK))) + _SETTLING
    return np.asarray(start + _profile(n)[:, None] * (end - start))


def way_around(outline: Float64Array, start: Float64Array, end: Float64Array) -> list[Float64Array] | None:
    """Corners of the shortest way of the disc from `start` to `end`, shape (2,), that does not touch the block; None where there is none.

    `outline` is that of the block, shape (n_vertices, 2). A disc that touches it leaves it first. The last corner is `end`.
    """
    gap = RADIUS + _MARGIN
    first = _away(outline, start, gap)
    corners = _corners(outline, gap)
    x_min, x_max, y_min, y_max = WORKSPACE
    inside = (corners[:, 0] >= x_min) & (corners[:, 0] <= x_max) & (corners[:, 1] >= y_min) & (corners[:, 1] <= y_max)
    nodes = np.vstack([first, end, corners[inside]])
    known, queue, best = {0: (0.0, -1)}, [(0.0, 0)], set[int]()
    while queue:
        cost, here = heapq.heappop(queue)
        if here in best:
            continue
        best.add(here)
        if here == 1:
            break
        for there in range(1, len(nodes)):
            length = cost + float(np.linalg.norm(nodes[there] - nodes[here]))
            if there not in best and length < known.get(there, (np.inf, -1))[0] and _is_clear(outline, nodes[here], nodes[there], gap):
                known[there] = length, here
                heapq.heappush(queue, (length, there))
    if 1 not in known:
        return None
    way, node = [], 1
    while node > 0:
        way.append(nodes[node])
        node = known[node][1]
    return ([first] if np.linalg.norm(first - start) > 1e-6 else []) + way[::-1]


def _away(outline: Float64Array, place: Float64Array, gap: float) -> Float64Array:
    """The nearest place with a gap to the block, within the workspace as far as possible."""
    place = place.copy()
    for _ in range(10):
        distance = float(signed_distance(place[None], outline)[0])
        if distance >= gap - 1e-6:
            break
        d = 1e-5
        slope = np.array([float(signed_distance((place + step)[None], outline)[0]) - distance for step in d * np.eye(2)]) / d
        place = place + (gap - distance) * slope / max(float(np.linalg.norm(slope)), 1e-9)
    x_min, x_max, y_min, y_max = WORKSPACE
    return np.clip(place, [x_min, y_min], [x_max, y_max])


def _corners(outline: Float64Array, gap: float) -> Float64Array:
    """Places beside each vertex with a gap to both of its edges, a little further out than the gap asks for."""
    normal = edge_normals(outline)
    before = np.roll(normal, 1, axis=0)
    middle = normal + before
    return np.asarray(outline + 1.02 * gap * middle / (1.0 + np.sum(normal * before, axis=1))[:, None])


def _is_clear(outline: Float64Array, start: Float64Array, end: Float64Array, gap: float) -> bool:
    """Whether the disc can drive along a line with the gap, or with that of its start where a wall leaves less there."""
    length = float(np.linalg.norm(end - start))
    places = start + np.linspace(0.0, 1.0, max(2, int(np.ceil(length / _SAMPLES)) + 1))[:, None] * (end - start)
    distance = signed_distance(places, outline)
    return bool(np.all(distance >= min(gap, float(distance[0])) - 1e-4))
