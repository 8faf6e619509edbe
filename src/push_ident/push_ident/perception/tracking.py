"""Pose of a known object in each frame.

Every pixel near the object gives a binary measurement: its line of sight is stopped by the upper part of the object (full), or it
passes and meets something lower (empty). For a pose T the line of sight is stopped where the piece of it between the top of the
object and a little below lies inside the outline. With the signed distance d (negative inside) of both ends of that piece,

    expected(T) = sigmoid(-min(d(T^-1 a), d(T^-1 b)) / s)

and the pose is the least-squares fit of the expected to the measured, by Gauss-Newton, first with a wide s, then with a narrow one.
Pixels that measure something higher (a hand, the pusher) or nothing carry no information and are left out, so that occlusion does not
bias the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.geometry.se2 import rotation, transform_points, wrap_angle
from push_ident.perception.depth import rays_in_table
from push_ident.perception.depth_image import check_size
from push_ident.perception.kernels import (
    Grid,
    compare_lines,
    displaced_scores,
    innermost_points,
    interpolate,
    intersect_object,
    nearest_values,
    scores_of_squares,
)
from push_ident.perception.labels import RobotPart, in_robot
from push_ident.perception.lasting import displaced_pose, in_table
from push_ident.perception.shape import TracedObject, unmeasured_areas
from push_ident.perception.shape_kernels import outline_distances
from push_ident.types import BoolArray, DepthFrame, Float64Array

__all__ = ["LinesOfSight", "PoseFit", "Scene", "Template", "TrackStatus", "displaced_by_camera", "fit_pose", "lines_of_sight", "relocate"]

_GRID: Final = 0.001
"""Edge of a cell of the signed distance field [m]."""
_MARGIN: Final = 0.04
"""Width of the field around the outline [m]; further out the distance is held."""
_LEVELS: Final = ((0.006, 0.02, 3, 8, 3e-4), (0.0015, 0.006, 1, 8, 2e-5))
"""Width s [m], half width of the band of pixels used [m], stride over pixels, most iterations, and the step that ends them [m]: wide, then
narrow. The wide one ends at a fifth of the narrow width, far inside the reach of the narrow one."""
_TURN: Final = 10.0
"""Turn that ends the iterations, per metre of the step that does [rad/m]: that of an edge 10 cm from the middle."""
_OVERSHOOT: Final = 1.5
"""Second derivative of half the sum of squares over J'J near the best pose [-]. The measured changes at the edge at once, the expected over
the width s: across an edge, with e = sigmoid(-d / s), the integral of e'^2 is 1 / (6 s), and that of the residual times -e'' 1 / (12 s).
A full step of Gauss-Newton thus ends half as far beyond the best pose as it began before it."""
_STEP: Final = 0.005
"""A line of sight counts as stopped this far below the top, if that is above half height [m]: three times the noise of a height."""
_ABOVE: Final = 0.01
"""Points this far above the top belong to something in front [m]."""
_MIN_PIXELS: Final = 120
"""Least number of informative pixels in the narrow band."""
_MIN_SHARE: Final = 0.25
"""Least fraction of the pixels in the narrow band that must be informative."""
_CLEAR: Final = 0.003
"""Pixels further than this from the edge can contradict a pose [m]."""
_MAX_CONTRADICTING: Final = 0.2
"""Largest fraction of the pixels away from the edge that may contradict the pose."""
_FOUND_VISIBLE: Final = 0.7
"""Least fraction of informative pixels in the narrow band where a lost object is found again."""
_FOUND_CONTRADICTING: Final = 0.08
"""Largest fraction of contradicting pixels where a lost object is found again."""
_EQUAL_FIT: Final = 0.02
"""Headings whose fractions of contradicting pixels differ by less fit equally well."""
_START_CONTRADICTING: Final = 0.02
"""A pose that is too hidden to be published may start the next fit if at most this fraction of the pixels contradicts it ..."""
_START_PIXELS: Final = 300
"""... more than this number of pixels is informative ..."""
_START_DEVIATION: Final = (0.002, 0.002, 0.03)
"""... and its standard deviations are smaller [m, m, rad]."""
_FLOOR: Final = (6e-5, 6e-5, 3e-4)
"""Least standard deviations of a pose [m, m, rad]: errors of outline and calibration, which no residual shows."""
_SQUARE: Final = 0.02
"""Edge of the squares of the object within which residuals may be correlated [m]: the window of a matcher is 7 to 9 px, 10 to 20 mm."""
_MAX_DEVIATION: Final = (0.01, 0.01, 0.2)
"""A pose with larger standard deviations is not used [m, m, rad]."""
_SHY: Final = 0.005
"""Lines of sight nearer to an unmeasured area are left out [m]: as far as the narrow width of the fit reaches."""
_UNCERTAIN: Final = 0.004
"""The place of a step of the upper side, and of the edge of a hollow, is known to this [m]: two cells of the heights."""
_DAMPING: Final = np.array([1.0, 1.0, 1e-4])
"""Added to the diagonal of the normal matrix of a pose (x, y, yaw) [1/m^2, 1/m^2, 1]."""


class TrackStatus(Enum):
    """Outcome of a pose fit; the value says what to do about it."""

    TRACKED = "tracked"
    HIDDEN = "too little of the object is visible; move the robot out of the way"
    POOR_FIT = "the measured depth does not fit the outline; the object was tipped, lifted, or replaced"
    PART_MISSING = "a part of it is gone from its place: it is several things, or it was tipped; move the robot away and wait"
    UNDETERMINED = "the visible part of the object does not determine its pose; move the robot out of the way"
    OUT_OF_VIEW = "the object left the image or the workspace; put it back"


@dataclass(frozen=True, slots=True)
class PoseFit:
    """Pose of one object in one frame. Unless the status is TRACKED, pose and covariance must not be used."""

    status: TrackStatus
    pose: Float64Array
    """(x, y, yaw) [m, m, rad], table frame."""
    covariance: Float64Array
    """Shape (3, 3), table frame, positive definite."""
    n_pixels: int
    """Number of informative pixels in the narrow band."""
    share_visible: float
    """Fraction of the pixels in the narrow band that are informative."""
    share_contradicting: float
    """Fraction of the pixels clearly inside or outside that contradict the pose."""
    residual_covariance: Float64Array = field(default_factory=lambda: np.zeros((3, 3)))
    """The part of the covariance that the residuals of the frame show: without the errors that last (`lasting`)."""

    @property
    def can_start_next(self) -> bool:
        """Whether the fit of the next frame may start from this pose. That includes poses too hidden to be published, if every visible
        pixel agrees with them."""
        return self.status is TrackStatus.TRACKED or (
            self.status is TrackStatus.HIDDEN
            and self.share_contradicting < _START_CONTRADICTING
            and self.n_pixels > _START_PIXELS
            and bool(np.all(np.diag(self.covariance) < np.square(_START_DEVIATION)))
        )


class Template:
    """What the tracker needs of an object: the signed distance field of its outline and the heights of its upper side."""

    def __init__(self, traced: TracedObject) -> None:
        self.outline = traced.shape.outline
        self.first_pose: Final = traced.pose
        """Pose that defines the object frame (x, y, yaw) [m, m, rad]."""
        self.displaced_std: Final = traced.displaced_std
        """As of `TracedObject`."""
        self.displaced_frame: Final = np.array(traced.displaced_frame, dtype=np.float64)
        """As of `TracedObject`."""
        self.frame_covariance: Final = np.array(traced.frame_covariance, dtype=np.float64)
        """As of `TracedObject`."""
        self.seen_from: Final = None if traced.seen_from is None else _padded(traced.seen_from)
        """As of `TracedObject`, shape (n_rests, n_cameras, 2); NaN where a rest has fewer cameras."""
        self.tops: Final = Grid(
            traced.top.astype(np.float64, order="C"), np.array(traced.top_origin, dtype=np.float64), float(traced.top_resolution)
        )
        """Heights of the upper side [m]."""
        self.hollow: Final = None if traced.hollow is None else self.tops._replace(values=traced.hollow.astype(np.float64, order="C"))
        """1 in the cells of `tops` that lie over a hollow; None where there is none."""
        around = np.ones(2 * (2 * int(np.ceil(_UNCERTAIN / self.tops.step)) + 1,), np.uint8)
        lowest = cv2.erode(self.tops.values, around)
        if traced.hollow is not None:
            lowest[cv2.dilate(traced.hollow.astype(np.uint8), around) > 0] = 0.0
        self.lowest: Final = self.tops._replace(values=lowest)
        """Lowest height of the upper side nearby [m]: 0 beside a hollow."""
        origin = self.outline.min(axis=0) - _MARGIN
        columns, rows = (int(n) for n in np.ceil((self.outline.max(axis=0) + _MARGIN - origin) / (4 * _GRID)) * 4 + 1)
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        nodes = origin + _GRID * np.stack([x, y], axis=-1)
        # Exact near the outline; further out every fourth node, interpolated linearly, is enough.
        outline = np.ascontiguousarray(self.outline, dtype=np.float64)
        coarse = outline_distances(nodes[::4, ::4].reshape(-1, 2), outline).reshape(nodes[::4, ::4].shape[:2])
        distance = _refined(_refined(coarse, 4).T, 4).T.copy()
        near = np.abs(distance) < 0.012
        distance[near] = outline_distances(nodes[near], outline)
        self.field: Final = Grid(distance, origin, _GRID)
        """Signed distance to the outline [m]."""
        self.top_range = float(traced.top.min()), float(traced.top.max())
        """Lowest and highest point of the upper side [m]."""
        self.radius = float(np.linalg.norm(self.outline, axis=1).max())
        """Radius of the circle around the origin that holds the outline [m]."""

    def distance(self, points: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Signed distance [m], shape (n,), and its gradient, shape (n, 2), at points (n, 2) in the object frame."""
        value, gradient = interpolate(self.field, np.ascontiguousarray(points, dtype=np.float64))
        return value, gradient

    def nearest_distance(self, points: NDArray[np.floating]) -> Float64Array:
        """Signed distance [m] at the nearest node of the field, shape (n,): faster, and accurate to half a cell of the field."""
        return np.asarray(nearest_values(self.field, np.ascontiguousarray(points, dtype=np.float64)))

    def nearest_top(self, points: NDArray[np.floating]) -> Float64Array:
        """Height of the upper side [m] at the nearest cell, shape (n,), at points (n, 2) in the object frame."""
        return np.asarray(nearest_values(self.tops, np.ascontiguousarray(points, dtype=np.float64)))

    def least_top(self, points: NDArray[np.floating]) -> Float64Array:
        """The lowest height of the upper side within some millimetres [m], shape (n,), at points (n, 2) in the object frame."""
        return np.asarray(nearest_values(self.lowest, np.ascontiguousarray(points, dtype=np.float64)))


