"""A better outline of a known object from several views of it at rest, in other places and headings.

What one view cannot show, another one does: an edge that a matcher displaces behind the object and not in front of it, a part in the
shadow of a higher part, the raggedness of every edge. The views are brought together in the object frame, which stays what it was in
the first of them. Unknown are the offset of each edge along its normal and the pose in every further view; all are fitted to the lines
of sight at once. The outline is traced anew from all views at these poses, and fitted again.

What all views have in common stays: an object that a matcher makes wider by a pixel on its far side is wider in each view. For sides in
pairs that is, in any heading, the same object grown by half a pixel, and only a push can tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.geometry.outline import edge_normals
from push_ident.geometry.se2 import inverse, rotation, transform_points
from push_ident.perception.known_object import Refined, SegmentedView, Template, TracedObject
from push_ident.perception.outline.edges import (
    SAME_CURVE,
    VARIANCE,
    EdgeLines,
    dense,
    lines_near_edges,
    scatter_of,
    with_edges_moved,
    without_reversed,
)
from push_ident.perception.outline.tracing import InParts, straighten, trace_in_parts
from push_ident.types import Float64Array, ObjectShape

__all__ = ["DISPLACED", "RestView", "refine"]

DISPLACED: Final = 1.5
"""Deviation of the mean position of edges that were measured from several headings, in units of the scatter about it [-]. In models of a
Kinect and of two RealSense the displacement is 1.2 to 1.4 of them; that of the models is an estimate itself."""

_PRIOR_FROM_MEAN: Final = 0.002
"""Prior standard deviation of the offset of an edge from the mean offset [m]: a pixel on the table."""
_PRIOR_POSE: Final = np.array([0.003, 0.003, 0.03])
"""Prior standard deviations of the pose in a view about the tracked one [m, m, rad]: tracked with an outline of that error."""
_SMOOTH: Final = 0.0005
"""Standard deviation of the difference of the offsets of neighbouring edges of one curve [m]."""
_CORRELATED: Final = 0.02
"""Lines of sight so near to each other along an edge share what displaces it [m]: a window of a matcher is 7 to 9 px, 10 to 20 mm."""
_LEAST_SCATTER: Final = 0.00015
"""Least scatter of edges [m]: of an exact camera, from folds and corners that the model of lines of sight does not have."""
_ITERATIONS: Final = 4
_LARGEST_STEP: Final = 0.003
"""Largest change of an offset in one iteration [m]: where the model of the lines of sight is linear."""


@dataclass(frozen=True, slots=True)
class RestView:
    """A known object at rest in the image of one camera."""

    segmented: SegmentedView
    pose: Float64Array
    """(x, y, yaw) of the object in `table`, to some millimetres [m, m, rad]."""
    rest: int
    """Number of the rest: the object has one pose in all views of a rest."""

    def in_object(self, pose: Float64Array) -> SegmentedView:
        """The segmented view with the object frame at `pose` as its table frame, without the robot."""
        motion, back, view = np.eye(4), inverse(pose), self.segmented.view
        motion[:2, :2], motion[:2, 3] = rotation(back[2]), back[:2]
        return replace(self.segmented, view=replace(view, camera_in_table=motion @ view.camera_in_table, robot=()))


@dataclass(slots=True)
class _State:
    """The unknowns of a fit."""

    outline: Float64Array
    moved: Float64Array
    """Offset of each edge so far [m]."""
    poses: list[Float64Array]
    """In each view."""
    std: Float64Array
    """Standard deviations of the offsets [m]."""
    scatter: float = np.inf
    """Of the edges about the outline, before the last step [m]."""
    misfit: float = np.inf
    """The same in the latest rest."""


def refine(traced: TracedObject, views: Sequence[RestView], *, min_height: float) -> InParts[Refined]:
    """The object as all views show it; its frame is that of the first rest, at the pose of that view.

    Args:
        min_height: Anything lower is table [m].

    Raises:
        PerceptionError: No outline can be traced from the views.
    """
    state = _begin(np.array(traced.shape.outline), [view.pose for view in views])
    yield from _fit(state, traced, views, moves_edges=False)
    before = state.misfit
    yield from _fit(state, traced, views)
    again = yield from trace_in_parts(
        [view.in_object(pose) for view, pose in zip(views, state.poses, strict=True)],
        min_height=min_height,
        cell_count=len(traced.shape.cells),
    )
    origin = again.pose[:2]
    again = replace(again, pose=traced.pose, top_origin=again.top_origin + origin)
    state = _begin(again.shape.outline + origin, state.poses)
    yield from _fit(state, again, views)
    straight = straighten(dense(state.outline))
    state = _begin(straight if len(straight) >= 3 else state.outline, state.poses)
    # The first turn moves no edge, so that the deviations are those of the edges that remain.
    yield from _fit(state, again, views, moves_edges=False)
    std = np.hypot(state.std, DISPLACED * state.scatter)
    shape = ObjectShape(traced.shape.cells, state.outline, std)
    again = replace(again, shape=shape, camera_positions=_camera_positions(views, state.poses), displaced_std=traced.displaced_std)
    return Refined(again, tuple(state.poses), views[-1].segmented.segment.area, state.misfit, before)


def _begin(outline: Float64Array, poses: Sequence[Float64Array]) -> _State:
    return _State(outline, np.zeros(len(outline)), list(poses), np.zeros(len(outline)))


def _fit(state: _State, traced: TracedObject, views: Sequence[RestView], *, moves_edges: bool = True) -> InParts[None]:
    """Gauss-Newton for the offsets of the edges and the poses of all rests but the first one."""
    for _ in range(_ITERATIONS if moves_edges else 2):
        n = len(state.outline)
        template = Template(replace(traced, shape=ObjectShape(traced.shape.cells, state.outline)))
        lines = []
        for view, pose in zip(views, state.poses, strict=True):
            yield
            lines.append(lines_near_edges(template, state.outline, view.segmented.view, pose))
        state.scatter = float(np.hypot(scatter_of(lines), _LEAST_SCATTER))
        latest = [near for near, view in zip(lines, views, strict=True) if view.rest == views[-1].rest]
        state.misfit = float(np.hypot(scatter_of(latest), _LEAST_SCATTER))
        normal, gradient = _sums(state, lines, views)
        if not moves_edges:
            free = slice(n, None)
            step = np.concatenate([np.zeros(n), np.linalg.solve(normal[free, free], gradient[free])])
        else:
            step = np.linalg.solve(normal, gradient)
        state.std = np.sqrt(np.diag(np.linalg.inv(normal))[:n])
        moves = np.vstack([np.zeros(3), step[n:].reshape(-1, 3)])
        state.poses = [pose + moves[rest] for rest, pose in zip(_rests(views), state.poses, strict=True)]
        if moves_edges:
            offset = np.clip(step[:n], -_LARGEST_STEP, _LARGEST_STEP)
            state.outline, state.moved = without_reversed(state.outline, with_edges_moved(state.outline, offset), state.moved + offset)


def _rests(views: Sequence[RestView]) -> list[int]:
    """Of each view the number of its rest, counted from 0."""
    numbers = list(dict.fromkeys(view.rest for view in views))
    return [numbers.index(view.rest) for view in views]


def _camera_positions(views: Sequence[RestView], poses: Sequence[Float64Array]) -> tuple[Float64Array, ...]:
    """Of the cameras in each rest [m], shapes (n, 2), object frame."""
    positions: dict[int, list[Float64Array]] = {}
    for view, pose in zip(views, poses, strict=True):
        camera = view.segmented.view.camera_in_table[None, :2, 3]
        positions.setdefault(view.rest, []).append(transform_points(inverse(pose), camera)[0])
    return tuple(np.array(in_rest) for in_rest in positions.values())


def _sums(state: _State, lines: Sequence[EdgeLines], views: Sequence[RestView]) -> tuple[Float64Array, Float64Array]:
    """J'WJ and J'Wr with their priors, of the offsets and then of the poses."""
    n, rests = len(state.outline), _rests(views)
    normal, gradient = np.zeros((n + 3 * max(rests),) * 2), np.zeros(n + 3 * max(rests))
    normals = edge_normals(state.outline)
    length = np.linalg.norm(np.roll(state.outline, -1, axis=0) - state.outline, axis=1)
    diagonal = np.arange(n)
    for rest, near, view, pose in zip(rests, lines, views, state.poses, strict=True):
        information = np.bincount(near.edge, np.square(near.slope), minlength=n) / VARIANCE
        shared = np.square(state.scatter) * _CORRELATED / np.maximum(length, 1e-4)
        weight = (1.0 / (VARIANCE * (1.0 + information * shared)))[near.edge]
        normal[diagonal, diagonal] += np.bincount(near.edge, weight * np.square(near.slope), minlength=n)
        gradient[:n] += np.bincount(near.edge, weight * near.slope * near.residual, minlength=n)
        if rest == 0:
            continue
        outward, points = normals[near.edge], near.points
        by_turn = outward[:, 1] * points[:, 0] - outward[:, 0] * points[:, 1]
        by_pose = near.slope[:, None] * np.column_stack([outward @ rotation(pose[2]).T, by_turn])
        at = slice(n + 3 * (rest - 1), n + 3 * rest)
        normal[at, at] += by_pose.T @ (weight[:, None] * by_pose) + np.diag(1.0 / _PRIOR_POSE**2)
        gradient[at] += by_pose.T @ (weight * near.residual) + (view.pose - pose) / _PRIOR_POSE**2
        cross = np.stack([np.bincount(near.edge, weight * near.slope * column, minlength=n) for column in by_pose.T])
        normal[at, :n] += cross
        normal[:n, at] += cross.T
    _add_prior_of_offsets(normal, gradient, state)
    return normal, gradient


def _add_prior_of_offsets(normal: Float64Array, gradient: Float64Array, state: _State) -> None:
    """No edge is far from where it was, unless all are; edges of one curve move together."""
    n = len(state.outline)
    normal[:n, :n] += (np.eye(n) - 1.0 / n) / _PRIOR_FROM_MEAN**2
    gradient[:n] -= (state.moved - state.moved.mean()) / _PRIOR_FROM_MEAN**2
    edge = np.roll(state.outline, -1, axis=0) - state.outline
    heading = np.arctan2(edge[:, 1], edge[:, 0])
    turned = np.abs((np.roll(heading, -1) - heading + np.pi) % (2 * np.pi) - np.pi)
    one = np.flatnonzero(turned < SAME_CURVE)
    other = (one + 1) % n
    difference = (state.moved[other] - state.moved[one]) / _SMOOTH**2
    for i, j, pull in zip(one, other, difference, strict=True):
        normal[[i, j], [i, j]] += 1.0 / _SMOOTH**2
        normal[[i, j], [j, i]] -= 1.0 / _SMOOTH**2
        gradient[i] += pull
        gradient[j] -= pull
