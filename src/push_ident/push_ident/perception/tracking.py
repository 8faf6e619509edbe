"""Pose of a known object in each frame.

Every pixel near the object says one of two things: its line of sight is stopped by the upper part of the object (full), or it
passes and sees something lower (empty). For a pose T the line of sight is stopped where the piece of it between the top of the
object and a little below lies inside the outline, so with the signed distance d (negative inside) of both ends of that piece

    expected(T) = sigmoid(-min(d(T^-1 a), d(T^-1 b)) / s)

and the pose is the least-squares fit of the expected to the seen, by Gauss-Newton, first with a wide s, then with a narrow one.
Pixels that see something higher (a hand, the pusher) or nothing say nothing and are left out, so occlusion does not pull.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import rotation, transform_points, wrap_angle
from push_ident.perception.depth import check_size, rays_in_table
from push_ident.perception.kernels import compare, deciding_places, distances, meet_object, nearest_values
from push_ident.perception.labels import RobotPart, in_robot
from push_ident.perception.shape import SeenObject
from push_ident.types import BoolArray, DepthFrame, Float64Array

__all__ = ["LinesOfSight", "PoseFit", "Template", "TrackStatus", "fit_pose", "lines_of_sight", "relocate"]

_GRID: Final = 0.001
"""Edge of a cell of the signed distance field [m]."""
_MARGIN: Final = 0.04
"""Of the field around the outline [m]; further out the distance is held."""
_LEVELS: Final = ((0.006, 0.02, 3, 8), (0.0015, 0.006, 1, 8))
"""Width s [m], half width of the band of pixels used [m], stride over pixels, iterations: wide, then narrow."""
_STEP: Final = 0.005
"""A line of sight counts as stopped this far below the top, if that is above half height [m]: three times the noise of a height."""
_ABOVE: Final = 0.01
"""Points this far above the top belong to something in front [m]."""
_MIN_PIXELS: Final = 120
"""Fewer pixels in the narrow band are no measurement."""
_MIN_SHARE: Final = 0.25
"""Of the pixels in the narrow band that must say something."""
_CLEAR: Final = 0.003
"""Pixels that far from the edge are off it [m]."""
_MAX_WRONG: Final = 0.2
"""Share of the pixels off the edge that may contradict the pose."""
_FOUND_VISIBLE: Final = 0.7
"""Share of the pixels in the narrow band that must say something where an object is found again."""
_FOUND_WRONG: Final = 0.08
"""Largest share of contradicting pixels there."""
_FITS_ALIKE: Final = 0.02
"""Headings whose shares of contradicting pixels differ by less are both possible."""
_SURE_BUT_HIDDEN: Final = (0.02, 300, 0.002, 0.03)
"""A fit to an object that is mostly hidden still says where it went when at most such a share of the pixels contradicts it, so many
pixels speak, and its deviations [m, rad] are smaller."""
_FLOOR: Final = (6e-5, 6e-5, 3e-4)
"""Standard deviations no fit goes below [m, m, rad]: errors of outline and calibration, which no residual shows."""
_COHERENCE: Final = 1.4
"""By how much errors of neighbouring pixels, which share an error of the outline, weigh more than as many independent ones: measured
with `push-ident experiment perception` on other seeds than it reports."""
_MAX_DEVIATION: Final = (0.01, 0.01, 0.2)
"""Standard deviations above which a pose is no use [m, m, rad]."""


class TrackStatus(Enum):
    """How a pose came about; the value says what to do about it."""

    TRACKED = "tracked"
    HIDDEN = "too little of the object is visible; move the robot out of the way"
    POOR_FIT = "what is seen does not fit the outline; the object was tipped, lifted, or replaced"
    UNDETERMINED = "what is visible of the object leaves its pose open; move the robot out of the way"
    OUT_OF_VIEW = "the object left the image or the workspace; put it back"


@dataclass(frozen=True, slots=True)
class PoseFit:
    """Pose of one object in one frame. When the status is not TRACKED, pose and covariance must not be used."""

    status: TrackStatus
    pose: Float64Array
    """(x, y, yaw) [m, m, rad], table frame."""
    covariance: Float64Array
    """Shape (3, 3), table frame, positive definite."""
    n_pixels: int
    """Pixels in the narrow band that said something."""
    share_visible: float
    """Share of the pixels in the narrow band that said something."""
    share_wrong: float
    """Share of the pixels clearly inside or outside that contradict the pose."""

    @property
    def leads_on(self) -> bool:
        """Whether the next frame may start from here: also from a pose too hidden to be told to others, if what is seen agrees with it."""
        wrong, n_pixels, position, yaw = _SURE_BUT_HIDDEN
        return self.status is TrackStatus.TRACKED or (
            self.status is TrackStatus.HIDDEN
            and self.share_wrong < wrong
            and self.n_pixels > n_pixels
            and bool(np.all(np.diag(self.covariance) < np.square((position, position, yaw))))
        )


class Template:
    """What the tracker knows of an object: the signed distance field of its outline and the heights of its upper side."""

    def __init__(self, seen: SeenObject) -> None:
        self.outline = seen.shape.outline
        self.tops: Final = (seen.top.astype(np.float64, order="C"), np.array(seen.top_origin, dtype=np.float64), float(seen.top_resolution))
        """Heights of the upper side, as the kernels take a grid."""
        origin = self.outline.min(axis=0) - _MARGIN
        columns, rows = (int(n) for n in np.ceil((self.outline.max(axis=0) + _MARGIN - origin) / (4 * _GRID)) * 4 + 1)
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        nodes = origin + _GRID * np.stack([x, y], axis=-1)
        # Exact where it matters; further out every fourth node and the straight line between them will do.
        coarse = signed_distance(nodes[::4, ::4].reshape(-1, 2), self.outline).reshape(nodes[::4, ::4].shape[:2])
        along_x = np.array([np.interp(np.arange(columns), np.arange(0, columns, 4), row) for row in coarse])
        distance = np.array([np.interp(np.arange(rows), np.arange(0, rows, 4), column) for column in along_x.T]).T.copy()
        near = np.abs(distance) < 0.012
        distance[near] = signed_distance(nodes[near], self.outline)
        self.field: Final = (distance, origin, _GRID)
        """Signed distance of the outline, as the kernels take a grid."""
        self.top_range = float(seen.top.min()), float(seen.top.max())
        self.radius = float(np.linalg.norm(self.outline, axis=1).max())
        """Of the circle around the origin that holds the outline [m]."""

    def distance(self, points: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Signed distance [m], shape (n,), and its gradient, shape (n, 2), at points (n, 2) in the object frame."""
        value, gradient = distances(*self.field, np.ascontiguousarray(points, dtype=np.float64))
        return value, gradient

    def distance_nearby(self, points: NDArray[np.floating]) -> Float64Array:
        """Signed distance [m] of the nearest node of the field, shape (n,): quicker, and good to half its edge."""
        return np.asarray(nearest_values(*self.field, np.ascontiguousarray(points, dtype=np.float64)))


