"""From a new segment to an object: wait until it was at rest for some frames, trace it, and check the shape against what was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import FrameError, InputError, PerceptionError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.geometry.shape_check import check_shape
from push_ident.perception.contact_height import contact_doubt
from push_ident.perception.further_camera import FurtherCamera
from push_ident.perception.fusion import View, fuse_views
from push_ident.perception.hollows import Covered, with_hollow
from push_ident.perception.labels import RobotPart
from push_ident.perception.refusals import Reason, Refusal
from push_ident.perception.segments import Segment
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.shape import SegmentedView, TracedObject, median_depth, trace_object
from push_ident.perception.table import TablePlane
from push_ident.types import DepthFrame, Float64Array

__all__ = ["NewObject", "Registration", "refusal_of"]

_SAME_AREA: Final = 0.15
"""Largest relative difference of the areas of a segment at rest in two frames."""
_MIN_COVERED: Final = 0.7
"""Least fraction of the points of a segment that its traced outline must cover. On recorded scenes of a Kinect, refusing shapes below
this caught half of the wrong ones and one in 128 right ones."""
_BESIDE: Final = 0.01
"""Points up to this distance outside the outline count as covered [m]: a wall's points scatter to both sides of it."""
_CHECKED: Final = 2000
"""About so many of the points are compared with the outline; more do not change the fraction."""
_LONGEST_WAIT: Final = 16
"""A segment without a shape is traced anew after twice as many frames each time, up to so many times `rest_frames`."""
_HOLLOW: Final = "the object is hollow, and only the main camera sees where its hollow is"


@dataclass(frozen=True, slots=True)
class NewObject:
    """A segment that has become an object."""

    traced: TracedObject
    area: float
    """Of its segment [m^2]."""
    views: tuple[SegmentedView, ...]
    """It was traced from."""
    doubt: str
    """Why contact may not be where its outline is, for people; empty where nothing speaks against it."""


@dataclass(slots=True)
class _Candidate:
    """A segment that may become an object, and the frames in which it was at rest."""

    segment: Segment
    frames: list[DepthFrame]
    """Those since the last try, at most `rest_frames`."""
    centres: list[Float64Array]
    """Middle of the segment in each of them [m], shape (2,)."""
    waited: int = 1
    """Frames since the last try."""
    wait: int = 1
    """Frames until the next try, in units of `rest_frames`."""
    failure: str = ""
    """Why the last try gave no shape."""

    def is_continued_by(self, segment: Segment, frame: DepthFrame, rest_distance: float) -> bool:
        """Whether the segment has the place and the size of this candidate; noise moves the middle of a segment by up to a pixel.

        Frames of another size or with other intrinsics, as after a driver has changed its mode, begin anew.
        """
        if frame.intrinsics != self.frames[-1].intrinsics:
            return False
        pixel = float(np.nanmedian(frame.depth[segment.rows, segment.columns][segment.mask])) / frame.intrinsics.fx
        moved = float(np.linalg.norm(segment.centre - np.mean(self.centres, axis=0)))
        return moved < max(rest_distance, pixel) and abs(segment.area - self.segment.area) < _SAME_AREA * segment.area