def _padded(rests: Sequence[Float64Array]) -> Float64Array:
    padded = np.full((len(rests), max(len(places) for places in rests), 2), np.nan)
    for own, places in zip(padded, rests, strict=True):
        own[: len(places)] = places
    return padded


def _refined(values: Float64Array, factor: int) -> Float64Array:
    """Linear interpolation along the rows of `values`, shape (n, m), to `factor` times as many steps, shape (n, factor (m - 1) + 1)."""
    slope = np.diff(values, axis=1) / factor
    between = slope[:, :, None] * np.arange(factor) + values[:, :-1, None]
    return np.hstack([between.reshape(len(values), -1), values[:, -1:]])


@dataclass(frozen=True, slots=True)
class Scene:
    """A depth frame, the pose of its camera, and whatever in it is not the object whose pose is fitted."""

    frame: DepthFrame
    camera_in_table: ArrayLike
    """Optical frame in the table frame, homogeneous, shape (4, 4)."""
    robot: Sequence[RobotPart] = ()
    """Parts of the robot; their pixels are left out."""
    mask_margin: float = 0.006
    """Added to the radius of the robot's parts [m]."""
    others: Sequence[tuple[Template, Float64Array]] = ()
    """Templates and poses of other objects; their pixels are left out."""


@dataclass(frozen=True, slots=True)
class LinesOfSight:
    """The informative lines of sight near an object."""

    upper: Float64Array
    """Where they pass the height of the top [m], shape (n, 2), table frame."""
    lower: Float64Array
    """Where they pass a little below."""
    stopped: Float64Array
    """1 where the object stops them, 0 where they pass, shape (n,)."""
    height: NDArray[np.float32]
    """Height of what they measured [m], shape (n,), table frame."""
    n_uninformative: int
    """Number of lines of sight in the narrow band that carry no information."""

    def innermost_points(self, template: Template, pose: Float64Array) -> Float64Array:
        """Per line the end that decides whether it is stopped at `pose`: the one further inside, object frame, shape (n, 2)."""
        return np.asarray(innermost_points(template.field, self.upper, self.lower, np.ascontiguousarray(pose)))