@dataclass(frozen=True, slots=True)
class LinesOfSight:
    """Lines of sight near an object, those that say something."""

    upper: Float64Array
    """Where they pass the height of the top [m], shape (n, 2), table frame."""
    lower: Float64Array
    """Where they pass a little below."""
    stopped: Float64Array
    """1 where the object stops them, 0 where they pass, shape (n,)."""
    n_silent: int
    """Lines of sight in the narrow band that say nothing."""

    def deciding(self, template: Template, pose: Float64Array) -> Float64Array:
        """The place of each line that decides whether it is stopped at `pose`: whichever end is further inside, object frame."""
        return np.asarray(deciding_places(*template.field, self.upper, self.lower, np.ascontiguousarray(pose)))


def fit_pose(
    template: Template,
    frame: DepthFrame,
    camera_in_table: ArrayLike,
    start: ArrayLike,
    *,
    robot: Sequence[RobotPart] = (),
    mask_margin: float = 0.006,
    others: Sequence[tuple[Template, Float64Array]] = (),
) -> PoseFit:
    """Fit the pose of the object to one frame.

    Args:
        start: Pose (x, y, yaw) to start from; within about 15 mm and 10 degrees.
        robot: Parts whose pixels say nothing.
        others: Templates and poses of other objects; their pixels say nothing either.
    """
    start = np.asarray(start, dtype=np.float64)
    pose = start.copy()
    lines, comparison = None, None
    for width, band, stride, iterations in _LEVELS:
        lines = lines_of_sight(template, frame, camera_in_table, pose, band, stride, robot, mask_margin, others)
        if lines is None:
            return _failed(TrackStatus.OUT_OF_VIEW, pose)
        if len(lines.stopped) < _MIN_PIXELS / stride**2:
            return _failed(TrackStatus.HIDDEN, pose, lines)
        pose, comparison = _gauss_newton(template, lines, pose, width, iterations)
    assert lines is not None and comparison is not None
    share_visible = len(lines.stopped) / (len(lines.stopped) + lines.n_silent)
    share_wrong = comparison.share_wrong
    independent = np.linalg.inv(comparison.normal + 1e-6 * np.diag([1.0, 1.0, 1e-4]))
    covariance = _COHERENCE * comparison.variance * independent + np.diag(np.square(_FLOOR))
    status = TrackStatus.TRACKED
    if np.hypot(*(pose - start)[:2]) > 0.05 or share_wrong > _MAX_WRONG:
        status = TrackStatus.POOR_FIT
    elif share_visible < _MIN_SHARE:
        status = TrackStatus.HIDDEN
    elif np.any(np.diag(covariance) > np.square(_MAX_DEVIATION)):
        status = TrackStatus.UNDETERMINED
    pose[2] = start[2] + float(wrap_angle(pose[2] - start[2]))
    return PoseFit(status, pose, 0.5 * (covariance + covariance.T), len(lines.stopped), share_visible, share_wrong)


