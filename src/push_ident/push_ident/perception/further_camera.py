"""A camera beside the main one: what it saw of an object while that was at rest, brought to where the main camera has it.

One camera never sees past a taller part of an object; a second one that stands elsewhere does. What it says is used only where both
agree on everything they both see: the table, and the object on it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import PerceptionError
from push_ident.geometry.outline import polygon_area
from push_ident.geometry.se2 import compose, inverse, rotation, wrap_angle
from push_ident.perception.depth import points_in_table
from push_ident.perception.fusion import View, size_in
from push_ident.perception.labels import RobotPart, label_pixels
from push_ident.perception.segments import Segment, find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.shape import SeenObject, Sight, mean_depth
from push_ident.perception.table import fit_table
from push_ident.perception.tracking import Template, TrackStatus, fit_pose
from push_ident.types import DepthFrame, Float64Array

__all__ = ["FurtherCamera"]

_KEPT: Final = 20
"""Frames kept: those of the last moments of a rest."""
_APART: Final = 0.05
"""Frames that much before or after the rest still belong to it, as no two cameras take theirs at once [s]."""
_NEEDED: Final = 1 / 3
"""Frames needed during a rest, in those of the main camera."""
_NEAR: Final = 0.008
"""Points this near to the object may be its own [m]."""
_AREA: Final = (0.7, 1.4)
"""Range of what the segment covers, in areas of the object."""
_MAX_SHIFT: Final = 0.005
"""Larger distances from where the main camera has the object mean wrong extrinsics [m]."""
_MAX_TURN: Final = 0.05
"""Likewise [rad]."""
_MAX_WRONG: Final = 0.08
"""Share of the lines of sight clear of its edge that may contradict the object as the main camera has it."""
_MAX_GROWTH: Final = 0.0012
"""By which the farthest edge may be further out than for the main camera [m]. With two true cameras up to 0.75 mm were measured, from
what one of them does not see; from 1.2 mm on the second one made some outlines worse."""


@dataclass(frozen=True, slots=True)
class _Shot:
    frame: DepthFrame
    robot: tuple[RobotPart, ...]


class FurtherCamera:
    """Keeps the latest frames of one camera that stands still."""

    def __init__(self) -> None:
        self._shots: deque[_Shot] = deque(maxlen=_KEPT)
        self._extrinsics = np.eye(4)

    def see(self, frame: DepthFrame, camera_in_table: ArrayLike, robot: Sequence[RobotPart] = ()) -> None:
        """Keep a frame.

        Args:
            camera_in_table: Optical frame in the table frame, shape (4, 4), from the extrinsics.
            robot: Where tool and arm were when the frame was taken.
        """
        extrinsics = np.array(camera_in_table, dtype=np.float64)
        if self._shots:
            last = self._shots[-1].frame
            # Nothing is kept across a bag that starts again, another resolution, or a camera that was moved.
            if frame.stamp < last.stamp or frame.intrinsics != last.intrinsics or not np.array_equal(extrinsics, self._extrinsics):
                self._shots.clear()
        self._extrinsics = extrinsics
        self._shots.append(_Shot(frame, tuple(robot)))

    def sight_of(self, seen: SeenObject, began: float, ended: float, settings: PerceptionSettings) -> Sight:
        """What this camera saw of an object at rest, its pose corrected so that table and object are where the main camera has them.

        Args:
            seen: The object as the main camera has it.
            began, ended: Of its rest [s].

        Raises:
            PerceptionError: It saw too little of it, or something else than the main camera; the text says what.
        """
        shots = self._during(began, ended, settings.rest_frames)
        last = shots[-1].frame
        mean = DepthFrame(last.stamp, mean_depth([shot.frame for shot in shots]), last.intrinsics, last.frame_id)
        robot = [part for shot in shots for part in shot.robot]
        plane = fit_table(points_in_table(mean, self._extrinsics), settings)
        camera = plane.correct(self._extrinsics)
        template = Template(seen)
        segment = _segment_of(seen, template, mean, camera, robot, settings)
        fit = fit_pose(template, mean, camera, seen.pose, robot=robot, mask_margin=settings.mask_margin)
        if fit.status is not TrackStatus.TRACKED:
            raise PerceptionError(f"The object as the main camera has it is not found: {fit.status.value}.")
        shift, turn = float(np.linalg.norm(fit.pose[:2] - seen.pose[:2])), abs(float(wrap_angle(fit.pose[2] - seen.pose[2])))
        if shift > _MAX_SHIFT or turn > _MAX_TURN or fit.share_wrong > _MAX_WRONG:
            raise PerceptionError(
                f"The object is {shift * 1e3:.1f} mm and {np.degrees(turn):.1f} degrees from where the main camera has it, and "
                f"{fit.share_wrong:.0%} of the lines of sight contradict its outline, expected at most {_MAX_SHIFT * 1e3:.0f} mm, "
                f"{np.degrees(_MAX_TURN):.1f} degrees and {_MAX_WRONG:.0%}; check the extrinsics of both cameras."
            )
        camera = _moved(camera, compose(seen.pose, inverse(fit.pose)))
        growth = template.radius * (size_in(View(mean, camera, seen.pose, robot), seen) - 1.0)
        if abs(growth) > _MAX_GROWTH:
            raise PerceptionError(
                f"The farthest edge of the object is {growth * 1e3:+.1f} mm from where the main camera has it, expected within "
                f"{_MAX_GROWTH * 1e3:.1f} mm; check the camera infos and the unit of the depth of both cameras."
            )
        return Sight(mean, camera, segment, plane.noise)

    def _during(self, began: float, ended: float, rest_frames: int) -> list[_Shot]:
        shots = [shot for shot in self._shots if began - _APART <= shot.frame.stamp <= ended + _APART]
        needed = int(np.ceil(_NEEDED * rest_frames))
        if len(shots) < needed:
            late = f"the latest is from {ended - self._shots[-1].frame.stamp:.2f} s before its end" if self._shots else "there are none"
            raise PerceptionError(
                f"{len(shots)} depth frames show the {ended - began:.2f} s of rest, expected at least {needed}; {late}. "
                "Check the driver, its clock, and rest_frames."
            )
        return shots[-rest_frames:]


def _segment_of(
    seen: SeenObject, template: Template, frame: DepthFrame, camera: Float64Array, robot: Sequence[RobotPart], settings: PerceptionSettings
) -> Segment:
    """The pixels of the object, which must be seen whole."""
    points = points_in_table(frame, camera)
    segments, _ = find_segments(frame, points, label_pixels(points, robot, settings), settings)
    turn = rotation(seen.pose[2])

    def share_in(segment: Segment) -> float:
        places = points[segment.rows, segment.columns][segment.mask][:, :2]
        return float(np.mean(template.distance_nearby((places - seen.pose[:2]) @ turn) < _NEAR))

    segment = max(segments, key=share_in, default=None)
    if segment is None or share_in(segment) < 0.5:
        raise PerceptionError(f"None of {len(segments)} segments lies where the main camera has the object; check the extrinsics.")
    if not segment.whole:
        raise PerceptionError("The object is beside the robot, cut by the border of the image, or behind another; move what is in the way.")
    area = abs(polygon_area(seen.shape.outline))
    if not _AREA[0] * area < segment.area < _AREA[1] * area:
        raise PerceptionError(
            f"The object covers {segment.area * 1e4:.1f} cm^2, for the main camera {area * 1e4:.1f} cm^2; "
            "see that it is in full view of both and min_step divides it in neither."
        )
    return segment


def _moved(camera_in_table: Float64Array, motion: Float64Array) -> Float64Array:
    """The camera moved by a planar motion (x, y, yaw) about the origin of `table`."""
    transform = np.eye(4)
    transform[:2, :2], transform[:2, 3] = rotation(motion[2]), motion[:2]
    return np.asarray(transform @ camera_in_table)
