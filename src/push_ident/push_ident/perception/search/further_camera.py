"""A camera beside the main one: its view of an object at rest, registered to the pose that the main camera measured.

A taller part of an object hides what is behind it from one camera; a second camera elsewhere sees it. A view of the second camera is used
only where both cameras agree on the table and on the object.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import PerceptionError
from push_ident.geometry.outline import polygon_area
from push_ident.geometry.se2 import compose, inverse, rotation, wrap_angle
from push_ident.perception.frame.robot import RobotPart
from push_ident.perception.frame.table import fit_table
from push_ident.perception.frame.view import FrameView, median_frame, points_in_table
from push_ident.perception.known_object import ON_OBJECT, Segment, SegmentedView, Template, TracedObject, TrackStatus
from push_ident.perception.outline.edges import relative_size
from push_ident.perception.search.segments import find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking.pose_fit import fit_pose
from push_ident.types import DepthFrame, Float64Array


class FurtherCamera:
    """The latest frames of one camera that does not move."""

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

        Raises:
            PerceptionError: The view shows too little of the object, or contradicts the main camera; the text gives the numbers.
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