def fit_pose(template: Template, scene: Scene, start: ArrayLike) -> PoseFit:
    """Fit the pose of the object to one frame.

    Args:
        start: Initial pose (x, y, yaw), within about 15 mm and 10 degrees of the true one.

    Raises:
        FrameError: The size of the image differs from its camera info.
    """
    start = np.asarray(start, dtype=np.float64)
    pose, lines, width = start.copy(), None, 0.0
    for width, band, stride, iterations, enough in _LEVELS:
        lines = lines_of_sight(template, scene, pose, band, stride)
        if lines is None:
            return _failed(TrackStatus.OUT_OF_VIEW, pose)
        if len(lines.stopped) < _MIN_PIXELS / stride**2:
            return _failed(TrackStatus.HIDDEN, pose, lines)
        pose = _gauss_newton(template, lines, pose, width, iterations, enough)
    assert lines is not None
    comparison = _compare(template, lines, pose, width)
    share_visible = len(lines.stopped) / (len(lines.stopped) + lines.n_uninformative)
    share_contradicting = comparison.share_contradicting
    normal = comparison.normal + 1e-6 * np.diag(_DAMPING)
    covariance = comparison.edge_variance * np.linalg.inv(normal) + np.diag(np.square(_FLOOR))
    own_covariance = _at_least(covariance, _jackknife(template, lines, pose, normal))
    covariance = own_covariance + _lasting(template, scene, lines, pose, normal)
    status = TrackStatus.TRACKED
    if np.hypot(*(pose - start)[:2]) > 0.05 or share_contradicting > _MAX_CONTRADICTING:
        status = TrackStatus.POOR_FIT
    elif share_visible < _MIN_SHARE:
        status = TrackStatus.HIDDEN
    elif np.any(np.diag(covariance) > np.square(_MAX_DEVIATION)):
        status = TrackStatus.UNDETERMINED
    pose[2] = start[2] + float(wrap_angle(pose[2] - start[2]))
    covariance = 0.5 * (covariance + covariance.T)
    return PoseFit(status, pose, covariance, len(lines.stopped), share_visible, share_contradicting, own_covariance)


