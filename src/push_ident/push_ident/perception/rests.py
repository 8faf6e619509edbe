"""Known objects at rest between pushes: what is kept of each rest, and when it gives a better outline.

A rest in a new place or heading is kept as one view. An outline is replaced when the latest rest, which did not make it, contradicts it
clearly more than it contradicts the outline of all rests. So nothing changes for a camera that was right at once, and nothing is
replaced for the noise of a single view.

The fit of several views takes as long as several frames. It is done in parts, a few of them in a frame (`go_on`), so that poses wait for
none of it; what it gives is taken up in the first frame after its last part.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from push_ident.errors import InputError, PerceptionError, PushIdentError
from push_ident.geometry.outline import cells_in_outline, signed_distance
from push_ident.geometry.se2 import compose, inverse, rotation, transform_points, wrap_angle
from push_ident.geometry.shape_check import check_shape
from push_ident.perception.contacts import Placed
from push_ident.perception.in_parts import InParts
from push_ident.perception.labels import RobotPart
from push_ident.perception.lasting import frame_step
from push_ident.perception.looking import Look, Resting
from push_ident.perception.refinement import DISPLACED, Refined, RestView, refine
from push_ident.perception.segments import Segment
from push_ident.perception.shape import SegmentedView, TracedObject, median_depth
from push_ident.perception.tracking import PoseFit, Scene, Template, TrackStatus, displaced_by_camera, fit_pose
from push_ident.types import CameraIntrinsics, DepthFrame, Float64Array, ObjectShape

__all__ = ["Rests", "cut_to", "with_cells"]

_STILL: Final = (0.003, 0.03)
"""Largest distance and turn of a pose of a rest from their mean [m, rad]: three times the noise of one frame of a RealSense D435."""
_DRIFT: Final = (0.001, 0.01)
"""Largest distance and turn between the mean poses of the first and of the second half of a rest [m, rad]: less than a slow push."""
_NEW: Final = (0.02, 0.1)
"""A rest shows something new where the object moved or turned by more since each rest that is kept [m, rad]: a matcher displaces edges
anew, and other lines of sight pass them."""
_KEPT: Final = 6
"""Rests that are kept of an object: what bounds the time of a refinement."""
_BETTER: Final = 0.9
"""An outline is replaced where the latest rest scatters less about the new one, by this factor [-]. Of 59 outlines in the check of
decision 13 none ended worse; of exact cameras the ratio is mostly nearer to 1."""
_SAME_CELLS: Final = 0.1
"""Share of the cells that may lie outside the outline or be missing in it, before the object gets cells anew [-]: its masses and frictions
belong to the old ones. A part that was hidden and is larger needs cells of its own."""
_AROUND: Final = 60
"""Margin of an image around the segment [px]: as far as parts of an object in a shadow are looked for."""
_BESIDE: Final = 0.008
"""Points within this distance of the outline belong to the object [m], as in `contacts`."""
_BEYOND: Final = 2e-4
"""Area of a segment outside the known outline from which it must have been hidden before [m^2]."""
_EMPTY: Final = 0.01
"""A line of sight that ends so far behind a point has passed it [m]."""
_FOREIGN: Final = 0.2
"""Fraction of the points outside the outline that an earlier view may have seen empty [-]; with more it is another thing."""


@dataclass(slots=True)
class _Resting:
    """One object."""

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

    def shows_something_new(self, pose: Float64Array) -> bool:
        return all(_is_apart(pose, view.pose, _NEW) for view in self.views)

    def with_latest(self, view: RestView) -> list[RestView]:
        """The views with one more; beyond `_KEPT` rests without the one whose heading is nearest to that of another one."""
        views = [*self.views, view]
        rests = {own.rest: float(own.pose[2]) for own in views}
        if len(rests) > _KEPT:
            inner = list(rests)[1:-1]  # the first one holds the frame, and the latest one is to be used
            alike = min(inner, key=lambda a: min(abs(float(wrap_angle(rests[a] - yaw))) for b, yaw in rests.items() if b != a))
            views = [own for own in views if own.rest != alike]
        return views

    def refinement(
        self,
        placed: Resting,
        seen: tuple[Sequence[SegmentedView], NDArray[np.float32], tuple[RobotPart, ...]],
        min_height: float,
    ) -> InParts[tuple[Refined, Template] | None]:
        """The better outline that the views and one more rest give, and what tracks it; None where it is not better.

        Args:
            placed: How the object is known, and its pose at rest.
            seen: The segment in each frame of the rest, its points in the last one [m], shape (n, 3), and the robot.
            min_height: Anything lower is table [m].

        Raises:
            InputError, PerceptionError: No outline of an object can be traced, or the object is not found with it.
        """
        (traced, template, pose), (frames, points, robot) = placed, seen
        cut = [cut_to(view) for view in frames]
        image = replace(cut[-1].frame, depth=median_depth([one.frame for one in cut]))
        view = RestView(replace(cut[-1], frame=image, noise=cut[-1].noise / np.sqrt(len(cut))), pose, self.n_rests - 1, robot)
        if _has_other_thing(view, points, (template, pose), self.views):
            return None
        self.views = self.with_latest(view)
        if self.views[0].rest == view.rest:
            return None
        better = yield from refine(traced, self.views, min_height=min_height)
        if not _is_better(better):
            return None
        yield
        better = yield from _held(better, template, view)
        yield
        better = replace(better, traced=replace(better.traced, shape=with_cells(better.traced.shape)))
        self.views = [replace(view, pose=pose) for view, pose in zip(self.views, better.poses, strict=True)]
        return better, Template(better.traced)


class Rests:
    """The rests of all known objects."""

    def __init__(self) -> None:
        self._frames: deque[DepthFrame] = deque()
        self._objects: dict[str, _Resting] = {}
        self._work: dict[str, InParts[tuple[Refined, Template] | None]] = {}
        self._refined: dict[str, tuple[Refined, Template]] = {}
        self._failed: dict[str, str] = {}

    def begin(self, object_id: str, views: Sequence[SegmentedView] = (), pose: Float64Array | None = None) -> None:
        """Follow an object, with the views that it was traced from at `pose`; without any for one of an earlier run."""
        own = _Resting(n_rests=1 if views else 0)
        if pose is not None:
            own.views = [RestView(cut_to(view), pose, 0) for view in views]
        self._objects[object_id] = own

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

    @property
    def frames(self) -> tuple[DepthFrame, ...]:
        """The latest frames, as many as a rest has."""
        return tuple(self._frames)

    def wants(self, object_id: str, traced: TracedObject) -> Float64Array | None:
        """Pose of an object that has been at rest for long enough in a place and heading that may show something new; else None."""
        own, needed = self._objects[object_id], self._frames.maxlen or 0
        # What is seen of a hollow object depends on its lid, which is made anew in each frame.
        if traced.hollow is not None or len(self._frames) < needed or object_id in self._work or object_id in self._refined:
            return None
        pose = own.pose_at_rest(needed)
        return pose if pose is not None and own.shows_something_new(pose) else None

    def begin_refinement(
        self,
        object_id: str,
        placed: Resting,
        segments: Sequence[tuple[Segment, NDArray[np.float32]]],
        started: Look,
        min_height: float,
    ) -> None:
        """Take a rest for a refinement, which `go_on` then does.

        Args:
            placed: How the object is known, and its pose at rest.
            segments: Those of the search, with their points [m], shape (n, 3), table frame.
            started: The search.
            min_height: Anything lower is table [m].
        """
        own, (_, template, pose) = self._objects[object_id], placed
        segment = _segment_of((template, pose), segments)
        if segment is None:
            return
        seen = [SegmentedView(frame, started.camera, segment, started.plane.noise) for frame in started.frames]
        points = next(at for one, at in segments if one is segment)
        own.n_rests += 1
        self._work[object_id] = own.refinement(placed, (seen, points, started.robot), min_height)

    @property
    def is_refining(self) -> bool:
        """Whether parts of a refinement are left to do."""
        return bool(self._work)

    def go_on(self, n_parts: int | None = None) -> None:
        """Do so many parts of the refinements under way, in the order in which they began; None: all of them.

        An error of any kind stays with its object, which remains usable as it is known: the frame whose turn it was has poses to give.
        """
        while self._work and n_parts != 0:
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
            n_parts = None if n_parts is None else n_parts - 1

    def take_refined(self) -> tuple[dict[str, tuple[Refined, Template]], dict[str, str]]:
        """The better outlines since the last call, and why others came to nothing; both by object."""
        refined, self._refined, failed, self._failed = self._refined, {}, self._failed, {}
        return refined, failed


def cut_to(view: SegmentedView) -> SegmentedView:
    """The part of a view around its segment."""
    frame, segment = view.frame, view.segment
    k = frame.intrinsics
    rows = slice(max(0, segment.rows.start - _AROUND), min(k.height, segment.rows.stop + _AROUND))
    columns = slice(max(0, segment.columns.start - _AROUND), min(k.width, segment.columns.stop + _AROUND))
    size = (columns.stop - columns.start, rows.stop - rows.start)
    own = CameraIntrinsics(*size, k.fx, k.fy, k.cx - columns.start, k.cy - rows.start)
    moved = replace(
        segment,
        rows=slice(segment.rows.start - rows.start, segment.rows.stop - rows.start),
        columns=slice(segment.columns.start - columns.start, segment.columns.stop - columns.start),
    )
    depth = np.ascontiguousarray(frame.depth[rows, columns])
    return replace(view, frame=DepthFrame(frame.stamp, depth, own, frame.frame_id), segment=moved)


def _is_apart(pose: Float64Array, other: Float64Array, limits: tuple[float, float]) -> bool:
    return bool(np.hypot(*(pose - other)[:2]) > limits[0] or abs(float(wrap_angle(pose[2] - other[2]))) > limits[1])


def _segment_of(known: Placed, segments: Iterable[tuple[Segment, NDArray[np.float32]]]) -> Segment | None:
    """The segment that is the object and shows all of it; None where there is none."""
    template, pose = known
    for segment, points in segments:
        some = points[:: 1 + len(points) // 1000, :2]
        if segment.whole and np.mean(template.nearest_distance((some - pose[:2]) @ rotation(pose[2])) < 0.0) > 0.5:
            return segment
    return None


def _has_other_thing(view: RestView, points: NDArray[np.float32], known: Placed, earlier: Sequence[RestView]) -> bool:
    """Whether the segment holds more than the known object that an earlier view should have shown: a thing that touches it now.

    Args:
        points: Of the segment [m], shape (n, 3), table frame.
    """
    template, pose = known
    in_object = transform_points(inverse(pose), points[:, :2])
    beyond = template.nearest_distance(in_object) > _BESIDE
    if np.count_nonzero(beyond) * view.seen.segment.area < _BEYOND * max(len(points), 1):
        return False
    places = np.column_stack([in_object[beyond], points[beyond, 2]])
    empty = np.zeros(len(places), dtype=bool)
    for other in earlier:
        seen = other.in_object(other.pose)
        empty |= _passed(seen, places)
    return bool(np.mean(empty) > _FOREIGN)


def _passed(seen: SegmentedView, places: Float64Array) -> NDArray[np.bool_]:
    """Which places [m], shape (n, 3), lines of sight of a view have passed."""
    camera, k = seen.camera_in_table, seen.frame.intrinsics
    in_camera = (places - camera[:3, 3]) @ camera[:3, :3]
    ahead = np.maximum(in_camera[:, 2], 1e-3)
    u = np.rint(k.fx * in_camera[:, 0] / ahead + k.cx).astype(np.int64)
    v = np.rint(k.fy * in_camera[:, 1] / ahead + k.cy).astype(np.int64)
    inside = (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    passed = np.zeros(len(places), dtype=bool)
    passed[inside] = seen.frame.depth[v[inside], u[inside]] > ahead[inside] + _EMPTY
    return passed


def _held(better: Refined, before: Template, view: RestView) -> InParts[Refined]:
    """The better object in the frame in which its pose in the latest view stays what it is: poses have no step where an outline changes.

    Raises:
        PerceptionError: The object is not found in the view.
    """
    scene = Scene(view.seen.frame, view.seen.camera_in_table, view.robot)
    after = Template(better.traced)
    yield
    old, new = fit_pose(before, scene, view.pose), fit_pose(after, scene, better.poses[-1])
    yield
    if old.status is not TrackStatus.TRACKED or new.status is not TrackStatus.TRACKED:
        raise PerceptionError(f"The object is not found with its better outline: {new.status.value}.")
    step = compose(inverse(old.pose), new.pose)
    traced = better.traced
    # The pose keeps the error that it has here by displaced edges, though the new outline has another one.
    error = displaced_by_camera(before, scene, old.pose) - displaced_by_camera(after, scene, new.pose)
    x, y = rotation(old.pose[2]).T @ error[:2]
    rests = traced.seen_from or ()
    traced = replace(
        traced,
        seen_from=tuple(transform_points(step, places) for places in rests),
        displaced_frame=(float(x), float(y), float(error[2])),
        frame_covariance=before.frame_covariance + frame_step(old.residual_covariance, float(old.pose[2]), len(rests)),
    )
    shape = replace(traced.shape, outline=transform_points(step, traced.shape.outline))
    # Heights are known to a cell, which is more than such a turn moves them.
    traced = replace(traced, shape=shape, top_origin=traced.top_origin + step[:2])
    return replace(better, traced=traced, poses=tuple(compose(pose, inverse(step)) for pose in better.poses))


def _is_better(better: Refined) -> bool:
    """Whether the latest rest speaks for the new outline, and enough lines of sight pass its edges to know it better than the old one."""
    error = better.traced.shape.outline_error
    return better.misfit < _BETTER * better.misfit_before and error is not None and error < DISPLACED * better.misfit_before


def with_cells(shape: ObjectShape) -> ObjectShape:
    """The shape with the same cells, unless some lie clearly outside the outline or a part of it has none; checked.

    Their number tells nothing: an edge that moves by a millimetre may hold a row of cells more or less.

    Raises:
        InputError: It is no shape of an object.
    """
    cells = shape.cells
    anew = cells_in_outline(shape.outline, cells.size)
    outside = signed_distance(cells.centres, shape.outline) > 0.5 * cells.size
    bare = KDTree(cells.centres).query(anew.centres)[0] > 1.5 * cells.size
    if np.count_nonzero(outside) + np.count_nonzero(bare) <= _SAME_CELLS * len(cells):
        with suppress(InputError):
            return check_shape(shape)
    return check_shape(replace(shape, cells=anew))
