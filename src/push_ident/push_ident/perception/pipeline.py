"""All of perception: one frame in, what lies on the table out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import FrameError, PerceptionError
from push_ident.geometry.se2 import rotation
from push_ident.perception.depth import points_in_table
from push_ident.perception.further_camera import FurtherCamera
from push_ident.perception.fusion import View, fuse_views
from push_ident.perception.labels import ROBOT, TABLE, RobotPart, label_pixels
from push_ident.perception.segments import Segment, find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.shape import SeenObject, Sight, mean_depth, see_object
from push_ident.perception.table import TablePlane, fit_table
from push_ident.perception.topdown import TopDownGrid, top_down
from push_ident.perception.tracking import PoseFit, Template, TrackStatus, fit_pose, relocate
from push_ident.types import DepthFrame, Float64Array, ObjectShape, PoseTrack

__all__ = ["Observation", "ObservedObject", "Perception", "observe_offline"]

_MAX_JUMP: Final = (0.02, 0.2)
"""No object that is pushed goes further from where it is expected between two frames [m, rad]."""
_PREDICT: Final = 0.2
"""An older pose says nothing of the velocity any more [s]."""
_MOVED: Final = 0.0015
"""A table plane that far from the one in use replaces it [m]."""
_SAME_AREA: Final = (0.4, 1.6)
"""Range of the area of a segment, in areas of a lost object, that may be that object."""


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
    """What one frame tells."""

    stamp: float
    """[s]"""
    objects: tuple[ObservedObject, ...]
    new_shapes: dict[str, ObjectShape]
    """Of the objects taken in with this frame."""
    counts: dict[str, int]
    """What each stage let through: `pixels`, `valid`, `tracked`, `lost`, and of the last search `table`, `robot`, `object_pixels`,
    `segments`, `too_small`, `beside_robot_or_cut`, `behind_another`, `waiting`; `table_hidden` counts the checks of the plane that
    saw too little of it."""
    occupancy: TopDownGrid | None
    """At its own, lower rate."""
    further_views: dict[str, str]
    """When an object was taken in: why what a further camera, by name, saw of it was left out; empty when it was used."""
    restarted: bool = False
    """Time went back, so everything known before was dropped."""

    def why_nothing(self) -> str:
        """Why no pose comes out; empty when one does."""
        if any(seen.status is TrackStatus.TRACKED for seen in self.objects):
            return ""
        if self.objects:
            return "; ".join(f"object {seen.object_id}: {seen.status.value}" for seen in self.objects)
        counts = self.counts
        if counts["waiting"]:
            return f"{counts['waiting']} new objects are watched until they are at rest"
        if counts["beside_robot_or_cut"]:
            return f"{counts['beside_robot_or_cut']} segments touch the robot, the image border or the workspace border"
        if counts["behind_another"]:
            return f"{counts['behind_another']} segments are partly hidden behind another; move the nearer one out of the way"
        if counts["too_small"]:
            return f"{counts['too_small']} segments are smaller than min_object_area"
        return f"nothing on the table is higher than min_object_height ({counts['table']} pixels see the table)"


@dataclass(slots=True)
class _Tracked:
    template: Template
    shape: ObjectShape
    area: float
    first_pose: Float64Array
    pose: Float64Array
    stamp: float
    velocity: Float64Array = field(default_factory=lambda: np.zeros(3))
    status: TrackStatus = TrackStatus.TRACKED

    def predicted(self, stamp: float) -> Float64Array:
        age = stamp - self.stamp
        return self.pose + self.velocity * age if 0 < age < _PREDICT else self.pose

    def accept(self, fit: PoseFit, stamp: float) -> None:
        self.status = fit.status
        if not fit.leads_on:
            self.velocity = np.zeros(3)
            return
        age = stamp - self.stamp
        self.velocity = (fit.pose - self.pose) / age if 0 < age < _PREDICT else np.zeros(3)
        self.pose, self.stamp = fit.pose, stamp


@dataclass(slots=True)
class _Waiting:
    segment: Segment
    frames: list[DepthFrame]


class Perception:
    """Keeps what is known from frame to frame: the table plane, the objects and where they were last.

    An object is taken in when it was seen whole, clear of the robot and at rest, in `rest_frames` searches in a row. It then keeps
    its shape and its id ("o1", "o2", ...: no part of a ROS topic may begin with a digit), and gets a pose in each frame, or a
    status that says why not.
    """

    def __init__(self, camera_in_table: ArrayLike, settings: PerceptionSettings | None = None) -> None:
        """`camera_in_table`: optical frame in the table frame, homogeneous, shape (4, 4), from the extrinsics."""
        self._extrinsics = np.array(camera_in_table, dtype=np.float64)
        self.settings = settings or PerceptionSettings()
        self.reset()

    def reset(self) -> None:
        """Forget everything seen."""
        self._plane: TablePlane | None = None
        self._camera = self._extrinsics
        self._tracked: dict[str, _Tracked] = {}
        self._waiting: list[_Waiting] = []
        self._search_counts = dict.fromkeys(
            ("table", "robot", "object_pixels", "segments", "too_small", "beside_robot_or_cut", "behind_another", "waiting"), 0
        )
        self._table_hidden = 0
        self._further: dict[str, FurtherCamera] = {}
        self._further_views: dict[str, str] = {}
        self._last_stamp = self._last_search = self._last_occupancy = -np.inf

    @property
    def plane(self) -> TablePlane | None:
        """The table plane in use; None before the first frame."""
        return self._plane

    @property
    def camera_in_table(self) -> Float64Array:
        """Optical frame in the table frame, shape (4, 4): the extrinsics, corrected by the plane of the table."""
        return self._camera

    def first_pose(self, object_id: str) -> Float64Array:
        """Pose (x, y, yaw) of a known object when it was taken in, table frame: it defines the object frame."""
        return self._tracked[object_id].first_pose

    def observe(
        self,
        frame: DepthFrame,
        robot: Sequence[RobotPart] = (),
        on_poses: Callable[[tuple[ObservedObject, ...]], None] | None = None,
    ) -> Observation:
        """Take in one frame.

        Args:
            frame: Later than the one before; an earlier one drops everything known (a bag that starts again).
            robot: Where tool and arm are, so that they are taken neither for an object nor for free table.
            on_poses: Called with the objects followed into this frame, before the slower search for others and the occupancy.

        Raises:
            FrameError: The frame repeats a stamp, or its size does not fit its camera info.
            PerceptionError: Nothing valid is seen, or no table.
        """
        if frame.stamp == self._last_stamp:
            raise FrameError(f"Depth frame repeats the stamp {frame.stamp:.6f} s; the camera driver or the bag doubles frames.")
        restarted = frame.stamp < self._last_stamp
        if restarted:
            self.reset()
        self._further_views = {}
        n_valid = int(np.count_nonzero(np.isfinite(frame.depth)))
        if n_valid == 0:
            raise PerceptionError(f"Depth image has 0 valid of {frame.depth.size} pixels; check the camera and its range.")
        if self._plane is None:
            self._use_plane(fit_table(points_in_table(frame, self._extrinsics), self.settings))
        self._last_stamp = frame.stamp

        fits = self._track(frame, robot)
        if on_poses is not None and fits:
            on_poses(tuple(_observed(name, fit) for name, fit in fits.items()))
        # A millisecond less than the period, so that a camera at just that rate does not miss every other turn by rounding.
        occupancy_due = frame.stamp - self._last_occupancy >= self.settings.occupancy_period - 1e-3
        search_due = not self._tracked or frame.stamp - self._last_search >= self.settings.search_period - 1e-3
        if occupancy_due and self._tracked:
            search_due = False  # both in one frame would make the next one wait
        new_shapes: dict[str, ObjectShape] = {}
        occupancy = None
        if occupancy_due or search_due:
            points = points_in_table(frame, self._camera)
            labels = label_pixels(points, robot, self.settings)
            if search_due:
                fits.update(self._search(frame, points, labels, robot))
                new_shapes = self._take_in(frame.stamp)
                self._search_counts["waiting"] = len(self._waiting)
            if occupancy_due:
                occupancy = top_down(points, labels, self.settings)
                self._last_occupancy = frame.stamp
                self._check_plane(frame, points)
        objects = tuple(_observed(name, fit) for name, fit in fits.items())
        n_tracked = sum(seen.status is TrackStatus.TRACKED for seen in objects)
        counts = {
            "pixels": frame.depth.size,
            "valid": n_valid,
            "tracked": n_tracked,
            "lost": len(objects) - n_tracked,
            **self._search_counts,
            "table_hidden": self._table_hidden,
        }
        return Observation(frame.stamp, objects, new_shapes, counts, occupancy, self._further_views, restarted)

    def see_also(self, name: str, frame: DepthFrame, camera_in_table: ArrayLike, robot: Sequence[RobotPart] = ()) -> None:
        """Keep a frame of a further camera for the shape of an object that is at rest; poses come from the main camera alone.

        Args:
            name: Of the camera.
            camera_in_table: Its optical frame in the table frame, shape (4, 4), from its extrinsics.
            robot: Where tool and arm were when the frame was taken.
        """
        self._further.setdefault(name, FurtherCamera()).see(frame, camera_in_table, robot)

    def fit(self, object_id: str, frame: DepthFrame, robot: Sequence[RobotPart] = ()) -> PoseFit:
        """Pose of a known object in another frame near the latest, for frames seen before the object was known."""
        known = self._tracked[object_id]
        return fit_pose(known.template, frame, self._camera, known.pose, robot=robot, mask_margin=self.settings.mask_margin)

    def _track(self, frame: DepthFrame, robot: Sequence[RobotPart]) -> dict[str, PoseFit]:
        fits = {}
        for name, known in self._tracked.items():
            start = known.predicted(frame.stamp)
            margin = self.settings.mask_margin
            fit = fit_pose(known.template, frame, self._camera, start, robot=robot, mask_margin=margin, others=self._others(name))
            if fit.leads_on and (np.hypot(*(fit.pose - start)[:2]) > _MAX_JUMP[0] or abs(fit.pose[2] - start[2]) > _MAX_JUMP[1]):
                # With most of the object behind the arm, a fit may slide to where nothing contradicts it.
                fit = replace(fit, status=TrackStatus.POOR_FIT)
            known.accept(fit, frame.stamp)
            fits[name] = fit
        return fits

    def _others(self, name: str) -> list[tuple[Template, Float64Array]]:
        """Other objects near enough to be mistaken for parts of this one."""
        me = self._tracked[name]
        return [
            (other.template, other.pose)
            for other_name, other in self._tracked.items()
            if other_name != name
            and other.status is TrackStatus.TRACKED
            and np.linalg.norm(other.pose[:2] - me.pose[:2]) < other.template.radius + me.template.radius + 0.03
        ]

    def _search(
        self, frame: DepthFrame, points: NDArray[np.float32], labels: NDArray[np.int8], robot: Sequence[RobotPart]
    ) -> dict[str, PoseFit]:
        """Look for lost and new objects over the whole image; fits of the objects found again."""
        self._last_search = frame.stamp
        segments, counts = find_segments(frame, points, labels, self.settings)
        unexplained = [segment for segment in segments if not self._explained(segment, points)]
        found: dict[str, PoseFit] = {}
        for name, known in self._tracked.items():
            if known.status is TrackStatus.TRACKED:
                continue
            for segment in unexplained:
                if not _SAME_AREA[0] * known.area < segment.area < _SAME_AREA[1] * known.area:
                    continue
                margin = self.settings.mask_margin
                fit = relocate(
                    known.template,
                    frame,
                    self._camera,
                    segment.centre,
                    robot=robot,
                    mask_margin=margin,
                    others=self._others(name),
                    last_yaw=float(known.pose[2]),
                )
                if fit.status is TrackStatus.TRACKED:
                    known.accept(fit, frame.stamp)
                    found[name] = fit
                    unexplained = [other for other in unexplained if not self._explained(other, points)]
                    break
        self._waiting = [self._continued(segment, frame) for segment in unexplained if segment.whole]
        table, on_robot = int(np.count_nonzero(labels == TABLE)), int(np.count_nonzero(labels == ROBOT))
        self._search_counts = {"table": table, "robot": on_robot, **counts, "waiting": 0}
        return found

    def _explained(self, segment: Segment, points: NDArray[np.float32]) -> bool:
        """Whether most of the segment lies in the outline of a tracked object."""
        seen = points[segment.rows, segment.columns][segment.mask][:, :2]
        return any(
            float(np.mean(known.template.distance_nearby((seen - known.pose[:2]) @ rotation(known.pose[2])) < 0.008)) > 0.5
            for known in self._tracked.values()
            if known.status is TrackStatus.TRACKED
        )

    def _continued(self, segment: Segment, frame: DepthFrame) -> _Waiting:
        """The segment with the frames in which it was at the same place, this one included."""
        for waiting in self._waiting:
            moved = float(np.linalg.norm(segment.centre - waiting.segment.centre))
            if moved < self.settings.rest_distance and abs(segment.area - waiting.segment.area) < 0.15 * segment.area:
                return _Waiting(segment, [*waiting.frames, frame])
        return _Waiting(segment, [frame])

    def _take_in(self, stamp: float) -> dict[str, ObjectShape]:
        """Turn what was at rest for long enough into objects."""
        assert self._plane is not None
        new_shapes = {}
        for waiting in [w for w in self._waiting if len(w.frames) >= self.settings.rest_frames]:
            self._waiting.remove(waiting)
            last = waiting.frames[-1]
            mean = DepthFrame(last.stamp, mean_depth(waiting.frames), last.intrinsics, last.frame_id)
            first = Sight(mean, self._camera, waiting.segment, self._plane.noise / np.sqrt(len(waiting.frames)))
            seen, sights = self._traced_by_all(first, waiting.frames[0].stamp, last.stamp)
            seen = fuse_views(seen, [View(sight.frame, sight.camera_in_table, seen.pose) for sight in sights], pose_known=True)
            name = f"o{len(self._tracked) + 1}"
            self._tracked[name] = _Tracked(Template(seen), seen.shape, waiting.segment.area, seen.pose, seen.pose, stamp)
            new_shapes[name] = seen.shape
        return new_shapes

    def _traced(self, sights: Sequence[Sight]) -> SeenObject:
        return see_object(sights, min_height=self.settings.min_object_height, cell_count=self.settings.cell_count)

    def _traced_by_all(self, first: Sight, began: float, ended: float) -> tuple[SeenObject, list[Sight]]:
        """The object from the main camera's sight and those of further cameras that agree with it, and all these sights."""
        seen, sights = self._traced([first]), [first]
        for name, camera in self._further.items():
            try:
                together = [*sights, camera.sight_of(seen, began, ended, self.settings)]
                seen, sights = self._traced(together), together
                self._further_views.setdefault(name, "")
            except (FrameError, PerceptionError) as error:
                self._further_views[name] = str(error)
        return seen, sights

    def _use_plane(self, plane: TablePlane) -> None:
        self._plane = plane
        self._camera = plane.correct(self._extrinsics)

    def _check_plane(self, frame: DepthFrame, points: NDArray[np.float32]) -> None:
        """Follow a table or camera that was moved; smaller differences are noise and would only make the poses jump."""
        try:
            moved = fit_table(points, self.settings)
            (x0, y0), (x1, y1) = self.settings.workspace_low, self.settings.workspace_high
            if max(abs(moved.height(x, y)) for x, y in ((x0, y0), (x0, y1), (x1, y0), (x1, y1))) > _MOVED:
                self._use_plane(fit_table(points_in_table(frame, self._extrinsics), self.settings))
        except PerceptionError:
            # The robot may cover the table for a while; the plane in use still holds.
            self._table_hidden += 1