def relocate(template: Template, scene: Scene, centre: ArrayLike, *, last_yaw: float | None = None) -> PoseFit:
    """Find a lost object at `centre` (x, y) [m] with any yaw: compare all headings coarsely, then fit from the best three.

    Where several headings fit equally well, as those of a nearly symmetric object do, the one nearest `last_yaw` [rad] is taken.

    Raises:
        FrameError: The size of the image differs from its camera info.
    """
    everywhere = template.radius + _MARGIN
    headings = np.linspace(-np.pi, np.pi, 36, endpoint=False)
    starts = [np.array([*np.asarray(centre, dtype=np.float64), heading]) for heading in headings]
    lines = lines_of_sight(template, scene, starts[0], everywhere, 4)
    if lines is None or len(lines.stopped) == 0:
        return _failed(TrackStatus.OUT_OF_VIEW, starts[0])
    mean_square = np.array([_compare(template, lines, start, 2 * _LEVELS[0][0]).mean_square for start in starts])
    minima = np.flatnonzero((mean_square <= np.roll(mean_square, 1)) & (mean_square <= np.roll(mean_square, -1)))
    fits = [fit_pose(template, scene, starts[index]) for index in minima[np.argsort(mean_square[minima])][:3]]
    best = min(fits, key=lambda fit: (fit.status is not TrackStatus.TRACKED, fit.share_contradicting))
    if last_yaw is not None:
        equal = [fit for fit in fits if fit.status is best.status and fit.share_contradicting < best.share_contradicting + _EQUAL_FIT]
        best = min(equal, key=lambda fit: abs(float(wrap_angle(fit.pose[2] - last_yaw))))
    # Without a previous pose, one half of an object can be taken for the other half.
    is_doubtful = best.share_visible < _FOUND_VISIBLE or best.share_contradicting > _FOUND_CONTRADICTING
    return replace(best, status=TrackStatus.HIDDEN) if best.status is TrackStatus.TRACKED and is_doubtful else best


