"""The whole of perception: one depth frame in, the objects on the table out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import FrameError, PerceptionError
from push_ident.perception.contacts import Placed, unexplained_segments
from push_ident.perception.depth import points_in_table, usable_frame
from push_ident.perception.in_parts import all_at_once
from push_ident.perception.labels import RobotPart, label_pixels
from push_ident.perception.looking import N_PARTS, Look, Resting, Seen, look
from push_ident.perception.observation import KnownObject, Observation, ObservedObject, observed
from push_ident.perception.parting import Parting, is_part_missing
from push_ident.perception.parts import parts_seen
from push_ident.perception.refusals import Reason, Refusal, Removal
from push_ident.perception.registration import NewObject, Registration, refusal_of
from push_ident.perception.rests import Rests
from push_ident.perception.segments import Segment
from push_ident.perception.settings import PerceptionSettings
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
"""Where more of the pixels contradict a pose, it is checked in every frame whether a part is missing, else once in each search period:
whole objects have 0.002 of the plain camera."""
_TURNS: Final = 30.0
"""Turns of the work that poses do not wait for, for each second between two frames [1/s]: one for each frame of a usual camera. A turn is
a part of a search or of a better outline, an occupancy grid or a check of the plane, each 3 to 15 ms."""
_MOST_TURNS: Final = 10
"""Largest number of turns in one frame, as of a camera of a few frames a second."""
_WHOLE_SEARCH: Final = N_PARTS + 2
"""Turns in which a search begins and ends, though an occupancy grid and a check of the plane are due."""
_ROUNDING: Final = 1e-3
"""Tolerance of the periods [s], so that a camera at exactly that rate does not miss every other turn by rounding."""


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

    def __init__(self, camera_in_table: ArrayLike, settings: PerceptionSettings | None = None, *, occupancy: bool = True) -> None:
        """Begin with nothing known.

        Args:
            camera_in_table: optical frame in the table frame, homogeneous, shape (4, 4), from the extrinsics.
            settings: ranges and thresholds.
            occupancy: whether to make the occupancy grid; without it, poses and shapes are the same.
        """
        self._makes_occupancy = occupancy
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
        self._look: Look | None = None
        self._is_outline_next = False
        self._last_stamp = self._last_search = self._last_occupancy = self._last_plane = -np.inf

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
        fits = self._track(frame, robot, elapsed)
        refined, not_refined = self._adopt_refined(fits, frame, robot)
        self._rests.note(frame, fits, self.settings.rest_frames)
        if on_poses is not None and fits:
            on_poses(tuple(observed(name, fit) for name, fit in fits.items()))
        search, occupancy = self._beside(frame, robot, elapsed, n_taken=bool(refined))
        fits = {name: fit for name, fit in (fits | search.fits).items() if name in self._tracked}
        objects = tuple(observed(name, fit) for name, fit in fits.items())
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

    def _beside(self, frame: DepthFrame, robot: Sequence[RobotPart], elapsed: float, *, n_taken: int) -> tuple[_Search, TopDownGrid | None]:
        """Work that poses do not wait for, `elapsed` seconds after the frame before: what a search that ends now found, and the occupancy.

        A frame has a turn or a few (`_TURNS`), of which taking up better outlines took `n_taken`. Which work a frame does follows from
        stamps and counts alone. As long as no object is known, each frame is searched at once.
        """
        if not self._tracked:
            search = self._find(frame, robot)
            occupancy = self._occupancy(frame, robot) if _is_due(frame, self._last_occupancy, self.settings.occupancy_period) else None
            self._check_plane(frame)
            return search, occupancy
        n_turns = int(np.clip(np.rint(min(elapsed, 1.0) * _TURNS), 1, _MOST_TURNS)) - n_taken
        if not any(known.is_tracked for known in self._tracked.values()):
            n_turns = max(n_turns, _WHOLE_SEARCH)  # no pose is late
        search, occupancy = _Search(), None
        while n_turns > 0:
            n_turns -= 1
            if self._look is not None:
                ended = self._look_on(self._look, frame, robot)
                if ended is not None:
                    search, n_turns = ended, n_turns + 1  # what the segments are is soon known: that takes no turn
            elif _is_due(frame, self._last_occupancy, self.settings.occupancy_period):
                occupancy = self._occupancy(frame, robot)
            elif _is_due(frame, self._last_plane, self.settings.occupancy_period):
                self._check_plane(frame)
            elif _is_due(frame, self._last_search, self.settings.search_period) and not (self._is_outline_next and self.is_refining):
                self._look = self._begin_look(frame, robot)
                self._look_on(self._look, frame, robot)
            else:
                self._rests.go_on(1)
                self._is_outline_next = False
        return search, occupancy

    def _occupancy(self, frame: DepthFrame, robot: Sequence[RobotPart]) -> TopDownGrid | None:
        self._last_occupancy = frame.stamp
        if not self._makes_occupancy:
            return None  # its turn passes all the same: which work a frame does stays as it is in a live cell
        points = points_in_table(frame, self._camera)
        return top_down(points, label_pixels(points, robot, self.limits), self.limits)

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

    def _track(self, frame: DepthFrame, robot: Sequence[RobotPart], elapsed: float) -> dict[str, PoseFit]:
        """Fit all known objects near their predicted poses, `elapsed` seconds after the frame before."""
        fits = {}
        to_check = self._to_check(frame, elapsed)
        for name, known in self._tracked.items():
            if not known.announced:
                continue  # where it was in an earlier run is no place to start from
            start = known.predicted(frame.stamp)
            fit = fit_pose(known.template, self._scene(name, frame, robot), start)
            jumped = np.hypot(*(fit.pose - start)[:2]) > _MAX_JUMP[0] or abs(fit.pose[2] - start[2]) > _MAX_JUMP[1]
            if fit.can_start_next and jumped:
                # With most of the object behind the arm, a fit may slide to a pose that no visible pixel contradicts.
                fit = replace(fit, status=TrackStatus.POOR_FIT)
            fits[name] = self._accept(name, fit, frame, robot, is_due=name in to_check)
        return fits

    def _to_check(self, frame: DepthFrame, elapsed: float) -> list[str]:
        """The objects to check in this frame for missing parts: each once in a search period, those not checked for longest first.

        While a search is under way they wait, at most for another period.
        """
        period = self.settings.search_period
        share = elapsed / period if elapsed < period else 1.0
        wait = period if self._look is None else 2.0 * period
        due = [name for name, known in self._tracked.items() if _is_due(frame, known.checked, wait)]
        return sorted(due, key=lambda name: self._tracked[name].checked)[: int(np.ceil(share * len(self._tracked)))]

    def _accept(self, name: str, fit: PoseFit, frame: DepthFrame, robot: Sequence[RobotPart], *, is_due: bool) -> PoseFit:
        """Take the fit of an object, unless a part of it is missing there; the fit with the status that results.

        `is_due`: whether the object is to be checked for missing parts though nothing speaks for any.
        """
        known = self._tracked[name]
        doubtful = known.status is not TrackStatus.TRACKED or fit.share_contradicting > _DOUBTFUL
        if fit.status in (TrackStatus.TRACKED, TrackStatus.POOR_FIT) and (doubtful or is_due):
            known.checked = frame.stamp
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
            other.placed
            for other_name, other in self._tracked.items()
            if other_name != name
            and other.status is TrackStatus.TRACKED
            and np.linalg.norm(other.pose[:2] - own.pose[:2]) < other.template.radius + own.template.radius + 0.03
        ]

    def _find(self, frame: DepthFrame, robot: Sequence[RobotPart]) -> _Search:
        """A whole search in one frame."""
        started = self._begin_look(frame, robot)
        return self._explain(started, all_at_once(started.work), frame, robot)

    def _begin_look(self, frame: DepthFrame, robot: Sequence[RobotPart]) -> Look:
        """Begin a search, with what is known now."""
        assert self._plane is not None
        self._last_search = frame.stamp
        work = look(frame, self._camera, robot, self.limits)
        tracked = {name: known.placed for name, known in self._tracked.items() if known.is_tracked}
        return Look(work, frame.stamp, self._camera, self._plane, tuple(robot), tracked, self._at_rest(), self._rests.frames)

    def _look_on(self, started: Look, frame: DepthFrame, robot: Sequence[RobotPart]) -> _Search | None:
        """Do the next part of the search; what it found when that was the last one."""
        self._look = None  # an error ends it
        try:
            next(started.work)
        except StopIteration as end:
            self._is_outline_next = True
            return self._explain(started, end.value, frame, robot)
        self._look = started
        return None

    def _explain(self, started: Look, seen: Seen, frame: DepthFrame, robot: Sequence[RobotPart]) -> _Search:
        """What the segments of a search are: known objects, lost ones, which are fitted to this frame, and new ones."""
        self._begin_refinements(started, seen)
        points, found = seen.covered.points, {}
        tracked = {name: known.placed for name, known in self._tracked.items() if known.is_tracked} | started.tracked
        unexplained = self._unexplained(seen.segments, points, list(tracked.values()))
        for name, known in self._tracked.items():
            if known.is_tracked:
                continue
            fit = self._find_again(name, known, unexplained, frame, robot)
            if fit is not None:
                self._parting.found(name)
                known.accept(fit, frame.stamp)
                found[name] = fit
                unexplained = self._unexplained(unexplained, points, [known.placed])
        unexplained, touching, removed = self._parting.refuse(unexplained, points, self.settings.rest_frames)
        whole = [segment for segment in unexplained if segment.whole]
        traced, waiting = self._registration.update(whole, seen.covered, started.camera, started.plane, self.limits)
        cut = [refusal_of(segment, points, segment.fault) for segment in unexplained if segment.fault is not None]
        self._refused = (*cut, *touching, *waiting)
        new = {self._add(thing, started.stamp): thing for thing in traced}
        removed += self._parting.taken_in(new)
        for removal in removed:
            del self._tracked[removal.object_id]
            self._rests.forget(removal.object_id)
        self._search_counts = seen.counts
        return _Search(
            found,
            self._announce() | {name: thing.traced.shape for name, thing in new.items()},
            self._registration.further_views,
            {name: thing.doubt for name, thing in new.items() if thing.doubt},
            tuple(removed),
        )

    def _at_rest(self) -> dict[str, Resting]:
        """Objects at rest for long enough that their outlines may get better."""
        at_rest = {name: self._rests.wants(name, known.traced) for name, known in self._tracked.items() if known.is_tracked}
        # What belongs to which of two objects near each other cannot be told.
        return {
            name: (self._tracked[name].traced, self._tracked[name].template, pose)
            for name, pose in at_rest.items()
            if pose is not None and not self._others(name)
        }

    def _begin_refinements(self, started: Look, seen: Seen) -> None:
        """Begin to give known objects at rest a better outline."""
        if not started.at_rest:
            return
        points = seen.covered.points
        segments = [(segment, points[segment.rows, segment.columns][segment.mask]) for segment in seen.segments]
        for name, placed in started.at_rest.items():
            self._rests.begin_refinement(name, placed, segments, started, self.settings.min_object_height)

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

    def _unexplained(self, segments: Sequence[Segment], points: NDArray[np.float32], tracked: Sequence[Placed]) -> list[Segment]:
        """The segments that are none of these objects."""
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

    def _check_plane(self, frame: DepthFrame) -> None:
        assert self._plane is not None
        self._last_plane = frame.stamp
        points = points_in_table(frame, self._camera)
        try:
            plane = plane_now(self._plane, points, lambda: points_in_table(frame, self._extrinsics), self.settings)
        except PerceptionError:
            self._table_hidden += 1  # The robot may cover the table for a while; the plane in use remains valid.
            return
        if plane is not self._plane:
            self._use_plane(plane)


def _is_due(frame: DepthFrame, last: float, period: float) -> bool:
    """Whether something that was last done at `last` [s] is to be done in this frame: not twice in one."""
    return last < frame.stamp and frame.stamp - last >= period - _ROUNDING