def observe_offline(
    frames: Iterable[DepthFrame],
    camera_in_table: ArrayLike,
    *,
    robot_at: Callable[[float], Sequence[RobotPart]] | None = None,
    settings: PerceptionSettings | None = None,
) -> dict[str, tuple[ObjectShape, PoseTrack]]:
    """Shapes and tracks of all objects in a recording that holds only depth.

    The frames at rest from which an object was taken in get poses as well. Frames in which it was lost are missing in its track.

    Args:
        frames: In order of their stamps.
        robot_at: Parts of the robot at a time [s].

    Raises:
        PerceptionError: Nothing came out; the text says at which stage.
    """
    perception = Perception(camera_in_table, settings)
    before: deque[DepthFrame] = deque(maxlen=perception.settings.rest_frames)
    shapes: dict[str, ObjectShape] = {}
    tracks: dict[str, list[tuple[float, Float64Array, Float64Array]]] = {}
    n_frames, why = 0, "there are no frames"
    for frame in frames:
        robot = robot_at(frame.stamp) if robot_at is not None else ()
        n_frames += 1
        try:
            seen = perception.observe(frame, robot)
        except (FrameError, PerceptionError) as error:
            why = str(error)
            continue
        if seen.restarted:
            raise PerceptionError(f"Time goes back at {frame.stamp:.3f} s in the recording; cut it there and take the parts one by one.")
        before.append(frame)
        for name, shape in seen.new_shapes.items():
            shapes[name] = shape
            fits = [(old.stamp, perception.fit(name, old, robot_at(old.stamp) if robot_at is not None else ())) for old in before]
            tracks[name] = [(stamp, fit.pose, fit.covariance) for stamp, fit in fits if fit.status is TrackStatus.TRACKED]
        for known in seen.objects:
            if known.pose is not None and known.covariance is not None:
                tracks[known.object_id].append((seen.stamp, known.pose, known.covariance))
        why = seen.why_nothing()
    result = {
        name: (shapes[name], PoseTrack(*(np.array(column) for column in zip(*track, strict=True))))
        for name, track in tracks.items()
        if len(track) >= 2
    }
    if not result:
        raise PerceptionError(f"No object came out of {n_frames} depth frames: {why or 'each was seen in fewer than two frames'}.")
    return result


def _observed(name: str, fit: PoseFit) -> ObservedObject:
    if fit.status is not TrackStatus.TRACKED:
        return ObservedObject(name, fit.status, None, None)
    return ObservedObject(name, fit.status, fit.pose, fit.covariance)