def relocate(
    template: Template,
    frame: DepthFrame,
    camera_in_table: ArrayLike,
    centre: ArrayLike,
    *,
    robot: Sequence[RobotPart] = (),
    mask_margin: float = 0.006,
    others: Sequence[tuple[Template, Float64Array]] = (),
    last_yaw: float | None = None,
) -> PoseFit:
    """Find a lost object at `centre` (x, y) [m] whatever its yaw: compare all headings coarsely, fit from the best three.

    Where several headings fit alike, as those of a nearly symmetric object do, the one nearest `last_yaw` [rad] is taken.
    """
    everywhere = template.radius + _MARGIN
    headings = np.linspace(-np.pi, np.pi, 36, endpoint=False)
    starts = [np.array([*np.asarray(centre, dtype=np.float64), heading]) for heading in headings]
    lines = lines_of_sight(template, frame, camera_in_table, starts[0], everywhere, 4, robot, mask_margin, others)
    if lines is None or len(lines.stopped) == 0:
        return _failed(TrackStatus.OUT_OF_VIEW, starts[0])
    misfit = np.array([_compare(template, lines, start, 2 * _LEVELS[0][0]).misfit for start in starts])
    valleys = np.flatnonzero((misfit <= np.roll(misfit, 1)) & (misfit <= np.roll(misfit, -1)))
    fits = [
        fit_pose(template, frame, camera_in_table, starts[index], robot=robot, mask_margin=mask_margin, others=others)
        for index in valleys[np.argsort(misfit[valleys])][:3]
    ]
    best = min(fits, key=lambda fit: (fit.status is not TrackStatus.TRACKED, fit.share_wrong))
    if last_yaw is not None:
        alike = [fit for fit in fits if fit.status is best.status and fit.share_wrong < best.share_wrong + _FITS_ALIKE]
        best = min(alike, key=lambda fit: abs(float(wrap_angle(fit.pose[2] - last_yaw))))
    # Without a pose before, half an object can be taken for the other half.
    if best.status is TrackStatus.TRACKED and (best.share_visible < _FOUND_VISIBLE or best.share_wrong > _FOUND_WRONG):
        return replace(best, status=TrackStatus.HIDDEN)
    return best


def lines_of_sight(
    template: Template,
    frame: DepthFrame,
    camera_in_table: ArrayLike,
    pose: Float64Array,
    band: float,
    stride: int,
    robot: Sequence[RobotPart] = (),
    mask_margin: float = 0.006,
    others: Sequence[tuple[Template, Float64Array]] = (),
) -> LinesOfSight | None:
    """Lines of sight that pass the outline at `pose` within `band` [m]; None where the object is not in the image.

    Raises:
        FrameError: The image has another size than its camera info.
    """
    check_size(frame)
    pose = np.ascontiguousarray(pose, dtype=np.float64)
    camera = np.asarray(camera_in_table, dtype=np.float64)
    box = _image_box(template, frame, camera, pose, band)
    if box is None:
        return None
    rows, columns = box
    centre, rays = rays_in_table(frame.intrinsics, camera)
    level, slack = float(np.mean(template.top_range)), 0.5 * (template.top_range[1] - template.top_range[0])
    upper, lower, seen, stopped, speaks = meet_object(
        *template.field,
        *template.tops,
        np.asarray(frame.depth, dtype=np.float32),
        rays,
        centre,
        pose,
        (rows.start, rows.stop, columns.start, columns.stop, stride),
        (level, band + slack, _STEP, _ABOVE),
    )
    speaks &= ~in_robot(seen, robot, mask_margin)
    speaks &= ~_in_others(seen, others)
    return LinesOfSight(upper[speaks], lower[speaks], stopped[speaks], int(np.count_nonzero(~speaks)))