def lines_of_sight(template: Template, scene: Scene, pose: Float64Array, band: float, stride: int) -> LinesOfSight | None:
    """Lines of sight that pass the outline at `pose` within `band` [m]; None where the object is not in the image.

    Raises:
        FrameError: The size of the image differs from its camera info.
    """
    frame = scene.frame
    check_size(frame)
    pose = np.ascontiguousarray(pose, dtype=np.float64)
    camera = np.asarray(scene.camera_in_table, dtype=np.float64)
    box = _image_box(template, frame, camera, pose, band)
    if box is None:
        return None
    rows, columns = box
    centre, rays = rays_in_table(frame.intrinsics, camera)
    level, slack = float(np.mean(template.top_range)), 0.5 * (template.top_range[1] - template.top_range[0])
    upper, lower, points, stopped, informative = intersect_object(
        template.field,
        template.tops,
        np.asarray(frame.depth, dtype=np.float32),
        _beside_areas(frame, box),
        rays,
        centre,
        pose,
        (rows.start, rows.stop, columns.start, columns.stop, stride),
        (level, band + slack, _STEP, _ABOVE),
    )
    if template.hollow is not None:
        # What is measured through an opening depends on the walls inside, which nobody knows.
        in_object = (upper - pose[:2]) @ rotation(pose[2])
        solid = nearest_values(template.hollow, np.ascontiguousarray(in_object)) < 0.5
        upper, lower, points, stopped, informative = (values[solid] for values in (upper, lower, points, stopped, informative))
    informative &= ~in_robot(points, scene.robot, scene.mask_margin)
    informative &= ~_in_others(points, scene.others)
    n_uninformative = int(np.count_nonzero(~informative))
    return LinesOfSight(upper[informative], lower[informative], stopped[informative], points[informative, 2], n_uninformative)


def _beside_areas(frame: DepthFrame, box: tuple[slice, slice]) -> NDArray[np.uint8]:
    """Which pixels of the box lie beside an unmeasured area, such as the shadow of the object: 1.

    Where nothing is measured on one side of an edge, the lines of sight of the other side alone would push it into the shadow.
    """
    measured = np.isfinite(frame.depth[box])
    areas = unmeasured_areas(measured)
    if not areas.any():
        return areas
    reach = _SHY * frame.intrinsics.fx / float(np.median(frame.depth[box][measured])) if measured.any() else 0.0
    reach = int(np.ceil(min(reach, max(areas.shape))))  # further than the box there is nothing to mark
    return np.asarray(cv2.dilate(areas, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)))


def _image_box(
    template: Template, frame: DepthFrame, camera_in_table: Float64Array, pose: Float64Array, band: float
) -> tuple[slice, slice] | None:
    """Rows and columns that show the outline at `pose`, grown by `band`; None where its origin is outside the image."""
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
    """Which points, shape (n, 3), lie on another object."""
    inside = np.zeros(len(points), dtype=bool)
    for other, pose in others:
        in_other = np.nan_to_num((points[:, :2] - pose[:2]) @ rotation(pose[2]), nan=1e3)
        inside |= (other.nearest_distance(in_other) < 0.003) & (points[:, 2] > 0.5 * other.top_range[0])
    return inside


@dataclass(frozen=True, slots=True)
class _Comparison:
    """Measured against expected lines of sight at one pose."""

    normal: Float64Array
    """J'J, shape (3, 3), J the derivative of the expected by the pose."""
    gradient: Float64Array
    """J'r, shape (3,)."""
    mean_square: float
    """Mean square of the residuals."""
    edge_variance: float
    """Mean square of the residuals near the edge."""
    share_contradicting: float
    """Fraction of the lines clearly inside or outside that contradict the pose."""


def _compare(template: Template, lines: LinesOfSight, pose: Float64Array, width: float) -> _Comparison:
    return _Comparison(*compare_lines(template.field, lines.upper, lines.lower, lines.stopped, pose, (width, 3.0 * width, _CLEAR)))


