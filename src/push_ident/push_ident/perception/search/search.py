"""The search for new and lost objects, done in parts over the frames that follow its own.

A search looks at the whole image, which takes longer than a fit of poses. It is of one frame and of what was known then; only its end, in
which lost objects are fitted again, is of the frame in which it ends. A segment that no known object explains becomes an object when it was
at rest for some frames: it is traced, and the shape compared with what was measured.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from push_ident.errors import FrameError, InputError, PerceptionError
from push_ident.geometry.outline import dense, polygon_area, signed_distance
from push_ident.geometry.se2 import compose, inverse, rotation, transform_points, wrap_angle
from push_ident.geometry.shape_check import check_shape
from push_ident.perception.frame.robot import RobotPart
from push_ident.perception.frame.table import fit_table
from push_ident.perception.frame.view import MATCHER_PIXELS, ROBOT, TABLE, FrameView, median_frame, pixel_at, points_in_table
from push_ident.perception.kernels import outline_distances
from push_ident.perception.known_object import (
    NOISE_STEP,
    ON_OBJECT,
    THIN,
    NewObject,
    Placed,
    PoseFit,
    Segment,
    SegmentedView,
    Template,
    TracedObject,
    TrackStatus,
    area_from_above,
)
from push_ident.perception.outline.edges import fuse_views, relative_size
from push_ident.perception.outline.tracing import trace_object
from push_ident.perception.refusals import Reason, Refusal, Removal
from push_ident.perception.search.hollows import Covered, cover_hollows, with_hollow
from push_ident.perception.search.segments import find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking.pose_fit import MISSING, compare_upper_side, contradictions, fit_pose, keeps_heading
from push_ident.perception.tracking.tracker import KnownObjects, Tracker
from push_ident.types import BoolArray, DepthFrame, Float64Array, ObjectShape

N_PARTS: Final = 3
"""Parts of a search: labels and hollows, segments, and what they are."""
_EXPLAINED: Final = 0.1
"""A segment of which less lies on known objects is a thing of its own: things that stand close may overlap at their walls [-]."""
_INSIDE_EDGE: Final = 0.003
"""So far inside the outline the height of an edge is looked up [m]: nearer to it, heights are those of a wall or of the table."""
_LOW_EDGE: Final = 0.05
"""Fraction of the edge from which it is reported that the tool passes over it [-]: less may be noise of the heights."""
_VISIBLE_SIDE: Final = 0.1
"""Least fraction of a high edge below which the side is visible [-]: a camera sees the sides that face it, at least a quarter of them."""
_HOLLOW: Final = "the object is hollow, and only the main camera sees where its hollow is"


@dataclass(frozen=True, slots=True)
class SearchResult:
    """What one search found."""

    covered: Covered
    """Its frame."""
    segments: list[Segment]
    """All of them."""
    fits: dict[str, PoseFit]
    """Of objects that were found again, by id."""
    announced: dict[str, ObjectShape]
    """Shapes of remembered objects that were found, by id."""
    new: dict[str, NewObject]
    """New objects, by id."""
    further_views: dict[str, str]
    """As in `Observation`."""
    removed: tuple[Removal, ...]
    """Objects that came apart."""


@dataclass(slots=True)
class _Started:
    """A search under way, with what was known in its frame."""

    covered: Covered
    stamp: float
    """Of its frame [s]."""
    tracked: dict[str, Placed]
    """The objects that had a pose, by id."""
    segments: list[Segment] | None = None
    counts: dict[str, int] = field(default_factory=dict)
    """Of pixels `table`, `robot`, `object_pixels`, and of `segments`."""


class Search:
    """Takes in new objects and finds lost ones again, in turns of the background work."""

    def __init__(self, objects: KnownObjects, tracker: Tracker) -> None:
        self._objects, self._tracker = objects, tracker
        self.registration: Final = Registration()
        self.refused: tuple[Refusal, ...] = ()
        """By the last search."""
        self.counts = dict.fromkeys(("table", "robot", "object_pixels", "segments"), 0)
        """Of the last search."""
        self.last = -np.inf
        """Stamp of the frame of the last search [s]."""
        self.is_under_way = False
        """Whether parts of it are left to do."""
        self._started: _Started | None = None

    def step(self, view: FrameView) -> SearchResult | None:
        """Do the next part; the result after the last one. An error ends the search."""
        started, self._started, self.is_under_way = self._started, None, False
        if started is None:
            self.last = view.frame.stamp
            tracked = {name: known.placed for name, known in self._objects.tracked().items()}
            started = _Started(cover_hollows(view), view.frame.stamp, tracked)
        elif started.segments is None:
            started.segments, counts = find_segments(started.covered.view)
            labels = started.covered.view.labels
            table, robot = (int(np.count_nonzero(labels == label)) for label in (TABLE, ROBOT))
            started.counts = {"table": table, "robot": robot, **counts}
        else:
            return self._explain(started, started.segments, view)
        self._started, self.is_under_way = started, True
        return None

    def _explain(self, started: _Started, segments: list[Segment], view: FrameView) -> SearchResult:
        """What the segments of a search are: known objects, lost ones, which are fitted to the frame of `view`, and new ones."""
        covered, separation = started.covered, self._tracker.separation
        points, least_area, rest_frames = covered.view.points, view.settings.min_object_area, view.settings.rest_frames
        tracked = {name: known.placed for name, known in self._objects.tracked().items()} | started.tracked
        unexplained = _unexplained(segments, points, list(tracked.values()), least_area)
        fits = {}
        for name, known in self._objects.items():
            # One of which a part is missing is where it was: elsewhere, or turned round, another thing would be taken for it.
            is_there = known.is_tracked or known.status is TrackStatus.PART_MISSING
            fit = None if is_there else self._tracker.find_again(view, name, unexplained)
            if fit is not None:
                fits[name] = fit
                unexplained = _unexplained(unexplained, points, [known.placed], least_area)
        unexplained, touching, removed = separation.refuse_parts(unexplained, points, rest_frames)
        others = [known.placed for known in self._objects.tracked().values()]
        traced, waiting = self.registration.update([segment for segment in unexplained if segment.whole], covered, view, others)
        new = {self._objects.add(thing, started.stamp): thing for thing in traced}
        cut = [segment.refusal(points, segment.fault) for segment in unexplained if segment.fault is not None]
        self.refused, self.counts = (*cut, *touching, *waiting), started.counts
        removed += separation.replace_by(new)
        for removal in removed:
            del self._objects[removal.object_id]
        return SearchResult(covered, segments, fits, self._objects.announce(), new, self.registration.further_views, tuple(removed))


def _unexplained(segments: Sequence[Segment], points: NDArray[np.float32], known: Sequence[Placed], least_area: float) -> list[Segment]:
    """The segments that are no known object, with the rest of those that only in part are known ones.

    Args:
        points: Of the frame [m], shape (height, width, 3), table frame.
        known: The objects that are tracked.
        least_area: A smaller rest is the border of a known object [m^2].

    Returns:
        Segments in the same order. A rest has the fault TOUCHES_KNOWN: where it ends beside the known object cannot be seen.
    """
    unexplained = []
    for segment in segments:
        on_known = _on_known(segment.points_in(points), segment.mask, known)
        if np.count_nonzero(on_known) < _EXPLAINED * np.count_nonzero(segment.mask):
            unexplained.append(segment)
            continue
        rest = cv2.morphologyEx((segment.mask & ~on_known).astype(np.uint8), cv2.MORPH_OPEN, THIN) > 0
        left = replace(segment, mask=rest).points_in(points).astype(np.float64)
        area = area_from_above(left)
        if area >= least_area:
            fault = Reason.TOUCHES_KNOWN if segment.whole else segment.fault
            unexplained.append(replace(segment, mask=rest, centre=left[:, :2].mean(axis=0), area=area, fault=fault))
    return unexplained


def _on_known(points: NDArray[np.float32], mask: BoolArray, known: Sequence[Placed]) -> BoolArray:
    """Which pixels of `mask`, with these points [m], shape (n, 3), lie on one of the known objects."""
    on_one = np.zeros(len(points), dtype=bool)
    for template, pose in known:
        on_one |= template.nearest_distance((points[:, :2] - pose[:2]) @ rotation(pose[2])) < ON_OBJECT
    result = np.zeros(mask.shape, dtype=bool)
    result[mask] = on_one
    return result


class FurtherCamera:
    """The latest frames of a camera beside the main one, which does not move: it sees what taller parts hide.

    Its view is used only where both cameras agree on the table and on the object.
    """

    def __init__(self) -> None:
        self._shots: deque[tuple[DepthFrame, tuple[RobotPart, ...]]] = deque(maxlen=20)
        """Frames, and the parts of the robot when they were taken."""
        self._extrinsics = np.eye(4)

    def add(self, frame: DepthFrame, camera_in_table: ArrayLike, robot: Sequence[RobotPart] = ()) -> None:
        """Keep a frame.

        Args:
            camera_in_table: Optical frame in the table frame, shape (4, 4), from the extrinsics.
            robot: Parts of the robot when the frame was taken.
        """
        extrinsics = np.array(camera_in_table, dtype=np.float64)
        if self._shots:
            last, _ = self._shots[-1]
            # Frames before a restart of the bag, a change of resolution or a move of the camera are dropped.
            if frame.stamp < last.stamp or frame.intrinsics != last.intrinsics or not np.array_equal(extrinsics, self._extrinsics):
                self._shots.clear()
        self._extrinsics = extrinsics
        self._shots.append((frame, tuple(robot)))

    def view_of(self, traced: TracedObject, began: float, ended: float, settings: PerceptionSettings) -> SegmentedView:
        """This camera's view of an object at rest, with its extrinsics corrected so that table and object agree with the main camera.

        Args:
            traced: The object as the main camera traced it.
            began, ended: Start and end of its rest [s].

        Raises PerceptionError: The view shows too little of the object, or contradicts the main camera; the text gives the numbers.
        """
        accepted = settings.further_camera
        shots = self._during(began, ended, settings)
        frame = median_frame([frame for frame, _ in shots])
        robot = [part for _, parts in shots for part in parts]
        plane = fit_table(points_in_table(frame, self._extrinsics), settings)
        view = FrameView(frame, plane.correct(self._extrinsics), robot, settings, plane.noise)
        template = Template(traced)
        segment = _segment_of(traced, template, view)
        fit = fit_pose(template, view, traced.pose)
        if fit.status is not TrackStatus.TRACKED:
            raise PerceptionError(f"The object is not found where the main camera located it: {fit.status.value}.")
        shift, turn = float(np.linalg.norm(fit.pose[:2] - traced.pose[:2])), abs(float(wrap_angle(fit.pose[2] - traced.pose[2])))
        if shift > accepted.max_shift or turn > accepted.max_turn or fit.share_contradicting > accepted.max_contradicting:
            raise PerceptionError(
                f"The object is {shift * 1e3:.1f} mm and {np.degrees(turn):.1f} degrees from its pose in the main camera, and "
                f"{fit.share_contradicting:.0%} of the lines of sight contradict its outline, expected at most "
                f"{accepted.max_shift * 1e3:.0f} mm, {np.degrees(accepted.max_turn):.1f} degrees and {accepted.max_contradicting:.0%}; "
                "check the extrinsics of both cameras."
            )
        agreed = _moved(view.camera_in_table, compose(traced.pose, inverse(fit.pose)))
        growth = template.radius * (relative_size(FrameView(frame, agreed, robot), traced) - 1.0)
        if abs(growth) > accepted.max_growth:
            raise PerceptionError(
                f"The farthest edge of the object is {growth * 1e3:+.1f} mm from its place in the main camera, expected within "
                f"{accepted.max_growth * 1e3:.1f} mm; check the camera infos and the unit of the depth of both cameras."
            )
        return SegmentedView(FrameView(frame, agreed, noise=plane.noise), segment)

    def _during(self, began: float, ended: float, settings: PerceptionSettings) -> list[tuple[DepthFrame, tuple[RobotPart, ...]]]:
        """Frames and robot parts of a rest, at most `rest_frames`, the latest ones."""
        margin = settings.further_camera.time_margin
        shots = [shot for shot in self._shots if began - margin <= shot[0].stamp <= ended + margin]
        needed = int(np.ceil(settings.further_camera.needed * settings.rest_frames))
        if len(shots) < needed:
            late = f"the latest is from {ended - self._shots[-1][0].stamp:.2f} s before its end" if self._shots else "there are none"
            raise PerceptionError(
                f"{len(shots)} depth frames show the {ended - began:.2f} s of rest, expected at least {needed}; {late}. "
                "Check the driver, its clock, and rest_frames."
            )
        return shots[-settings.rest_frames :]


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

    def is_continued_by(self, segment: Segment, view: FrameView) -> bool:
        """Whether the segment has the position and the size of this candidate; noise moves the middle of a segment by up to a pixel.

        Frames of another size or with other intrinsics, as after a driver has changed its mode, begin anew.
        """
        frame, settings = view.frame, view.settings
        if frame.intrinsics != self.frames[-1].intrinsics:
            return False
        pixel = float(np.nanmedian(frame.depth[segment.rows, segment.columns][segment.mask])) / frame.intrinsics.fx
        moved = float(np.linalg.norm(segment.centre - np.mean(self.centres, axis=0)))
        same_area = abs(segment.area - self.segment.area) < settings.segments.same_area * segment.area
        return moved < max(settings.rest_distance, pixel) and same_area


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
        self, segments: Sequence[Segment], covered: Covered, latest: FrameView, others: Sequence[Placed]
    ) -> tuple[list[NewObject], list[Refusal]]:
        """Take the whole segments of a frame that no object explains.

        Args:
            covered: The frame in which they were found.
            latest: The frame now, in which their shapes have to be found.
            others: The objects that are tracked.

        Returns:
            The objects that were at rest for `rest_frames` frames with this one, and why the others are none. What goes wrong with one
            segment stays with it.
        """
        self.further_views = {}
        view = covered.view
        self._candidates = [self._continued(segment, view) for segment in segments]
        new, refused, left = [], [], []
        for candidate in self._candidates:
            segment = candidate.segment
            if candidate.waited >= candidate.wait * view.settings.rest_frames:
                try:
                    traced, views = self._shape_of(candidate, _lid_of(segment, covered), view)
                    if view.settings.segments.must_fit:
                        check_covered(traced, segment, view)
                        check_seen(traced, segment, view)
                        traced = _checked(traced, latest, others)
                    measured = segment.measured_in(view.points).astype(np.float64)
                    new.append(NewObject(traced, segment.area, tuple(views), _contact_doubt(traced, measured, view.settings.tool_reach)))
                    continue
                except (FrameError, InputError, PerceptionError) as error:
                    candidate.failure = str(error)
                    candidate.waited, candidate.wait = 0, min(2 * candidate.wait, 16)  # traced anew less and less often
            left.append(candidate)
            reason, why = Reason.NOT_AT_REST, Reason.NOT_AT_REST.value
            if candidate.failure:
                reason, why = Reason.NO_SHAPE, f"{Reason.NO_SHAPE.value}: {candidate.failure}"
            refused.append(segment.refusal(view.points, reason, why))
        self._candidates = left
        return new, refused

    def _continued(self, segment: Segment, view: FrameView) -> _Candidate:
        """The candidate at the position of the segment with this frame added, or a new one."""
        frame, settings = view.frame, view.settings
        for candidate in self._candidates:
            if candidate.is_continued_by(segment, view):
                frames = [*candidate.frames, frame][-settings.rest_frames :]
                centres = [*candidate.centres, segment.centre][-settings.rest_frames :]
                return _Candidate(segment, frames, centres, candidate.waited + 1, candidate.wait, candidate.failure)
        return _Candidate(segment, [frame], [segment.centre])

    def _shape_of(self, candidate: _Candidate, lid: Float64Array, view: FrameView) -> tuple[TracedObject, list[SegmentedView]]:
        """Its shape, and the views it was traced from; `lid` has the points of its lid [m], shape (n, 2), `view` is the latest frame.

        Raises FrameError, InputError or PerceptionError: there is no shape that agrees with what was measured.
        """
        frames, segment, settings = candidate.frames, candidate.segment, view.settings
        median = FrameView(median_frame(frames), view.camera_in_table, noise=view.noise / np.sqrt(len(frames)))
        is_hollow = len(lid) * segment.area > settings.min_object_area * int(np.count_nonzero(segment.mask))
        main = SegmentedView(median, segment)
        traced, views = self._trace_with_all(main, frames[0].stamp, frames[-1].stamp, settings, main_only=is_hollow)
        fused = fuse_views(traced, [(segmented.view, traced.pose) for segmented in views])
        # What the nodes after this one refuse is no object here either.
        check_shape(fused.shape, remedy="It may be several things; move them apart.")
        return with_hollow(fused, lid) if is_hollow else fused, views

    def _trace_with_all(
        self, main: SegmentedView, began: float, ended: float, settings: PerceptionSettings, *, main_only: bool
    ) -> tuple[TracedObject, list[SegmentedView]]:
        """The object traced from the main camera's view and those of further cameras that agree with it, and all these views.

        `main_only`: from the main camera only, since the lid of a hollow object is in its view only.
        """

        def trace(views: Sequence[SegmentedView]) -> TracedObject:
            return trace_object(views, min_height=settings.min_object_height, cell_count=settings.cell_count)

        traced, views = trace([main]), [main]
        for name, camera in self._further.items():
            if main_only:
                self.further_views[name] = _HOLLOW
                continue
            try:
                more = [*views, camera.view_of(traced, began, ended, settings)]
                traced, views = trace(more), more
                self.further_views.setdefault(name, "")
            except (FrameError, PerceptionError) as error:
                self.further_views[name] = str(error)
        return traced, views


def _lid_of(segment: Segment, covered: Covered) -> Float64Array:
    """Points of the lid of a segment [m], shape (n, 2), table frame; none where it has no lid."""
    if covered.lid is None:
        return np.empty((0, 2))
    box = (segment.rows, segment.columns)
    return covered.view.points[box][covered.lid[box] & segment.mask][:, :2].astype(np.float64)


def check_covered(traced: TracedObject, segment: Segment, view: FrameView) -> None:
    """Raises PerceptionError unless the outline covers the points of its segment, but for noise: those of walls scatter."""
    points = _thinned(segment.measured_in(view.points)[:, :2].astype(np.float64))
    covered = float(np.mean(signed_distance(points, transform_points(traced.pose, traced.shape.outline)) < NOISE_STEP))
    least = view.settings.segments.min_covered
    if covered < least:
        raise PerceptionError(
            f"the traced outline covers {covered:.0%} of what was seen of it, expected at least {least:.0%}; "
            "it may be hollow, leaning, wider below its top, or several things"
        )


def check_seen(traced: TracedObject, segment: Segment, view: FrameView) -> None:
    """Raises PerceptionError unless an upper side was measured all along the inside of its outline: less than a window of a matcher from
    the edge, and less than half a window from a measured point. Torn edges give outlines with tips that nobody saw.

    Hollow objects are left out: the rim on the far side is often too thin to be measured.
    """
    if traced.hollow is not None:
        return
    cells, window = _cells_of_top(traced), MATCHER_PIXELS * pixel_at(view, traced.pose)
    depth = -outline_distances(cells, np.ascontiguousarray(traced.shape.outline))
    inside = cells[(depth > 0.0) & (depth < window)]
    # What belongs to a higher thing beside it was measured, too.
    reach = int(2 * MATCHER_PIXELS)
    rows, columns = (slice(max(0, one.start - reach), one.stop + reach) for one in (segment.rows, segment.columns))
    points = view.points[rows, columns].reshape(-1, 3)
    points = points[points[:, 2] > float(traced.top.min()) - NOISE_STEP]
    measured = transform_points(inverse(traced.pose), points[:, :2].astype(np.float64))
    unseen = float(np.mean(_distance_to(measured, inside) > 0.5 * window)) if len(inside) else 0.0
    most = view.settings.segments.max_unseen
    if unseen > most:
        raise PerceptionError(
            f"nothing was measured at {unseen:.0%} of the inside of its edge, expected at most {most:.0%}: the edge is torn in the "
            "image, or a higher thing touches it; move camera, light or things, or make it less dark and glossy"
        )


def _checked(traced: TracedObject, view: FrameView, others: Sequence[Placed]) -> TracedObject:
    """The object, with whether it keeps its heading. Raises PerceptionError unless a pose fit in a frame of the same rest finds it where it
    was traced."""
    template, accepted = Template(traced), view.settings.tracking
    max_step, max_turn = accepted.max_jump
    fit = fit_pose(template, view, traced.pose, others)
    shift, turn = float(np.linalg.norm((fit.pose - traced.pose)[:2])), abs(float(wrap_angle(fit.pose[2] - traced.pose[2])))
    contradicting = fit.share_contradicting
    # Lines of sight through an opening meet walls inside, which are not known.
    most = accepted.doubtful if traced.hollow is None else accepted.found_contradicting
    if fit.status is not TrackStatus.TRACKED or contradicting > most or shift > max_step or turn > max_turn:
        raise PerceptionError(f"the frames do not fit the outline that they gave: {_why_no_fit(template, view, fit, others)}")
    missing = compare_upper_side(template, view, fit.pose, others).missing
    if missing > MISSING:
        raise PerceptionError(
            f"{1e4 * missing:.0f} cm^2 within its outline are lower than its upper side; it may be hollow, or several things that touch"
        )
    return replace(traced, keeps_heading=keeps_heading(template, view, traced.pose, others)) if template.has_heading else traced


def _why_no_fit(template: Template, view: FrameView, fit: PoseFit, others: Sequence[Placed]) -> str:
    """What speaks most against an outline at a pose, for people."""
    if fit.status is TrackStatus.HIDDEN:
        return f"{fit.share_visible:.0%} of its edge are visible; it may be hidden in part"
    outside, inside = contradictions(template, view, fit.pose, others)
    if max(outside, inside) < 0.5 * view.settings.tracking.doubtful:
        return "a pose fit ends elsewhere; its edge may be hidden in part, or the focal length wrong"
    if outside > inside:
        return (
            f"{outside:.0%} of the lines of sight beside its outline are stopped; something of it is lower than its top, as a handle or a "
            "shoulder, or another thing touches it, or the focal length is wrong"
        )
    return (
        f"{inside:.0%} of the lines of sight within its outline pass; its edge may be torn in the image, it may be hollow or lean, or the "
        "focal length is wrong"
    )


def _contact_doubt(traced: TracedObject, points: Float64Array, tool_reach: tuple[float, float]) -> str:
    """Why contact may not be where the outline is, for people; empty where nothing speaks against it.

    A tool that stands upright touches the widest part of an object between its tip and its upper end, and that is what the outline shows.
    Two things it misses: parts lower than its tip, over which it passes, and parts above its upper end, below which the object may be
    narrower.

    Args:
        points: What was measured of the object [m], shape (n, 3), table frame.
        tool_reach: Heights of the tip and of the upper end of the tool above the table while it pushes [m].
    """
    low, high = tool_reach
    edge = dense(traced.shape.outline, traced.top_resolution)
    height = _height_of_edge(traced, edge)
    if float(traced.top.max()) < low:
        return (
            f"it is {1e3 * float(traced.top.max()):.0f} mm high, and the tip of the tool {1e3 * low:.0f} mm above the table: "
            "pushes go over it; lower the tool"
        )
    share = float(np.mean(height < low))
    if share > _LOW_EDGE:
        return (
            f"{share:.0%} of its edge is lower than the tip of the tool, {1e3 * low:.0f} mm above the table: there the tool touches it "
            "further inside than its outline; lower the tool"
        )
    above = edge[height > high]
    if len(above) == 0:
        return ""
    side = points[(points[:, 2] > low) & (points[:, 2] < high)]
    # A point within 8 mm is on the side below an edge there.
    visible = _distance_to(side[:, :2], transform_points(traced.pose, above)) < 0.008
    if float(np.mean(visible)) < _VISIBLE_SIDE:
        return (
            f"its edge is up to {1e3 * float(height.max()):.0f} mm high, above the upper end of the tool at {1e3 * high:.0f} mm, and no "
            "side below it is seen: it may be narrower where the tool touches it"
        )
    return ""


def _height_of_edge(traced: TracedObject, edge: Float64Array) -> Float64Array:
    """Height of the upper side just inside each point of the edge [m], shape (n,)."""
    cells = _cells_of_top(traced)
    outline = np.ascontiguousarray(traced.shape.outline)
    # A thin object has no cell that deep inside; half of its width, at the least the middle, will do.
    depth = min(_INSIDE_EDGE, 0.25 * abs(polygon_area(outline)) / max(float(np.ptp(outline, axis=0).max()), 1e-6))
    inside = outline_distances(cells, outline) < -depth
    if not inside.any():
        return np.full(len(edge), float(traced.top.max()))
    cells, heights = cells[inside], traced.top.ravel()[inside]
    nearest = cKDTree(cells).query(edge)[1]
    return np.asarray(heights[nearest], dtype=np.float64)


def _cells_of_top(traced: TracedObject) -> Float64Array:
    """Centres of the cells of `traced.top` [m], shape (n, 2), object frame."""
    rows, columns = np.indices(traced.top.shape)
    return np.ascontiguousarray(traced.top_origin + traced.top_resolution * np.stack([columns.ravel(), rows.ravel()], axis=1))


def _distance_to(points: Float64Array, positions: Float64Array) -> Float64Array:
    """Distance of positions, shape (n, 2), from the nearest of the points [m], shape (n,); infinite where there are none."""
    return np.asarray(cKDTree(points).query(positions)[0]) if len(points) else np.full(len(positions), np.inf)


def _thinned(points: Float64Array) -> Float64Array:
    """About 2000 of the points: more do not change a fraction."""
    return points[:: 1 + len(points) // 2000]


def _segment_of(traced: TracedObject, template: Template, view: FrameView) -> Segment:
    """The pixels of the object, all of which must be visible."""
    segments, _ = find_segments(view)
    turn = rotation(traced.pose[2])

    def share_in(segment: Segment) -> float:
        on_segment = segment.points_in(view.points)[:, :2]
        return float(np.mean(template.nearest_distance((on_segment - traced.pose[:2]) @ turn) < ON_OBJECT))

    segment = max(segments, key=share_in, default=None)
    if segment is None or share_in(segment) < 0.5:
        raise PerceptionError(f"None of {len(segments)} segments lies where the main camera located the object; check the extrinsics.")
    if not segment.whole:
        raise PerceptionError("The object is beside the robot, cut by the border of the image, or behind another; move what is in the way.")
    area = abs(polygon_area(traced.shape.outline))
    low, high = view.settings.further_camera.area
    if not low * area < segment.area < high * area:
        raise PerceptionError(
            f"The object covers {segment.area * 1e4:.1f} cm^2, for the main camera {area * 1e4:.1f} cm^2; "
            "make all of it visible to both, and check that min_step does not divide it."
        )
    return segment


def _moved(camera_in_table: Float64Array, motion: Float64Array) -> Float64Array:
    """The camera moved by a planar motion (x, y, yaw) about the origin of `table`."""
    transform = np.eye(4)
    transform[:2, :2], transform[:2, 3] = rotation(motion[2]), motion[:2]
    return np.asarray(transform @ camera_in_table)