def _image_box(
    template: Template, frame: DepthFrame, camera_in_table: Float64Array, pose: Float64Array, band: float
) -> tuple[slice, slice] | None:
    """Rows and columns that show the outline at `pose`, grown by `band`; None when its origin is outside the image."""
    outline = transform_points(pose, template.outline)
    low, high = outline.min(axis=0) - band, outline.max(axis=0) + band
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.0, template.top_range[1])])
    points = np.vstack([corners, [pose[0], pose[1], 0.5 * template.top_range[1]]])
    in_camera = (points - camera_in_table[:3, 3]) @ camera_in_table[:3, :3]
    if np.any(in_camera[:, 2] <= 0):
        return None
    intrinsics = frame.intrinsics
    u = intrinsics.fx * in_camera[:, 0] / in_camera[:, 2] + intrinsics.cx
    v = intrinsics.fy * in_camera[:, 1] / in_camera[:, 2] + intrinsics.cy
    if not (0 <= u[-1] < intrinsics.width and 0 <= v[-1] < intrinsics.height):
        return None
    rows = slice(max(0, int(v.min())), min(intrinsics.height, int(v.max()) + 2))
    columns = slice(max(0, int(u.min())), min(intrinsics.width, int(u.max()) + 2))
    return rows, columns


def _in_others(points: NDArray[np.float32], others: Sequence[tuple[Template, Float64Array]]) -> BoolArray:
    inside = np.zeros(len(points), dtype=bool)
    for other, pose in others:
        in_other = np.nan_to_num((points[:, :2] - pose[:2]) @ rotation(pose[2]), nan=1e3)
        inside |= (other.distance_nearby(in_other) < 0.003) & (points[:, 2] > 0.5 * other.top_range[0])
    return inside


@dataclass(frozen=True, slots=True)
class _Comparison:
    """What is seen against what is expected at one pose."""

    normal: Float64Array
    """J'J, shape (3, 3), of the expected by the pose."""
    pull: Float64Array
    """J'r, shape (3,)."""
    misfit: float
    """Mean square of the residuals."""
    variance: float
    """The same near the edge."""
    share_wrong: float
    """Share of the lines clearly inside or outside that contradict the pose."""


def _compare(template: Template, lines: LinesOfSight, pose: Float64Array, width: float) -> _Comparison:
    return _Comparison(*compare(*template.field, lines.upper, lines.lower, lines.stopped, pose, (width, 3.0 * width, _CLEAR)))


def _gauss_newton(
    template: Template, lines: LinesOfSight, pose: Float64Array, width: float, iterations: int
) -> tuple[Float64Array, _Comparison]:
    """Fitted pose and the comparison there."""
    for _ in range(iterations):
        now = _compare(template, lines, pose, width)
        damping = 1e-3 * np.diag(np.diag(now.normal)) + np.diag([1.0, 1.0, 1e-4])
        step = np.linalg.solve(now.normal + damping, now.pull)
        # A step longer than the width leaves the reach of the linearisation.
        step *= min(1.0, 2.0 * width / max(float(np.hypot(step[0], step[1])), template.radius * abs(float(step[2])), 1e-12))
        pose = pose + step
        if np.hypot(step[0], step[1]) < 2e-5 and abs(step[2]) < 2e-4:
            break
    return pose, _compare(template, lines, pose, width)


def _failed(status: TrackStatus, pose: Float64Array, lines: LinesOfSight | None = None) -> PoseFit:
    n_pixels = 0 if lines is None else len(lines.stopped)
    share = 0.0 if lines is None else n_pixels / max(n_pixels + lines.n_silent, 1)
    return PoseFit(status, pose, np.diag([1.0, 1.0, 10.0]), n_pixels, share, 1.0)
