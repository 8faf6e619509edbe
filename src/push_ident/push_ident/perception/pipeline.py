"""The whole of perception: one depth frame in, the objects on the table out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import FrameError, PerceptionError
from push_ident.perception.contacts import unexplained_segments
from push_ident.perception.depth import points_in_table, usable_frame
from push_ident.perception.hollows import cover_hollows
from push_ident.perception.labels import ROBOT, TABLE, RobotPart, label_pixels
from push_ident.perception.parting import Parting, is_part_missing
from push_ident.perception.parts import parts_seen
from push_ident.perception.refusals import Reason, Refusal, Removal, summary_of
from push_ident.perception.registration import NewObject, Registration, refusal_of
from push_ident.perception.rests import Rests
from push_ident.perception.segments import Segment, find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.shape import TracedObject
from push_ident.perception.table import TablePlane, fit_table, plane_now
from push_ident.perception.topdown import TopDownGrid, top_down
from push_ident.perception.tracked_object import TrackedObject
from push_ident.perception.tracking import PoseFit, Scene, Template, TrackStatus, fit_pose, relocate
from push_ident.types import DepthFrame, Float64Array, ObjectShape

__all__ = ["KnownObject", "Observation", "ObservedObject", "Perception"]

_MAX_JUMP: Final = (0.02, 0.2)
"""Largest distance of a fitted pose from the predicted one [m, rad]: no pushed object moves further between two frames."""
_SAME_AREA: Final = (0.4, 1.6)
"""Range of the area of a segment that may be a lost object, relative to the area of that object."""
_DOUBTFUL: Final = 0.02
"""Where more of the pixels contradict a pose, it is checked in every frame whether a part is missing, else only before a search: whole
objects have 0.002 of the plain camera."""
_PARTS: Final = 30.0
"""Parts of refinements for each second between two frames [1/s]: one part, some milliseconds, for each frame of a usual camera."""
_MOST_PARTS: Final = 10
"""Largest number of parts in one frame, as of a camera of a few frames a second."""
_ROUNDING: Final = 1e-3
"""Tolerance of the periods [s], so that a camera at exactly that rate does not miss every other turn by rounding."""


@dataclass(frozen=True, slots=True)
class ObservedObject:
    """One known object in one frame."""

    object_id: str
    status: TrackStatus
    pose: Float64Array | None
    """(x, y, yaw) [m, m, rad], table frame; None unless TRACKED."""
    covariance: Float64Array | None
    """Shape (3, 3), table frame; None unless TRACKED."""


@dataclass(frozen=True, slots=True)
class Observation:
    """Result of one frame."""

    stamp: float
    """[s]"""
    objects: tuple[ObservedObject, ...]
    """All known objects that were tracked, lost or found again."""
    new_shapes: dict[str, ObjectShape]
    """Shapes of the objects registered with this frame, or remembered and found again, by id."""
    counts: dict[str, int]
    """Counts of each stage: `pixels`, `valid`, `tracked`, `lost`, and of the last search `table`, `robot`, `object_pixels`,
    `segments`, and refusals by their reason in small letters; `table_hidden` counts the checks of the plane that found too little of
    it."""
    refused: tuple[Refusal, ...]
    """What the last search found on the table that is no object, and why."""
    occupancy: TopDownGrid | None
    """None between two occupancy grids; they have a lower rate."""
    further_views: dict[str, str]
    """When an object was registered: per further camera the reason why its view was left out; empty where it was used."""
    restarted: bool = False
    """Whether time went back, so that everything known was dropped."""
    refined: dict[str, ObjectShape] = field(default_factory=dict)
    """Better shapes of known objects, by id: their rests showed their outlines better. The object frame stays."""
    not_refined: dict[str, str] = field(default_factory=dict)
    """Why the outline of an object, by id, stays as it is although a rest might have shown it better: what failed."""
    doubts: dict[str, str] = field(default_factory=dict)
    """Of objects registered with this frame, by id: why the tool may not touch them where their outlines are."""
    removed: tuple[Removal, ...] = ()
    """Objects that were given up with this frame, and why: they came apart. Their ids are not used again."""

    def why_no_pose(self) -> str:
        """Why no object has a pose; empty when one has."""
        if any(known.status is TrackStatus.TRACKED for known in self.objects):
            return ""
        if self.objects:
            return "; ".join(f"object {known.object_id}: {known.status.value}" for known in self.objects)
        if self.refused:
            return summary_of(self.refused)
        return f"nothing on the table is higher than min_object_height ({self.counts['table']} pixels show the table)"


@dataclass(frozen=True, slots=True)
class KnownObject:
    """What is needed to find an object again: how it was traced, and where it was last."""

    traced: TracedObject
    area: float
    """Area of its segment [m^2]."""
    pose: Float64Array
    """(x, y, yaw) [m, m, rad], table frame."""


@dataclass(frozen=True, slots=True)
class _Search:
    """What one search found, as in `Observation`."""

    fits: dict[str, PoseFit] = field(default_factory=dict)
    """Of objects that were found again."""
    new_shapes: dict[str, ObjectShape] = field(default_factory=dict)
    further_views: dict[str, str] = field(default_factory=dict)
    doubts: dict[str, str] = field(default_factory=dict)
    removed: tuple[Removal, ...] = ()


class Perception:
    """Perception with memory: the table plane, the objects and their latest poses.

    An object is registered when it was visible as a whole, clear of the robot and at rest, in `rest_frames` searches in a row. From then
    on it keeps its shape and its id ("o1", "o2", ...: no part of a ROS topic may begin with a digit), and gets a pose in each frame, or a
    status that gives the reason for the missing pose.
    """

    def __init__(self, camera_in_table: ArrayLike, settings: PerceptionSettings | None = None) -> None:
        """`camera_in_table`: optical frame in the table frame, homogeneous, shape (4, 4), from the extrinsics."""
        self._extrinsics = np.array(camera_in_table, dtype=np.float64)
        self.settings = settings or PerceptionSettings()
        self.reset()

    def reset(self) -> None:
        """Forget the table plane and all objects."""
        self._plane: TablePlane | None = None
        self._camera = self._extrinsics
        self._tracked: dict[str, TrackedObject] = {}
        self._registration = Registration()
        self._parting = Parting()
        self._rests = Rests()
        self._n_ids = 0
        self._refused: tuple[Refusal, ...] = ()
        self._search_counts = dict.fromkeys(("table", "robot", "object_pixels", "segments"), 0)
        self._table_hidden = 0
        self._was_busy = False
        self._last_stamp = self._last_search = self._last_occupancy = -np.inf

    @property
    def plane(self) -> TablePlane | None:
        """The table plane in use; None before the first frame."""
        return self._plane

    @property
    def camera_in_table(self) -> Float64Array:
        """Optical frame in the table frame, shape (4, 4): the extrinsics, corrected by the plane of the table."""
        return self._camera

    def remember(self, objects: Mapping[str, KnownObject]) -> None:
        """Look for objects of an earlier run as for lost ones: they keep their ids, shapes and object frames.

        To be called before the first frame, and again where time went back.
        """
        for name, known in objects.items():
            pose = np.array(known.pose, dtype=np.float64)
            tracked = TrackedObject(known.traced, Template(known.traced), known.area, known.traced.pose, pose, -np.inf)
            tracked.status, tracked.announced = TrackStatus.OUT_OF_VIEW, False
            self._tracked[name] = tracked
            self._rests.begin(name)
            self._n_ids = max(self._n_ids, int(name[1:]))

    def known(self, object_id: str) -> KnownObject:
        """A known object, for `remember`."""
        own = self._tracked[object_id]
        return KnownObject(own.traced, own.area, own.pose)

    def first_pose(self, object_id: str) -> Float64Array:
        """Pose (x, y, yaw) of a known object when it was registered, table frame: it defines the object frame."""
        return self._tracked[object_id].first_pose

    def observe(
        self,
        frame: DepthFrame,
        robot: Sequence[RobotPart] = (),
        on_poses: Callable[[tuple[ObservedObject, ...]], None] | None = None,
    ) -> Observation:
        """Process one frame.

        Args:
            frame: Later than the previous one; an earlier one drops everything known (a bag that starts again).
            robot: Tool and arm, so that they count neither as an object nor as free table.
            on_poses: Called with the tracked objects, before the slower search for others and the occupancy grid.

        Raises:
            FrameError: The frame repeats a stamp, its size differs from its camera info, or that is of no camera.
            PerceptionError: The frame has no valid pixel, or no table is found.
        """
        frame = usable_frame(frame)
        elapsed = frame.stamp - self._last_stamp
        restarted, n_valid = self._begin(frame)
        fits = self._track(frame, robot)
        refined, not_refined = self._adopt_refined(fits, frame, robot)
        self._rests.note(frame, fits, self.settings.rest_frames)
        if on_poses is not None and fits:
            on_poses(tuple(_observed(name, fit) for name, fit in fits.items()))
        occupancy_due = frame.stamp - self._last_occupancy >= self.settings.occupancy_period - _ROUNDING
        search_due = not self._tracked or self._is_search_due(frame)
        if occupancy_due and self._tracked:
            search_due = False  # both in one frame would delay the next one
        search, occupancy = _Search(), None
        if occupancy_due or search_due:
            points = points_in_table(frame, self._camera)
            labels = label_pixels(points, robot, self.limits)
            if search_due:
                search = self._search(frame, points, labels, robot)
                fits = {name: fit for name, fit in (fits | search.fits).items() if name in self._tracked}
            if occupancy_due:
                occupancy = top_down(points, labels, self.limits)
                self._last_occupancy = frame.stamp
            if occupancy_due or not self._tracked:
                self._check_plane(frame, points)
        self._go_on(elapsed, is_busy=occupancy_due or search_due)
        objects = tuple(_observed(name, fit) for name, fit in fits.items())
        counts = self._counts(frame, n_valid, objects)
        return Observation(
            frame.stamp,
            objects,
            search.new_shapes,
            counts,
            self._refused,
            occupancy,
            search.further_views,
            restarted,
            refined,
            not_refined,
            search.doubts,
            search.removed,
        )

    def _is_search_due(self, frame: DepthFrame) -> bool:
        return frame.stamp - self._last_search >= self.settings.search_period - _ROUNDING

    @property
    def _noise(self) -> float:
        """Standard deviation of a height [m]."""
        return 0.0 if self._plane is None else self._plane.noise

    @property
    def limits(self) -> PerceptionSettings:
        """The settings in force: with a least height of objects that the noise of the table allows."""
        assert self._plane is not None
        return replace(self.settings, min_object_height=max(self.settings.min_object_height, self._plane.least_height))

    def _begin(self, frame: DepthFrame) -> tuple[bool, int]:
        """Check the frame and fit the table plane before the first one; whether time went back, and the number of valid pixels."""
        if frame.stamp == self._last_stamp:
            raise FrameError(f"Depth frame repeats the stamp {frame.stamp:.6f} s; the camera driver or the bag repeats frames.")
        restarted = frame.stamp < self._last_stamp
        if restarted:
            self.reset()
        n_valid = int(np.count_nonzero(np.isfinite(frame.depth)))
        if n_valid == 0:
            raise PerceptionError(f"Depth image has 0 valid of {frame.depth.size} pixels; check the camera and its range.")
        if self._plane is None:
            self._use_plane(fit_table(points_in_table(frame, self._extrinsics), self.settings))
        self._last_stamp = frame.stamp
        return restarted, n_valid

    def _counts(self, frame: DepthFrame, n_valid: int, objects: Sequence[ObservedObject]) -> dict[str, int]:
        n_tracked = sum(known.status is TrackStatus.TRACKED for known in objects)
        return {
            "pixels": frame.depth.size,
            "valid": n_valid,
            "tracked": n_tracked,
            "lost": len(objects) - n_tracked,
            **self._search_counts,
            **{reason.name.lower(): sum(refusal.reason is reason for refusal in self._refused) for reason in Reason},
            "table_hidden": self._table_hidden,
        }

    def add_further_view(self, name: str, frame: DepthFrame, camera_in_table: ArrayLike, robot: Sequence[RobotPart] = ()) -> None:
        """Keep a frame of a further camera for tracing objects at rest; poses come from the main camera only.

        Args:
            name: Name of the camera.
            camera_in_table: Its optical frame in the table frame, shape (4, 4), from its extrinsics.
            robot: Parts of the robot when the frame was taken.
        """
        self._registration.add_further_view(name, frame, camera_in_table, robot)

    def fit(self, object_id: str, frame: DepthFrame, robot: Sequence[RobotPart] = ()) -> PoseFit:
        """Pose of a known object in another frame near its latest pose, for frames taken before the object was registered."""
        known = self._tracked[object_id]
        scene = Scene(frame, self._camera, robot, self.settings.mask_margin)
        return fit_pose(known.template, scene, known.pose)

    def _scene(self, name: str, frame: DepthFrame, robot: Sequence[RobotPart]) -> Scene:
        """A frame in which one object is looked for."""
        return Scene(frame, self._camera, robot, self.settings.mask_margin, self._others(name))

    def _track(self, frame: DepthFrame, robot: Sequence[RobotPart]) -> dict[str, PoseFit]:
        """Fit all known objects near their predicted poses."""
        fits = {}
        for name, known in self._tracked.items():
            if not known.announced:
                continue  # where it was in an earlier run is no place to start from
            start = known.predicted(frame.stamp)
            fit = fit_pose(known.template, self._scene(name, frame, robot), start)
            jumped = np.hypot(*(fit.pose - start)[:2]) > _MAX_JUMP[0] or abs(fit.pose[2] - start[2]) > _MAX_JUMP[1]
            if fit.can_start_next and jumped:
                # With most of the object behind the arm, a fit may slide to a pose that no visible pixel contradicts.
                fit = replace(fit, status=TrackStatus.POOR_FIT)
            fits[name] = self._accept(name, fit, frame, robot)
        return fits

    def _accept(self, name: str, fit: PoseFit, frame: DepthFrame, robot: Sequence[RobotPart]) -> PoseFit:
        """Take the fit of an object, unless a part of it is missing there; the fit with the status that results."""
        known = self._tracked[name]
        doubtful = known.status is not TrackStatus.TRACKED or fit.share_contradicting > _DOUBTFUL
        if fit.status in (TrackStatus.TRACKED, TrackStatus.POOR_FIT) and (doubtful or self._is_search_due(frame)):
            seen = parts_seen(known.template, self._scene(name, frame, robot), fit.pose, self._noise)
            if fit.status is TrackStatus.TRACKED and is_part_missing(seen):
                fit = replace(fit, status=TrackStatus.PART_MISSING)
            if fit.status is TrackStatus.TRACKED:
                self._parting.found(name)
            else:
                self._parting.lost(name, known.template, known.pose, known.area, seen)
        known.accept(fit, frame.stamp)
        return fit

    def _others(self, name: str) -> list[tuple[Template, Float64Array]]:
        """Other objects near enough to be mistaken for parts of this one."""
        own = self._tracked[name]
        return [
            (other.template, other.pose)
            for other_name, other in self._tracked.items()
            if other_name != name
            and other.status is TrackStatus.TRACKED
            and np.linalg.norm(other.pose[:2] - own.pose[:2]) < other.template.radius + own.template.radius + 0.03
        ]

    def _search(self, frame: DepthFrame, points: NDArray[np.float32], labels: NDArray[np.int8], robot: Sequence[RobotPart]) -> _Search:
        """Look for lost and new objects in the whole image."""
        assert self._plane is not None
        self._last_search = frame.stamp
        covered = cover_hollows(frame, points, labels, self._camera, self.limits)
        points, labels = covered.points, covered.labels
        segments, counts = find_segments(covered.frame, points, labels, self.limits)
        self._begin_refinements(segments, points, robot)
        found: dict[str, PoseFit] = {}
        unexplained = self._unexplained(segments, points)
        for name, known in self._tracked.items():
            if known.status is TrackStatus.TRACKED:
                continue
            fit = self._find_again(name, known, unexplained, frame, robot)
            if fit is not None:
                self._parting.found(name)
                known.accept(fit, frame.stamp)
                found[name] = fit
                unexplained = self._unexplained(unexplained, points)
        unexplained, touching, removed = self._parting.refuse(unexplained, points, self.settings.rest_frames)
        whole = [segment for segment in unexplained if segment.whole]
        traced, waiting = self._registration.update(whole, covered, self._camera, self._plane, self.limits)
        cut = [refusal_of(segment, points, segment.fault) for segment in unexplained if segment.fault is not None]
        self._refused = (*cut, *touching, *waiting)
        new = {self._add(thing, frame.stamp): thing for thing in traced}
        removed += self._parting.taken_in(new)
        for removal in removed:
            del self._tracked[removal.object_id]
            self._rests.forget(removal.object_id)
        table, on_robot = int(np.count_nonzero(labels == TABLE)), int(np.count_nonzero(labels == ROBOT))
        self._search_counts = {"table": table, "robot": on_robot, **counts}
        return _Search(
            found,
            self._announce() | {name: thing.traced.shape for name, thing in new.items()},
            self._registration.further_views,
            {name: thing.doubt for name, thing in new.items() if thing.doubt},
            tuple(removed),
        )

    def _begin_refinements(self, segments: Sequence[Segment], points: NDArray[np.float32], robot: Sequence[RobotPart]) -> None:
        """Begin to give known objects at rest a better outline, where this rest may show one."""
        at_rest = {name: self._rests.wants(name, known.traced) for name, known in self._tracked.items() if known.is_tracked}
        # What belongs to which of two objects near each other cannot be told.
        wanted = {name: pose for name, pose in at_rest.items() if pose is not None and not self._others(name)}
        if not wanted:
            return
        seen = [(segment, points[segment.rows, segment.columns][segment.mask]) for segment in segments]
        for name, pose in wanted.items():
            known = self._tracked[name]
            placed = (known.traced, known.template, pose)
            self._rests.begin_refinement(name, placed, seen, self._camera, self._noise, tuple(robot), self.limits)

    def _go_on(self, elapsed: float, *, is_busy: bool) -> None:
        """Do some of what better outlines take, `elapsed` seconds after the frame before; not in a frame that is busy, unless all are."""
        if not is_busy or self._was_busy:
            self._rests.go_on(int(np.clip(elapsed * _PARTS, 1, _MOST_PARTS)))
        self._was_busy = is_busy

    def _adopt_refined(
        self, fits: dict[str, PoseFit], frame: DepthFrame, robot: Sequence[RobotPart]
    ) -> tuple[dict[str, ObjectShape], dict[str, str]]:
        """Take up the better outlines that are ready, with fits of this frame to them; the shapes, and what failed."""
        ready, failed = self._rests.take_refined()
        shapes: dict[str, ObjectShape] = {}
        for name, (better, template) in ready.items():
            known = self._tracked[name]
            fit = fit_pose(template, self._scene(name, frame, robot), known.pose)
            if known.is_tracked and fit.status is not TrackStatus.TRACKED:
                failed[name] = f"with it, {fit.status.value}"
                continue
            known.adopt(better, template)
            shapes[name] = better.traced.shape
            if known.is_tracked:
                known.pose, fits[name] = fit.pose, fit
        return shapes, failed

    @property
    def is_refining(self) -> bool:
        """Whether a better outline is being worked on."""
        return self._rests.is_refining

    def finish(self) -> dict[str, ObjectShape]:
        """Better shapes that the frames so far give, by id, of known objects: after the last frame of a recording nothing is late."""
        self._rests.go_on()
        ready, _ = self._rests.take_refined()
        for name, (better, template) in ready.items():
            self._tracked[name].adopt(better, template)
        return {name: better.traced.shape for name, (better, _) in ready.items()}

    def _find_again(
        self, name: str, known: TrackedObject, segments: Sequence[Segment], frame: DepthFrame, robot: Sequence[RobotPart]
    ) -> PoseFit | None:
        """Fit of a lost object to the first segment of similar area that it fits as a whole; None where it fits none."""
        scene = self._scene(name, frame, robot)
        for segment in segments:
            if _SAME_AREA[0] * known.area < segment.area < _SAME_AREA[1] * known.area:
                fit = relocate(known.template, scene, segment.centre, last_yaw=float(known.pose[2]))
                if fit.status is TrackStatus.TRACKED and not is_part_missing(parts_seen(known.template, scene, fit.pose, self._noise)):
                    return fit
        return None

    def _unexplained(self, segments: Sequence[Segment], points: NDArray[np.float32]) -> list[Segment]:
        """The segments that are no tracked object."""
        tracked = [(known.template, known.pose) for known in self._tracked.values() if known.status is TrackStatus.TRACKED]
        return unexplained_segments(segments, points, tracked, self.limits.min_object_area)

    def _announce(self) -> dict[str, ObjectShape]:
        """Shapes of the remembered objects that were just found."""
        found = {name: own for name, own in self._tracked.items() if not own.announced and own.status is TrackStatus.TRACKED}
        for own in found.values():
            own.announced = True
        return {name: own.traced.shape for name, own in found.items()}

    def _add(self, new: NewObject, stamp: float) -> str:
        """Follow a new object from now on; its id."""
        self._n_ids += 1
        name = f"o{self._n_ids}"
        self._tracked[name] = TrackedObject(new.traced, Template(new.traced), new.area, new.traced.pose, new.traced.pose, stamp)
        self._rests.begin(name, new.views, new.traced.pose)
        return name

    def _use_plane(self, plane: TablePlane) -> None:
        self._plane = plane
        self._camera = plane.correct(self._extrinsics)

    def _check_plane(self, frame: DepthFrame, points: NDArray[np.float32]) -> None:
        assert self._plane is not None
        try:
            plane = plane_now(self._plane, points, lambda: points_in_table(frame, self._extrinsics), self.settings)
        except PerceptionError:
            self._table_hidden += 1  # The robot may cover the table for a while; the plane in use remains valid.
            return
        if plane is not self._plane:
            self._use_plane(plane)


def _observed(name: str, fit: PoseFit) -> ObservedObject:
    if fit.status is not TrackStatus.TRACKED:
        return ObservedObject(name, fit.status, None, None)
    return ObservedObject(name, fit.status, fit.pose, fit.covariance)
