"""Known objects at rest between pushes: what is kept of each rest, and the better outline that several rests give.

What one view cannot show, another one does: an edge that a matcher displaces behind the object and not in front of it, a part in the
shadow of a higher part, the raggedness of every edge. A rest in a new pose is kept as one view. The views are brought together in the
object frame, which stays that of the first of them; unknown are the offset of each edge along its normal and the pose in each later view,
fitted to the lines of sight at once. The outline is traced anew from all views at these poses, and fitted again. It replaces the old one
where the latest rest, which did not make it, contradicts it clearly less: nothing is replaced for the noise of a single view.

What all views have in common stays: an object that a matcher makes wider by a pixel on its far side is wider in each view. For sides in
pairs that is, in any heading, the same object grown by half a pixel, and only a push can tell.

A fit takes as long as several frames. It is done in parts (`step`), so that poses wait for none of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from push_ident.errors import InputError, PerceptionError, PushIdentError
from push_ident.geometry.cut_cells import cells_in_outline, cut_at_outline
from push_ident.geometry.outline import edge_normals, signed_distance
from push_ident.geometry.se2 import compose, inverse, rotation, transform_points, wrap_angle
from push_ident.geometry.shape_check import check_shape
from push_ident.perception.frame.view import FrameView, median_frame, windows_along
from push_ident.perception.known_object import ON_OBJECT, PoseFit, Refined, Segment, SegmentedView, Template, TracedObject, TrackStatus
from push_ident.perception.outline.edges import (
    LEAST_SCATTER,
    SAME_CURVE,
    VARIANCE,
    EdgeLines,
    dense,
    lines_near_edges,
    scatter_of,
    with_edges_moved,
    without_reversed,
)
from push_ident.perception.outline.fewest_pieces import with_fewest_pieces
from push_ident.perception.outline.tracing import InParts, straighten, trace_in_parts
from push_ident.perception.tracking.pose_fit import MATCHER_WINDOW, displaced_by_camera, fit_pose, frame_step
from push_ident.perception.tracking.tracker import KnownObjects
from push_ident.types import CameraIntrinsics, DepthFrame, Float64Array, ObjectShape

_STILL: Final = (0.003, 0.03)
"""Largest distance and turn of a pose of a rest from their mean [m, rad]: three times the noise of one frame of a RealSense D435."""
_DRIFT: Final = (0.001, 0.01)
"""Largest distance and turn between the mean poses of the first and of the second half of a rest [m, rad]: less than a slow push."""
_NEW: Final = (0.02, 0.1)
"""A rest shows something new where the object moved or turned by more since each rest that is kept [m, rad]: a matcher displaces edges
anew, and other lines of sight pass them."""
_KEPT_RESTS: Final = 6
"""Rests that are kept of an object: what bounds the time of a refinement."""
_PRIOR_FROM_MEAN: Final = 0.002
"""Prior standard deviation of the offset of an edge from the mean offset [m]: a pixel on the table."""
_PRIOR_POSE: Final = np.array([0.003, 0.003, 0.03])
"""Prior standard deviations of the pose in a view about the tracked one [m, m, rad]: tracked with an outline of that error."""
_SMOOTH: Final = 0.0005
"""Standard deviation of the difference of the offsets of neighbouring edges of one curve [m]."""


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


@dataclass(frozen=True, slots=True)
class RestingObject:
    """An object at rest whose outline this rest may show better."""

    object_id: str
    template: Template
    pose: Float64Array
    """Mean over the rest (x, y, yaw) [m, m, rad], table frame."""
    frames: tuple[DepthFrame, ...]
    """Of the rest."""


@dataclass(slots=True)
class _RestHistory:
    views: list[RestView] = field(default_factory=list)
    poses: deque[Float64Array] = field(default_factory=deque)
    """In the latest frames, without a gap."""
    n_rests: int = 0

    def note(self, fit: PoseFit, rest_frames: int) -> None:
        """The pose in one more frame."""
        if fit.status is not TrackStatus.TRACKED:
            self.poses.clear()
            return
        self.poses.append(fit.pose)
        while len(self.poses) > rest_frames:
            self.poses.popleft()

    def pose_at_rest(self, rest_frames: int) -> Float64Array | None:
        """Mean pose of the latest frames; None where there are too few, or the object moves."""
        if len(self.poses) < rest_frames:
            return None
        poses = np.stack(self.poses)
        mean, half = poses.mean(axis=0), len(poses) // 2
        moves = half > 0 and _is_apart(poses[:half].mean(axis=0), poses[half:].mean(axis=0), _DRIFT)
        return None if moves or any(_is_apart(pose, mean, _STILL) for pose in poses) else mean

    def with_latest(self, view: RestView) -> list[RestView]:
        """The views with one more; beyond `_KEPT_RESTS` rests without the one whose heading is nearest to that of another one."""
        views = [*self.views, view]
        rests = {kept.rest: float(kept.pose[2]) for kept in views}
        if len(rests) > _KEPT_RESTS:
            inner = list(rests)[1:-1]  # the first one holds the frame, and the latest one is to be used
            alike = min(inner, key=lambda a: min(abs(float(wrap_angle(rests[a] - yaw))) for b, yaw in rests.items() if b != a))
            views = [kept for kept in views if kept.rest != alike]
        return views

    def refinement(
        self, resting: RestingObject, frames: Sequence[SegmentedView], points: NDArray[np.float32], min_height: float
    ) -> InParts[tuple[Refined, Template] | None]:
        """The better outline that the views and one more rest give, and what tracks it; None where it is not better.

        Args:
            frames: The segment of the object in each frame of the rest.
            points: Of the segment in the last one [m], shape (n, 3), table frame.
            min_height: Anything lower is table [m].

        Raises InputError, PerceptionError: No outline of an object can be traced, or the object is not found with it.
        """
        cut = [cut_to(segmented) for segmented in frames]
        last = cut[-1].view
        median = replace(last, frame=median_frame([segmented.view.frame for segmented in cut]), noise=last.noise / np.sqrt(len(cut)))
        view = RestView(replace(cut[-1], view=median), resting.pose, self.n_rests - 1)
        if _has_other_thing(view, points, resting.template, self.views):
            return None
        self.views = self.with_latest(view)
        if self.views[0].rest == view.rest:
            return None
        better = yield from refine(resting.template.traced, self.views, min_height=min_height)
        error = better.traced.shape.outline_error
        # The latest rest speaks for the new outline, and enough lines of sight pass its edges to know it better than the old one.
        if better.misfit >= better.misfit_before or error is None or error >= better.misfit_before:
            return None
        yield
        better = yield from _held(better, resting.template, view)
        yield
        better = replace(better, traced=replace(better.traced, shape=with_cells(better.traced.shape)))
        self.views = [replace(view, pose=pose) for view, pose in zip(self.views, better.poses, strict=True)]
        return better, Template(better.traced)


class Rests:
    """The rests of all known objects, and the work on better outlines."""

    def __init__(self) -> None:
        self._frames: deque[DepthFrame] = deque()
        self._objects: dict[str, _RestHistory] = {}
        self._work: dict[str, InParts[tuple[Refined, Template] | None]] = {}
        self._refined: dict[str, tuple[Refined, Template]] = {}
        self._failed: dict[str, str] = {}

    def begin(self, object_id: str, views: Sequence[SegmentedView] = (), pose: Float64Array | None = None) -> None:
        """Follow an object, with the views that it was traced from at `pose`; without any for one of an earlier run."""
        history = _RestHistory(n_rests=1 if views else 0)
        if pose is not None:
            history.views = [RestView(cut_to(view), pose, 0) for view in views]
        self._objects[object_id] = history

    def forget(self, object_id: str) -> None:
        """The object is no longer known."""
        for known in (self._objects, self._work, self._refined, self._failed):
            known.pop(object_id, None)

    def note(self, frame: DepthFrame, fits: Mapping[str, PoseFit], rest_frames: int) -> None:
        """Take the next frame and the poses in it; a view of a rest is the median of `rest_frames` frames."""
        if self._frames and (self._frames[-1].intrinsics != frame.intrinsics or self._frames.maxlen != rest_frames):
            self._frames.clear()
        if self._frames.maxlen != rest_frames:
            self._frames = deque(maxlen=rest_frames)
        self._frames.append(frame)
        for name, fit in fits.items():
            if name in self._objects:
                self._objects[name].note(fit, rest_frames)

    def resting(self, objects: KnownObjects) -> tuple[RestingObject, ...]:
        """The objects that have been at rest for long enough, at a pose that may show something new, and away from others: which edges
        belong to which of two objects near each other cannot be told."""
        frames, needed, resting = tuple(self._frames), self._frames.maxlen or 0, []
        if len(frames) < needed:
            return ()
        for name, known in objects.tracked().items():
            # What is visible of a hollow object depends on its lid, which is made anew in each frame.
            if known.template.traced.hollow is not None or name in self._work or name in self._refined:
                continue
            history = self._objects[name]
            pose = history.pose_at_rest(needed)
            is_new = pose is not None and all(_is_apart(pose, view.pose, _NEW) for view in history.views)
            if pose is not None and is_new and not objects.others_near(name):
                resting.append(RestingObject(name, known.template, pose, frames))
        return tuple(resting)

    def begin_refinements(self, at_rest: Sequence[RestingObject], segments: Sequence[Segment], view: FrameView, min_height: float) -> None:
        """Take rests for refinements, which `step` then does, of the objects that a search shows as a whole.

        Args:
            segments: Those of the search.
            view: In which it found them.
            min_height: Anything lower is table [m].
        """
        for resting in at_rest:
            segment = next((one for one in segments if _is_all_of(one, view.points, resting)), None)
            if segment is None:
                continue
            rest = [FrameView(frame, view.camera_in_table, view.robot, noise=view.noise) for frame in resting.frames]
            history = self._objects[resting.object_id]
            history.n_rests += 1
            self._work[resting.object_id] = history.refinement(
                resting, [SegmentedView(frame, segment) for frame in rest], segment.points_in(view.points), min_height
            )

    @property
    def is_refining(self) -> bool:
        """Whether parts of a refinement are left to do."""
        return bool(self._work)

    def step(self) -> None:
        """Do one part of the refinements under way, in the order in which they began.

        An error of any kind stays with its object, which remains usable as it is known: the frame whose turn it was has poses to give.
        """
        if not self._work:
            return
        name, work = next(iter(self._work.items()))
        try:
            next(work)
        except StopIteration as end:
            del self._work[name]
            if end.value is not None:
                self._refined[name] = end.value
        except Exception as error:
            del self._work[name]
            self._failed[name] = str(error) if isinstance(error, PushIdentError) else f"{type(error).__name__}: {error}"

    def finish(self) -> None:
        """Do all parts that are left."""
        while self._work:
            self.step()

    def take_refined(self) -> tuple[dict[str, tuple[Refined, Template]], dict[str, str]]:
        """The better outlines since the last call, and why others came to nothing; both by object."""
        refined, self._refined, failed, self._failed = self._refined, {}, self._failed, {}
        return refined, failed


def cut_to(segmented: SegmentedView) -> SegmentedView:
    """The part of a view up to 60 pixels around its segment: as far as parts of an object in a shadow are looked for."""
    around = 60
    frame, segment = segmented.view.frame, segmented.segment
    k = frame.intrinsics
    rows = slice(max(0, segment.rows.start - around), min(k.height, segment.rows.stop + around))
    columns = slice(max(0, segment.columns.start - around), min(k.width, segment.columns.stop + around))
    size = (columns.stop - columns.start, rows.stop - rows.start)
    intrinsics = CameraIntrinsics(*size, k.fx, k.fy, k.cx - columns.start, k.cy - rows.start)
    moved = replace(
        segment,
        rows=slice(segment.rows.start - rows.start, segment.rows.stop - rows.start),
        columns=slice(segment.columns.start - columns.start, segment.columns.stop - columns.start),
    )
    depth = np.ascontiguousarray(frame.depth[rows, columns])
    return SegmentedView(replace(segmented.view, frame=DepthFrame(frame.stamp, depth, intrinsics, frame.frame_id)), moved)


def _is_apart(pose: Float64Array, other: Float64Array, limits: tuple[float, float]) -> bool:
    return bool(np.hypot(*(pose - other)[:2]) > limits[0] or abs(float(wrap_angle(pose[2] - other[2]))) > limits[1])


def _is_all_of(segment: Segment, points: NDArray[np.float32], resting: RestingObject) -> bool:
    """Whether the segment is the object and shows all of it; `points`: of the image, shape (height, width, 3), table frame."""
    if not segment.whole:
        return False
    on_segment, pose = segment.points_in(points), resting.pose
    some = on_segment[:: 1 + len(on_segment) // 1000, :2]
    return bool(np.mean(resting.template.nearest_distance((some - pose[:2]) @ rotation(pose[2])) < 0.0) > 0.5)


def _has_other_thing(view: RestView, points: NDArray[np.float32], template: Template, earlier: Sequence[RestView]) -> bool:
    """Whether the segment holds more than the known object that an earlier view should have shown: a thing that touches it now.

    From 2 cm^2 outside the outline on, unless they were hidden before: an earlier view shows at most a fifth of them to be empty.

    Args:
        points: Of the segment [m], shape (n, 3), table frame.
    """
    in_object = transform_points(inverse(view.pose), points[:, :2])
    beyond = template.nearest_distance(in_object) > ON_OBJECT
    if np.count_nonzero(beyond) * view.segmented.segment.area < 2e-4 * max(len(points), 1):
        return False
    positions = np.column_stack([in_object[beyond], points[beyond, 2]])
    empty = np.zeros(len(positions), dtype=bool)
    for other in earlier:
        empty |= _passed(other.in_object(other.pose).view, positions)
    return bool(np.mean(empty) > 0.2)


def _passed(view: FrameView, positions: Float64Array) -> NDArray[np.bool_]:
    """Which positions [m], shape (n, 3), lines of sight of a view have passed: they end 10 mm or more behind."""
    camera, k = view.camera_in_table, view.frame.intrinsics
    in_camera = (positions - camera[:3, 3]) @ camera[:3, :3]
    ahead = np.maximum(in_camera[:, 2], 1e-3)
    u = np.rint(k.fx * in_camera[:, 0] / ahead + k.cx).astype(np.int64)
    v = np.rint(k.fy * in_camera[:, 1] / ahead + k.cy).astype(np.int64)
    inside = (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    passed = np.zeros(len(positions), dtype=bool)
    passed[inside] = view.frame.depth[v[inside], u[inside]] > ahead[inside] + 0.01
    return passed


def _held(better: Refined, before: Template, view: RestView) -> InParts[Refined]:
    """The better object in the frame in which its pose in the latest view stays what it is: poses have no step where an outline changes.

    Raises PerceptionError: The object is not found in the view.
    """
    after, latest = Template(better.traced), view.segmented.view
    yield
    old, new = fit_pose(before, latest, view.pose), fit_pose(after, latest, better.poses[-1])
    yield
    if old.status is not TrackStatus.TRACKED or new.status is not TrackStatus.TRACKED:
        raise PerceptionError(f"The object is not found with its better outline: {new.status.value}.")
    step = compose(inverse(old.pose), new.pose)
    traced = better.traced
    # The pose keeps the error that it has here by displaced edges, though the new outline has another one.
    error = displaced_by_camera(before, latest, old.pose) - displaced_by_camera(after, latest, new.pose)
    x, y = rotation(old.pose[2]).T @ error[:2]
    rests = traced.camera_positions or ()
    traced = replace(
        traced,
        camera_positions=tuple(transform_points(step, positions) for positions in rests),
        displaced_frame=(float(x), float(y), float(error[2])),
        frame_covariance=before.traced.frame_covariance + frame_step(old.residual_covariance, float(old.pose[2]), len(rests)),
    )
    shape = replace(traced.shape, outline=transform_points(step, traced.shape.outline))
    # Heights are known to a cell, which is more than such a turn moves them.
    traced = replace(traced, shape=shape, top_origin=traced.top_origin + step[:2])
    return replace(better, traced=traced, poses=tuple(compose(pose, inverse(step)) for pose in better.poses))


def with_cells(shape: ObjectShape) -> ObjectShape:
    """The shape with the same cells, to which masses and frictions belong, unless a tenth lies clearly outside the outline or is missing.

    Their number tells nothing: an edge that moves by a millimetre may hold a row of cells more or less.

    Raises InputError: It is no shape of an object.
    """
    cells = shape.cells
    anew = cells_in_outline(shape.outline, cells.size)
    outside = signed_distance(cells.squares, shape.outline) > 0.5 * cells.size
    bare = KDTree(cells.squares).query(anew.squares)[0] > 1.5 * cells.size
    if np.count_nonzero(outside) + np.count_nonzero(bare) <= 0.1 * len(cells):
        with suppress(InputError):
            return cut_at_outline(check_shape(shape))
    return check_shape(replace(shape, cells=anew))


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

    Raises PerceptionError: No outline can be traced from the views.
    """
    state = _begin(np.array(traced.shape.outline), [view.pose for view in views])
    yield from _fit(state, traced, views, n_steps=2, moves_edges=False)
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
    again = replace(again, displaced=traced.displaced, keeps_heading=traced.keeps_heading)
    yield from _fit(state, again, views, n_steps=2)
    straight = straighten(dense(state.outline))
    straight, height = straight if len(straight) >= 3 else state.outline, float(again.top.mean())
    # Each rest shows an edge with other teeth.
    noise = np.full(len(straight), state.scatter / np.sqrt(len(set(_rests(views)))))
    windows = [windows_along(view.segmented.view, pose, straight, height) for view, pose in zip(views, state.poses, strict=True)]
    outline = with_fewest_pieces(straight, noise, np.mean(windows, axis=0))
    state = _begin(outline, state.poses)
    yield from _fit(state, again, views, n_steps=2)
    state = _begin(state.outline, state.poses)
    # The first turn moves no edge, so that the deviations are those of the edges that remain.
    yield from _fit(state, again, views, n_steps=2, moves_edges=False)
    std = np.hypot(state.std, traced.displaced_std)
    shape = ObjectShape(traced.shape.cells, state.outline, std)
    again = replace(again, shape=shape, camera_positions=_camera_positions(views, state.poses), displaced_std=traced.displaced_std)
    return Refined(again, tuple(state.poses), views[-1].segmented.segment.area, state.misfit, before)


def _begin(outline: Float64Array, poses: Sequence[Float64Array]) -> _State:
    return _State(outline, np.zeros(len(outline)), list(poses), np.zeros(len(outline)))


def _fit(state: _State, traced: TracedObject, views: Sequence[RestView], *, n_steps: int = 4, moves_edges: bool = True) -> InParts[None]:
    """Gauss-Newton for the offsets of the edges and the poses of all rests but the first one."""
    for _ in range(n_steps):
        n = len(state.outline)
        template = Template(replace(traced, shape=ObjectShape(traced.shape.cells, state.outline)))
        lines = []
        for view, pose in zip(views, state.poses, strict=True):
            yield
            lines.append(lines_near_edges(template, state.outline, view.segmented.view, pose))
        state.scatter = float(np.hypot(scatter_of(lines), LEAST_SCATTER))
        latest = [near for near, view in zip(lines, views, strict=True) if view.rest == views[-1].rest]
        state.misfit = float(np.hypot(scatter_of(latest), LEAST_SCATTER))
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
            offset = np.clip(step[:n], -0.003, 0.003)  # where the model of the lines of sight is linear
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
        shared = np.square(state.scatter) * MATCHER_WINDOW / np.maximum(length, 1e-4)
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
