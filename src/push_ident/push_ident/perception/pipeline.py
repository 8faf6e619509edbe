"""The whole of perception: one depth frame in, the objects on the table out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, Protocol

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
from push_ident.perception.outline.rests import Rests
from push_ident.perception.refusals import Reason
from push_ident.perception.search.search import N_PARTS, Search
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking.pose_fit import fit_pose
from push_ident.perception.tracking.separation import Separation
from push_ident.perception.tracking.tracker import KnownObjects, Tracker
from push_ident.types import DepthFrame, Float64Array, ObjectShape

__all__ = ["BackgroundWork", "Job", "Perception"]

_TURNS: Final = 30.0
"""Turns of the background work for each second between two frames [1/s]: one for each frame of a usual camera. A turn is a part of a search
or of a better outline, an occupancy grid or a check of the plane, each 3 to 15 ms."""
_MOST_TURNS: Final = 10
"""Largest number of turns in one frame, as of a camera of a few frames a second."""
_WHOLE_SEARCH: Final = N_PARTS + 2
"""Turns in which a search begins and ends, though an occupancy grid and a check of the plane are due."""


class Job(Protocol):
    """Work that poses do not wait for, done a part at a time. What it gives is taken from it after the frame."""

    @property
    def is_under_way(self) -> bool:
        """Whether it is to go on before another job begins."""

    def due(self, view: FrameView) -> bool:
        """Whether it is to be done in this frame."""

    def step(self, view: FrameView) -> int:
        """Do the next part with this frame; the turns that took."""


class BackgroundWork:
    """Shares the turns that a frame has among the jobs. Which work a frame does follows from stamps and counts alone."""

    def __init__(self, table: TableCamera, objects: KnownObjects, search: Search, occupancy: OccupancyMap, rests: Rests) -> None:
        self._table, self._objects, self._search, self._occupancy = table, objects, search, occupancy
        self._jobs: tuple[Job, ...] = (occupancy, table, search, rests)
        """In the order of their precedence; the last one is always due."""

    def run(self, view: FrameView, elapsed: float, *, n_taken: int) -> None:
        """Work on the frame, `elapsed` seconds after the one before, of whose turns `n_taken` are gone.

        As long as no object is known, each frame is searched at once.
        """
        if not self._objects:
            while self._search.step(view):
                pass
            if self._occupancy.due(view):
                self._occupancy.step(view)
            self._table.step(view)
            return
        n_turns = int(np.clip(np.rint(min(elapsed, 1.0) * _TURNS), 1, _MOST_TURNS)) - n_taken
        if not self._objects.tracked():
            n_turns = max(n_turns, _WHOLE_SEARCH)  # no pose is late
        while n_turns > 0:
            view = self._table.current(view)
            n_turns -= self._next_job(view).step(view)

    def _next_job(self, view: FrameView) -> Job:
        return next((job for job in self._jobs if job.is_under_way), None) or next(job for job in self._jobs if job.due(view))


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
            settings: ranges and thresholds.
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
        separation = Separation()
        self._tracker = Tracker(self._objects, separation)
        self._search = Search(self._table, self._objects, self._tracker, separation, self._rests)
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

    @property
    def is_refining(self) -> bool:
        """Whether a better outline is being worked on."""
        return self._rests.is_refining

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
        return KnownObject(known.traced, known.area, known.pose)

    def first_pose(self, object_id: str) -> Float64Array:
        """Pose (x, y, yaw) of a known object when it was registered, table frame: it defines the object frame."""
        return self._objects[object_id].first_pose

    def add_further_view(self, name: str, frame: DepthFrame, camera_in_table: ArrayLike, robot: Sequence[RobotPart] = ()) -> None:
        """Keep a frame of a further camera for tracing objects at rest; poses come from the main camera only.

        Args:
            name: Name of the camera.
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
        frame = usable_frame(frame)
        elapsed = frame.stamp - self._last_stamp
        restarted, n_valid = self._check(frame)
        view = self._table.view(frame, robot)
        self._last_stamp = frame.stamp
        fits = self._tracker.track(view, elapsed, is_searching=self._search.is_under_way)
        ready, not_refined = self._rests.take_refined()
        refined, not_adopted = self._tracker.adopt(ready, view, fits)
        self._rests.note(frame, fits, self.settings.rest_frames)
        if on_poses is not None and fits:
            on_poses(_observed(fits))
        self._background.run(view, elapsed, n_taken=bool(refined))
        search = self._search.take_result()
        objects = _observed({name: fit for name, fit in (fits | search.fits).items() if name in self._objects})
        return Observation(
            frame.stamp,
            objects,
            search.new_shapes,
            self._counts(frame, n_valid, objects),
            self._search.refused,
            self._occupancy.take_grid(),
            search.further_views,
            restarted,
            refined,
            not_refined | not_adopted,
            search.doubts,
            search.removed,
        )

    def finish(self) -> dict[str, ObjectShape]:
        """Better shapes that the frames so far give, by id, of known objects: after the last frame of a recording nothing is late."""
        self._rests.finish()
        ready, _ = self._rests.take_refined()
        for name, (better, template) in ready.items():
            self._objects[name].adopt(better, template)
        return {name: better.traced.shape for name, (better, _) in ready.items()}

    def _check(self, frame: DepthFrame) -> tuple[bool, int]:
        """Whether time went back, and the number of valid pixels of a frame that can be used."""
        if frame.stamp == self._last_stamp:
            raise FrameError(f"Depth frame repeats the stamp {frame.stamp:.6f} s; the camera driver or the bag repeats frames.")
        restarted = frame.stamp < self._last_stamp
        if restarted:
            self.reset()
        n_valid = int(np.count_nonzero(np.isfinite(frame.depth)))
        if n_valid == 0:
            raise PerceptionError(f"Depth image has 0 valid of {frame.depth.size} pixels; check the camera and its range.")
        return restarted, n_valid

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
    """Known objects as their fits say; without a pose unless TRACKED."""
    is_tracked = {name: fit.status is TrackStatus.TRACKED for name, fit in fits.items()}
    return tuple(
        ObservedObject(name, fit.status, fit.pose if is_tracked[name] else None, fit.covariance if is_tracked[name] else None)
        for name, fit in fits.items()
    )