@dataclass(slots=True)
class Registration:
    """Candidates for objects, and the further cameras that help to trace them."""

    further_views: dict[str, str] = field(default_factory=dict)
    """Of the frame at hand, when something was traced: per further camera why its view was left out; empty where it was used."""
    _candidates: list[_Candidate] = field(default_factory=list)
    _further: dict[str, FurtherCamera] = field(default_factory=dict)

    def add_further_view(self, name: str, frame: DepthFrame, camera_in_table: ArrayLike, robot: Sequence[RobotPart]) -> None:
        """Keep a frame of the further camera `name`; its optical frame in the table frame, shape (4, 4); the robot at that time."""
        self._further.setdefault(name, FurtherCamera()).add(frame, camera_in_table, robot)

    def update(
        self,
        segments: Sequence[Segment],
        covered: Covered,
        camera: Float64Array,
        plane: TablePlane,
        settings: PerceptionSettings,
    ) -> tuple[list[NewObject], list[Refusal]]:
        """Take the whole segments of a frame that no object explains.

        Args:
            covered: The frame in which they were found.
            camera: Optical frame in the table frame, shape (4, 4).

        Returns:
            The objects that were at rest for `rest_frames` frames with this one, and why the others are none. What goes wrong with one
            segment stays with it.
        """
        self.further_views = {}
        frame, points = covered.frame, covered.points
        self._candidates = [self._continued(segment, frame, settings) for segment in segments]
        new, refused, left = [], [], []
        for candidate in self._candidates:
            if candidate.waited >= candidate.wait * settings.rest_frames:
                try:
                    own = candidate.segment
                    lid = covered.lid_of((own.rows, own.columns), own.mask)
                    traced, views = self._shape_of(candidate, lid, camera, plane, settings)
                    _check_covered(traced, own, points)
                    doubt = contact_doubt(traced, _points_of(own, points).astype(np.float64), settings.tool_reach)
                    new.append(NewObject(traced, own.area, tuple(views), doubt))
                    continue
                except (FrameError, InputError, PerceptionError) as error:
                    candidate.failure = str(error)
                    candidate.waited, candidate.wait = 0, min(2 * candidate.wait, _LONGEST_WAIT)
            left.append(candidate)
            reason, why = Reason.NOT_AT_REST, Reason.NOT_AT_REST.value
            if candidate.failure:
                reason, why = Reason.NO_SHAPE, f"{Reason.NO_SHAPE.value}: {candidate.failure}"
            refused.append(refusal_of(candidate.segment, points, reason, why))
        self._candidates = left
        return new, refused

    def _continued(self, segment: Segment, frame: DepthFrame, settings: PerceptionSettings) -> _Candidate:
        """The candidate at the place of the segment with this frame added, or a new one."""
        for candidate in self._candidates:
            if candidate.is_continued_by(segment, frame, settings.rest_distance):
                frames = [*candidate.frames, frame][-settings.rest_frames :]
                centres = [*candidate.centres, segment.centre][-settings.rest_frames :]
                return _Candidate(segment, frames, centres, candidate.waited + 1, candidate.wait, candidate.failure)
        return _Candidate(segment, [frame], [segment.centre])

    def _shape_of(
        self, candidate: _Candidate, lid: Float64Array, camera: Float64Array, plane: TablePlane, settings: PerceptionSettings
    ) -> tuple[TracedObject, list[SegmentedView]]:
        """Its shape, and the views it was traced from; `lid` has the points of its lid [m], shape (n, 2).

        Raises FrameError, InputError or PerceptionError: there is no shape that agrees with what was seen.
        """
        last = candidate.frames[-1]
        frame = DepthFrame(last.stamp, median_depth(candidate.frames), last.intrinsics, last.frame_id)
        main = SegmentedView(frame, camera, candidate.segment, plane.noise / np.sqrt(len(candidate.frames)))
        is_hollow = len(lid) * candidate.segment.area > settings.min_object_area * int(np.count_nonzero(candidate.segment.mask))
        traced, views = self._trace_with_all(main, candidate.frames[0].stamp, last.stamp, settings, alone=is_hollow)
        fused = fuse_views(traced, [View(view.frame, view.camera_in_table, traced.pose) for view in views], pose_known=True)
        # What the nodes after this one refuse is no object here either.
        check_shape(fused.shape, remedy="It may be several things; move them apart.")
        return with_hollow(fused, lid) if is_hollow else fused, views

    def _trace_with_all(
        self, main: SegmentedView, began: float, ended: float, settings: PerceptionSettings, *, alone: bool
    ) -> tuple[TracedObject, list[SegmentedView]]:
        """The object traced from the main camera's view and those of further cameras that agree with it, and all these views.

        `alone`: from the main camera only, since the lid of a hollow object is in its view only.
        """

        def trace(views: Sequence[SegmentedView]) -> TracedObject:
            return trace_object(views, min_height=settings.min_object_height, cell_count=settings.cell_count)

        traced, views = trace([main]), [main]
        for name, camera in self._further.items():
            if alone:
                self.further_views[name] = _HOLLOW
                continue
            try:
                more = [*views, camera.view_of(traced, began, ended, settings)]
                traced, views = trace(more), more
                self.further_views.setdefault(name, "")
            except (FrameError, PerceptionError) as error:
                self.further_views[name] = str(error)
        return traced, views


def refusal_of(segment: Segment, points: NDArray[np.float32], reason: Reason, why: str = "") -> Refusal:
    """The refusal of a segment of a frame with these points [m], shape (height, width, 3), table frame."""
    own = _points_of(segment, points)
    hull = cv2.convexHull(own[:, :2].astype(np.float32))[:, 0].astype(np.float64)
    return Refusal(reason, why or reason.value, hull, float(np.quantile(own[:, 2], 0.98)))


def _check_covered(traced: TracedObject, segment: Segment, points: NDArray[np.float32]) -> None:
    """Raises PerceptionError unless the outline covers the points of its own segment."""
    own = _points_of(segment, points)[:, :2].astype(np.float64)
    own = own[:: 1 + len(own) // _CHECKED]
    covered = float(np.mean(signed_distance(own, transform_points(traced.pose, traced.shape.outline)) < _BESIDE))
    if covered < _MIN_COVERED:
        raise PerceptionError(
            f"the traced outline covers {covered:.0%} of what was seen of it, expected at least {_MIN_COVERED:.0%}; "
            "it may be hollow, leaning or several things"
        )


def _points_of(segment: Segment, points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Measured points of the segment [m], shape (n, 3)."""
    own = points[segment.rows, segment.columns][segment.mask]
    return own[np.isfinite(own[:, 2])]
