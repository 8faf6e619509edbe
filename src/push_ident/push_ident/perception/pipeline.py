"""The whole of perception: one depth frame in, the objects on the table out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import FrameError, PerceptionError
from push_ident.perception.frame.depth_image import usable_frame
from push_ident.perception.frame.occupancy import OccupancyMap
from push_ident.perception.frame.robot import RobotPart
from push_ident.perception.frame.table import TableCamera, TablePlane
from push_ident.perception.frame.view import FrameView
from push_ident.perception.known_object import KnownObject, PoseFit, TrackStatus
from push_ident.perception.observation import Observation, ObservedObject
from push_ident.perception.outline.rests import RestingObject, Rests
from push_ident.perception.refusals import Reason
from push_ident.perception.search.search import N_PARTS, Search, SearchResult
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking.pose_fit import fit_pose
from push_ident.perception.tracking.tracker import KnownObjects, Tracker
from push_ident.types import DepthFrame, Float64Array, ObjectShape

_TURNS: Final = 30.0
"""Turns of the background work for each second between two frames [1/s]: one for each frame of a usual camera. A turn is a part of a search
or of a better outline, an occupancy grid or a check of the plane, each 3 to 15 ms."""
_MOST_TURNS: Final = 10
"""Largest number of turns in one frame, as of a camera of a few frames a second."""


class BackgroundWork:
    """Work that poses do not wait for, a part at a time: searches, occupancy grids, checks of the plane, better outlines.

    Which work a frame does follows from stamps and counts alone.
    """

    def __init__(self, table: TableCamera, objects: KnownObjects, search: Search, occupancy: OccupancyMap, rests: Rests) -> None:
        self._table, self._objects, self._search, self._occupancy, self._rests = table, objects, search, occupancy, rests
        self._at_rest: tuple[RestingObject, ...] = ()
        """When the search under way began."""
        self._search_ended = False
        """Since the last turn of a better outline."""

    def run(self, view: FrameView, elapsed: float, *, n_taken: int) -> SearchResult | None:
        """Work on the frame, `elapsed` seconds after the one before, of whose turns `n_taken` are gone; what a search found that ended.

        As long as no object is known, each frame is searched at once.
        """
        found: SearchResult | None = None
        self._occupancy.grid = None
        if not self._objects:
            while found is None:
                found = self._search_step(view)
            if view.is_due(self._occupancy.last, view.settings.occupancy_period):
                self._occupancy.step(view)
            self._table.check_plane(view)
            return found
        n_turns = int(np.clip(np.rint(min(elapsed, 1.0) * _TURNS), 1, _MOST_TURNS)) - n_taken
        if not self._objects.tracked():
            n_turns = max(n_turns, N_PARTS + 2)  # No pose is late: a search begins and ends, though grid and plane are due.
        while n_turns > 0:
            view = self._table.current(view)
            ended = self._do_next(view)
            found = ended or found
            n_turns -= ended is None  # What the segments of a search are is soon known: that takes no turn.
        return found

    def _do_next(self, view: FrameView) -> SearchResult | None:
        """Do the next part of what is most urgent. After a search, a better outline that is under way has a turn before another search."""
        settings, waits = view.settings, self._search_ended and self._rests.is_refining
        if self._search.is_under_way:
            return self._search_step(view)
        if view.is_due(self._occupancy.last, settings.occupancy_period):
            self._occupancy.step(view)
        elif view.is_due(self._table.last_check, settings.occupancy_period):
            self._table.check_plane(view)
        elif view.is_due(self._search.last, settings.search_period) and not waits:
            return self._search_step(view)
        else:
            self._search_ended = False
            self._rests.step()
        return None

    def _search_step(self, view: FrameView) -> SearchResult | None:
        """Do the next part of a search. At its end, objects that it shows whole in a new rest get a better outline."""
        if not self._search.is_under_way:
            self._at_rest = self._rests.resting(self._objects)
        found = self._search.step(view)
        if found is not None:
            self._search_ended = True
            self._rests.begin_refinements(self._at_rest, found.segments, found.covered.view, self._table.settings.min_object_height)
            for name, thing in found.new.items():
                self._rests.begin(name, thing.views, thing.traced.pose)
            for removal in found.removed:
                self._rests.forget(removal.object_id)
        return found


class Perception:
    """Perception with memory: the table plane, the objects and their latest poses.

    An object is registered when it was visible as a whole, clear of the robot and at rest, in `rest_frames` searches in a row. From then
    on it keeps its shape and its id ("o1", "o2", ...), and gets a pose in each frame, or a status that gives the reason for the missing
    pose.
    """

    def __init__(self, camera_in_table: ArrayLike, settings: PerceptionSettings | None = None, *, occupancy: bool = True) -> None:
        """Begin with nothing known.

        Args:
            camera_in_table: optical frame in the table frame, homogeneous, shape (4, 4), from the extrinsics.
            occupancy: whether to make the occupancy grid; without it, poses and shapes are the same.
        """
        self._extrinsics = np.array(camera_in_table, dtype=np.float64)
        self._makes_occupancy = occupancy
        self._begin(settings or PerceptionSettings())

    def reset(self) -> None:
        """Forget the table plane and all objects."""
        self._begin(self.settings)

    def _begin(self, settings: PerceptionSettings) -> None:
        self._table = TableCamera(self._extrinsics, settings)
        self._objects = KnownObjects()
        self._rests = Rests()
        self._tracker = Tracker(self._objects)
        self._search = Search(self._objects, self._tracker)
        self._occupancy = OccupancyMap(makes_grid=self._makes_occupancy)
        self._background = BackgroundWork(self._table, self._objects, self._search, self._occupancy, self._rests)
        self._last_stamp = -np.inf

    @property
    def settings(self) -> PerceptionSettings:
        """Ranges and thresholds; may be replaced between frames."""
        return self._table.settings

    @settings.setter
    def settings(self, settings: PerceptionSettings) -> None:
        """Use these from the next frame on."""
        self._table.settings = settings

    @property
    def plane(self) -> TablePlane | None:
        """The table plane in use; None before the first frame."""
        return self._table.plane

    @property
    def camera_in_table(self) -> Float64Array:
        """Optical frame in the table frame, shape (4, 4): the extrinsics, corrected by the plane of the table."""
        return self._table.camera_in_table

    def view(self, frame: DepthFrame, robot: Sequence[RobotPart] = ()) -> FrameView:
        """A frame of this camera with the limits in force.

        Raises:
            FrameError: The size of the image differs from its camera info.
            PerceptionError: No table is found in the first frame.
        """
        return self._table.view(frame, robot)

    def remember(self, objects: Mapping[str, KnownObject]) -> None:
        """Look for objects of an earlier run as for lost ones: they keep their ids, shapes and object frames.

        To be called before the first frame, and again where time went back.
        """
        for name, known in objects.items():
            self._objects.remember(name, known)
            self._rests.begin(name)

    def known(self, object_id: str) -> KnownObject:
        """A known object, for `remember`."""
        known = self._objects[object_id]
        return KnownObject(known.template.traced, known.area, known.pose)

    def first_pose(self, object_id: str) -> Float64Array:
        """Pose (x, y, yaw) of a known object when it was registered, table frame: it defines the object frame."""
        return self._objects[object_id].template.traced.pose

    def add_further_view(self, name: str, frame: DepthFrame, camera_in_table: ArrayLike, robot: Sequence[RobotPart] = ()) -> None:
        """Keep a frame of a further camera for tracing objects at rest; poses come from the main camera only.

        Args:
            camera_in_table: Its optical frame in the table frame, shape (4, 4), from its extrinsics.
            robot: Parts of the robot when the frame was taken.
        """
        self._search.registration.add_further_view(name, frame, camera_in_table, robot)

    def fit(self, object_id: str, frame: DepthFrame, robot: Sequence[RobotPart] = ()) -> PoseFit:
        """Pose of a known object in another frame near its latest pose, for frames taken before the object was registered."""
        known = self._objects[object_id]
        return fit_pose(known.template, self._table.view(frame, robot), known.pose)

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
        frame, elapsed, restarted, n_valid = self._accepted(frame)
        view = self._table.view(frame, robot)
        self._last_stamp = frame.stamp
        ready, not_refined = self._rests.take_refined()
        fits = self._tracker.track(view, elapsed, is_searching=self._search.is_under_way)
        refined, not_adopted = self._tracker.adopt(ready, view, fits)
        self._rests.note(frame, fits, view.settings.rest_frames)
        if on_poses is not None and fits:
            on_poses(_observed(fits))
        found = self._background.run(view, elapsed, n_taken=bool(refined))
        new = found.new if found else {}
        if found:
            fits |= found.fits
        objects = _observed({name: fit for name, fit in fits.items() if name in self._objects})
        return Observation(
            frame.stamp,
            objects,
            (found.announced if found else {}) | {name: thing.traced.shape for name, thing in new.items()},
            self._counts(frame, n_valid, objects),
            self._search.refused,
            self._occupancy.grid,
            found.further_views if found else {},
            restarted,
            refined,
            not_refined | not_adopted,
            {name: thing.doubt for name, thing in new.items() if thing.doubt},
            found.removed if found else (),
        )

    def finish(self) -> dict[str, ObjectShape]:
        """Better shapes that the frames so far give, by id, of known objects: after the last frame of a recording nothing is late."""
        self._rests.finish()
        ready, _ = self._rests.take_refined()
        for name, (better, template) in ready.items():
            self._objects[name].template, self._objects[name].area = template, better.area
        return {name: better.traced.shape for name, (better, _) in ready.items()}

    def _accepted(self, frame: DepthFrame) -> tuple[DepthFrame, float, bool, int]:
        """A frame that can be used, the time since the one before [s], whether time went back, and its number of valid pixels."""
        frame = usable_frame(frame)
        elapsed = frame.stamp - self._last_stamp
        if elapsed == 0.0:
            raise FrameError(f"Depth frame repeats the stamp {frame.stamp:.6f} s; the camera driver or the bag repeats frames.")
        if elapsed < 0.0:
            self.reset()
        n_valid = int(np.count_nonzero(np.isfinite(frame.depth)))
        if n_valid == 0:
            raise PerceptionError(f"Depth image has 0 valid of {frame.depth.size} pixels; check the camera and its range.")
        return frame, elapsed, elapsed < 0.0, n_valid

    def _counts(self, frame: DepthFrame, n_valid: int, objects: Sequence[ObservedObject]) -> dict[str, int]:
        n_tracked = sum(known.status is TrackStatus.TRACKED for known in objects)
        return {
            "pixels": frame.depth.size,
            "valid": n_valid,
            "tracked": n_tracked,
            "lost": len(objects) - n_tracked,
            **self._search.counts,
            **{reason.name.lower(): sum(refusal.reason is reason for refusal in self._search.refused) for reason in Reason},
            "table_hidden": self._table.n_hidden,
        }


def _observed(fits: Mapping[str, PoseFit]) -> tuple[ObservedObject, ...]:
    is_tracked = {name: fit.status is TrackStatus.TRACKED for name, fit in fits.items()}
    return tuple(
        ObservedObject(name, fit.status, fit.pose if is_tracked[name] else None, fit.covariance if is_tracked[name] else None)
        for name, fit in fits.items()
    )