def _gauss_newton(
    template: Template, lines: LinesOfSight, pose: Float64Array, width: float, iterations: int, enough: float
) -> Float64Array:
    """Fitted pose, after so many iterations or a step shorter than `enough` [m]."""
    for _ in range(iterations):
        now = _compare(template, lines, pose, width)
        diagonal = np.diag(now.normal)
        damped = now.normal.copy()
        damped.flat[:: len(damped) + 1] = diagonal + (1e-3 * diagonal + _DAMPING)
        step = np.linalg.solve(damped, now.gradient)
        length = max(float(np.hypot(step[0], step[1])), template.radius * abs(float(step[2])), 1e-12)
        # The linearisation does not hold beyond the width.
        step *= 1.0 / _OVERSHOOT if length < width else min(1.0, 2.0 * width / length)
        pose = pose + step
        if np.hypot(step[0], step[1]) < enough and abs(step[2]) < _TURN * enough:
            break
    return pose


def _jackknife(template: Template, lines: LinesOfSight, pose: Float64Array, normal: Float64Array) -> Float64Array:
    """Covariance of the pose from fits without one square of the object each, shape (3, 3).

    Residuals within a square may be correlated in any way: those of an edge that a sensor displaces over a whole window, and of errors of
    the outline, are. Delete-a-group jackknife, linear in the residuals (Efron & Stein, "The jackknife estimate of variance", 1981).
    """
    squares, gradient = scores_of_squares(template.field, lines.upper, lines.lower, lines.stopped, pose, _LEVELS[-1][0], _SQUARE)
    used = np.trace(squares, axis1=1, axis2=2) > 0
    n = int(np.count_nonzero(used))
    moved = np.linalg.solve(normal - squares[used], gradient[used][..., None])[..., 0]
    return np.asarray((n - 1) / max(n, 1) * moved.T @ moved)


def _lasting(template: Template, scene: Scene, lines: LinesOfSight, pose: Float64Array, normal: Float64Array) -> Float64Array:
    """Covariance of the errors that every frame at this pose has, shape (3, 3)."""
    covariance = in_table(template.frame_covariance, pose)
    if template.seen_from is None or template.displaced_std == 0.0:
        return covariance
    moved = template.displaced_std * _displaced_by_camera(template, scene, lines, pose, normal)
    return covariance + np.outer(moved, moved)


def _displaced_by_camera(template: Template, scene: Scene, lines: LinesOfSight, pose: Float64Array, normal: Float64Array) -> Float64Array:
    """As `displaced_pose`, of a template whose `seen_from` is known."""
    camera = np.array(np.asarray(scene.camera_in_table)[:2, 3], dtype=np.float64)
    scores = displaced_scores(template.field, lines.upper, lines.lower, pose, _LEVELS[-1][0], camera, template.seen_from)
    return displaced_pose(scores, normal, template.displaced_frame, float(pose[2]))


def displaced_by_camera(template: Template, scene: Scene, pose: Float64Array) -> Float64Array:
    """Change of the pose fitted at `pose` by edges that the camera displaces, per metre [-, -, rad/m], shape (3,); 0 where unknown.

    Raises:
        FrameError: The size of the image differs from its camera info.
    """
    width, band, stride, *_ = _LEVELS[-1]
    lines = lines_of_sight(template, scene, pose, band, stride)
    if template.seen_from is None or lines is None:
        return np.zeros(3)
    normal = _compare(template, lines, pose, width).normal + 1e-6 * np.diag(_DAMPING)
    return _displaced_by_camera(template, scene, lines, np.ascontiguousarray(pose, dtype=np.float64), normal)


def _at_least(covariance: Float64Array, other: Float64Array) -> Float64Array:
    """The smallest covariance that is nowhere below the first, and along the axes of the first not below the second either."""
    factor = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(factor)
    values, axes = np.linalg.eigh(inverse @ other @ inverse.T)
    return np.asarray(factor @ (axes * np.maximum(values, 1.0)) @ axes.T @ factor.T)


def _failed(status: TrackStatus, pose: Float64Array, lines: LinesOfSight | None = None) -> PoseFit:
    n_pixels = 0 if lines is None else len(lines.stopped)
    share = 0.0 if lines is None else n_pixels / max(n_pixels + lines.n_uninformative, 1)
    return PoseFit(status, pose, np.diag([1.0, 1.0, 10.0]), n_pixels, share, 1.0)
