"""Pose of a known object in each frame.

Every pixel near the object gives a binary measurement: its line of sight is stopped by the upper part of the object (full), or it
passes and meets something lower (empty). For a pose T the line of sight is stopped where the piece of it between the top of the
object and a little below lies inside the outline. With the signed distance d (negative inside) of both ends of that piece,

    expected(T) = sigmoid(-min(d(T^-1 a), d(T^-1 b)) / s)

and the pose is the least-squares fit of the expected to the measured, by Gauss-Newton, first with a wide s, then with a narrow one.
Pixels that measure something higher (a hand, the pusher) or nothing carry no information and are left out, so that occlusion does not
bias the pose.

Some errors are the same in all frames at one pose, so that no residual shows them. The object frame is that of the first detection: they
are zero there, and grow as the object turns and moves:

- A camera displaces edges where depth jumps (`outline.edges`), that is, where the object hides its wall. The displacement that is expected
  of it is part of the expected lines of sight; what is not known of it is displaced in the outline by the first view, and in each later
  view at others. A pose settles between both. With the unknown displacement h of all such edges, the
  pose is wrong by h N^-1 J'd, N = J'J, J the derivative of the expected lines of sight by the pose, and d that of the measured by h. An
  outline of several rests has each edge displaced by h times the share of the rests that hide its wall. It is put into the frame in
  which the pose at the last of them stays the same, with the error that it has there; that error f h then turns with the object.
- Edges scatter, each by itself. A pose has the variance V of the view at hand and V / n of an outline of n rests, and its residuals show
  both. What they do not show: the frame was defined with the scatter of the first view alone. Each further rest L changes the outline, and
  the frame follows the old one: it moves by the error of the old outline in the pose at L less that of the new one, of the variance
  V / (n - 1) - V / n. The pose at L with the old outline has V + V / (n - 1), hence the frame 1 / n^2 of its covariance.

The error of the extrinsics is none of these: it moves all poses alike. It is stated once, of the camera (`CameraAccuracy`), and whoever
compares poses with the pusher takes it as an unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.geometry.se2 import rotation, transform_points, wrap_angle
from push_ident.perception.frame.view import DEVIATIONS, FrameView, unmeasured_areas, wall_visibility
from push_ident.perception.kernels import (
    compare_lines,
    displaced_scores,
    innermost_points,
    intersect_object,
    nearest_values,
    scores_of_squares,
)
from push_ident.perception.known_object import FIELD_MARGIN, NOISE_STEP, Placed, PoseFit, Template, TrackStatus
from push_ident.types import BoolArray, Float64Array

EDGE_WIDTH: Final = 0.0015
"""Width s of the expected step from stopped to passing, near the pose [m]."""
_LEVELS: Final = ((0.006, 0.02, 3, 8, 3e-4), (EDGE_WIDTH, 0.006, 1, 8, 2e-5))
"""Width s [m], half width of the band of pixels used [m], stride over pixels, most iterations, and the step that ends them [m]: wide, then
narrow. The wide one ends at a fifth of the narrow width, far inside the reach of the narrow one."""
_OVERSHOOT: Final = 1.5
"""Second derivative of half the sum of squares over J'J near the best pose [-]. The measured changes at the edge at once, the expected over
the width s: across an edge, with e = sigmoid(-d / s), the integral of e'^2 is 1 / (6 s), and that of the residual times -e'' 1 / (12 s).
A full step of Gauss-Newton thus ends half as far beyond the best pose as it began before it."""
_EQUAL: Final = 0.02
"""Headings of which so much less or more of the lines of sight contradict fit equally well [-]: whole objects have 0.002."""
_SAME_HEADING: Final = np.pi / 18.0
"""Fits whose headings differ by less ended in the same minimum [rad]: the step of those compared."""
_ANY_HEADING: Final = np.pi**2 / 3.0
"""Variance of a yaw that may be any [rad^2]."""
_ABOVE: Final = 0.01
"""Points this far above the top belong to something in front [m]."""
MATCHER_WINDOW: Final = 0.02
"""Within this distance of each other residuals may be correlated [m]: the window of a matcher is 7 to 9 px, 10 to 20 mm."""
_CLEAR: Final = 0.003
"""Pixels further than this from the edge can contradict a pose [m]."""
_VOTE_CELL: Final = 0.004
"""Edge of the cells in which missing area is counted [m]."""
MISSING: Final = 4e-4
"""Least area that shows that a part is missing [m^2]: below `min_object_area`. Whole objects lack at most 2e-4 along the edges of their
steps (decision 15)."""
_DAMPING: Final = np.array([1.0, 1.0, 1e-4])
"""Added to the diagonal of the normal matrix of a pose (x, y, yaw) [1/m^2, 1/m^2, 1]."""


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


def fit_pose(template: Template, view: FrameView, start: ArrayLike, others: Sequence[Placed] = ()) -> PoseFit:
    """Fit the pose of the object to one frame.

    Args:
        start: Initial pose (x, y, yaw), within about 15 mm and 10 degrees of the true one.
        others: Other known objects; their pixels are left out.
    """
    start = np.asarray(start, dtype=np.float64)
    pose, lines, width, accepted = start.copy(), None, 0.0, view.settings.tracking
    for width, band, stride, iterations, enough in _LEVELS:
        lines = lines_of_sight(template, view, pose, band, stride, others)
        if lines is None:
            return _failed(TrackStatus.OUT_OF_VIEW, pose)
        if len(lines.stopped) < accepted.min_pixels / stride**2:
            return _failed(TrackStatus.HIDDEN, pose, lines)
        pose = _gauss_newton(template, view, lines, pose, (width, enough), iterations)
    assert lines is not None
    comparison = _compare(template, view, lines, pose, width)
    share_visible = len(lines.stopped) / (len(lines.stopped) + lines.n_uninformative)
    share_contradicting = comparison.share_contradicting
    normal = comparison.normal + 1e-6 * np.diag(_DAMPING)
    covariance = comparison.edge_variance * np.linalg.inv(normal) + np.diag(np.square(accepted.min_deviation))
    residual_covariance = _at_least(covariance, _jackknife(template, view, lines, pose, normal))
    covariance = residual_covariance + _covariance_shared_by_frames(template, view, lines, pose, normal)
    unsure = np.diag(covariance) > np.square(accepted.max_deviation)
    if not template.has_heading:
        unsure[2] = False
        covariance, residual_covariance = _with_any_heading(covariance), _with_any_heading(residual_covariance)
    status = TrackStatus.TRACKED
    if np.hypot(*(pose - start)[:2]) > 0.05 or share_contradicting > accepted.max_contradicting:
        status = TrackStatus.POOR_FIT
    elif share_visible < accepted.min_share_visible:
        status = TrackStatus.HIDDEN
    elif unsure.any():
        status = TrackStatus.UNDETERMINED
    pose[2] = start[2] + float(wrap_angle(pose[2] - start[2]))
    covariance = 0.5 * (covariance + covariance.T)
    return PoseFit(status, pose, covariance, len(lines.stopped), share_visible, share_contradicting, residual_covariance)


def keeps_heading(template: Template, view: FrameView, pose: Float64Array, others: Sequence[Placed] = ()) -> bool:
    """Whether fits that start at headings on both sides of the true pose halve the error of heading at least.

    The edges of round things, with the noise that they have in one frame, fit at many headings. Each frame has other noise, or another
    prediction to start from, so that such a heading would wander from one minimum to the next though nothing moves.

    Args:
        others: As in `fit_pose`.
    """
    turn = view.settings.tracking.max_jump[1]
    fits = [fit_pose(template, view, pose + np.array([0.0, 0.0, side * turn]), others) for side in (-1.0, 1.0)]
    return all(abs(float(wrap_angle(fit.pose[2] - pose[2]))) < 0.5 * turn for fit in fits)


def relocate(
    template: Template, view: FrameView, centre: ArrayLike, *, others: Sequence[Placed] = (), last_yaw: float | None = None
) -> PoseFit:
    """Find a lost object at `centre` (x, y) [m] with any yaw: compare all headings coarsely, then fit from the best three and from the
    last one.

    Where several headings fit equally well, as those of a nearly symmetric object do, the one nearest `last_yaw` [rad] is taken if the next
    is more than twice as far from it; else the status is UNDETERMINED.
    """
    everywhere = template.radius + FIELD_MARGIN
    headings = np.linspace(-np.pi, np.pi, 36, endpoint=False)
    starts = [np.array([*np.asarray(centre, dtype=np.float64), heading]) for heading in headings]
    lines = lines_of_sight(template, view, starts[0], everywhere, 4, others)
    if lines is None or len(lines.stopped) == 0:
        return _failed(TrackStatus.OUT_OF_VIEW, starts[0])
    mean_square = np.array([_compare(template, view, lines, start, 2 * _LEVELS[0][0]).mean_square for start in starts])
    minima = np.flatnonzero((mean_square <= np.roll(mean_square, 1)) & (mean_square <= np.roll(mean_square, -1)))
    tried = [starts[index] for index in minima[np.argsort(mean_square[minima])][:3]]
    tried += [] if last_yaw is None else [np.array([*starts[0][:2], last_yaw])]
    tried = tried if template.has_heading else tried[-1:]
    fits = [fit_pose(template, view, start, others) for start in tried]
    best = min(fits, key=lambda fit: (fit.status is not TrackStatus.TRACKED, fit.share_contradicting))
    equal = [fit for fit in fits if fit.status is best.status and fit.share_contradicting < best.share_contradicting + _EQUAL]
    best, is_certain = _nearest_heading(equal, float(best.pose[2]) if last_yaw is None else last_yaw)
    # Without a previous pose, one half of an object can be taken for the other half.
    accepted = view.settings.tracking
    is_doubtful = best.share_visible < accepted.found_visible or best.share_contradicting > accepted.found_contradicting
    if best.status is TrackStatus.TRACKED and not (is_certain and not is_doubtful):
        return replace(best, status=TrackStatus.HIDDEN if is_doubtful else TrackStatus.UNDETERMINED)
    return best


def _nearest_heading(fits: Sequence[PoseFit], yaw: float) -> tuple[PoseFit, bool]:
    """The fit whose heading is nearest to `yaw` [rad], and whether each other heading is more than twice as far from it."""
    turns = [abs(float(wrap_angle(fit.pose[2] - yaw))) for fit in fits]
    nearest = fits[int(np.argmin(turns))]
    others = [turn for fit, turn in zip(fits, turns, strict=True) if abs(float(wrap_angle(fit.pose[2] - nearest.pose[2]))) > _SAME_HEADING]
    return nearest, all(turn > 2.0 * min(turns) for turn in others)


def lines_of_sight(
    template: Template, view: FrameView, pose: Float64Array, band: float, stride: int, others: Sequence[Placed] = ()
) -> LinesOfSight | None:
    """Lines of sight that pass the outline at `pose` within `band` [m]; None where the object is not in the image."""
    pose = np.ascontiguousarray(pose, dtype=np.float64)
    box = _image_box(template, view, pose, band)
    if box is None:
        return None
    rows, columns = box
    centre, rays = view.rays
    level, slack = float(np.mean(template.top_range)), 0.5 * (template.top_range[1] - template.top_range[0])
    upper, lower, points, stopped, informative = intersect_object(
        template.field,
        template.tops,
        np.asarray(view.frame.depth, dtype=np.float32),
        _beside_areas(view, box),
        rays,
        centre,
        pose,
        (rows.start, rows.stop, columns.start, columns.stop, stride),
        (level, band + slack, NOISE_STEP, _ABOVE),
    )
    if template.hollow is not None:
        # What is measured through an opening depends on the walls inside, which nobody knows.
        in_object = (upper - pose[:2]) @ rotation(pose[2])
        solid = nearest_values(template.hollow, np.ascontiguousarray(in_object)) < 0.5
        upper, lower, points, stopped, informative = (values[solid] for values in (upper, lower, points, stopped, informative))
    informative &= ~view.is_robot(points)
    informative &= ~_in_others(points, others)
    n_uninformative = int(np.count_nonzero(~informative))
    return LinesOfSight(upper[informative], lower[informative], stopped[informative], points[informative, 2], n_uninformative)


def _beside_areas(view: FrameView, box: tuple[slice, slice]) -> NDArray[np.uint8]:
    """Which pixels of the box lie beside an unmeasured area, such as the shadow of the object: 1.

    Where nothing is measured on one side of an edge, the lines of sight of the other side alone would push it into the shadow: those within
    5 mm, as far as the narrow width of the fit reaches.
    """
    depth = view.frame.depth[box]
    measured = np.isfinite(depth)
    areas = unmeasured_areas(measured)
    if not areas.any():
        return areas
    reach = 0.005 * view.frame.intrinsics.fx / float(np.median(depth[measured])) if measured.any() else 0.0
    reach = int(np.ceil(min(reach, max(areas.shape))))  # further than the box there is nothing to mark
    return np.asarray(cv2.dilate(areas, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)))


def _image_box(template: Template, view: FrameView, pose: Float64Array, band: float) -> tuple[slice, slice] | None:
    """Rows and columns that show the outline at `pose`, grown by `band`; None where its origin is outside the image."""
    outline = transform_points(pose, template.outline)
    low, high = outline.min(axis=0) - band, outline.max(axis=0) + band
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.0, template.top_range[1])])
    points = np.vstack([corners, [pose[0], pose[1], 0.5 * template.top_range[1]]])
    in_camera = (points - view.camera_in_table[:3, 3]) @ view.camera_in_table[:3, :3]
    if np.any(in_camera[:, 2] <= 0):
        return None
    intrinsics = view.frame.intrinsics
    u = intrinsics.fx * in_camera[:, 0] / in_camera[:, 2] + intrinsics.cx
    v = intrinsics.fy * in_camera[:, 1] / in_camera[:, 2] + intrinsics.cy
    if not (0 <= u[-1] < intrinsics.width and 0 <= v[-1] < intrinsics.height):
        return None
    rows = slice(max(0, int(v.min())), min(intrinsics.height, int(v.max()) + 2))
    columns = slice(max(0, int(u.min())), min(intrinsics.width, int(u.max()) + 2))
    return rows, columns


def _in_others(points: NDArray[np.float32], others: Sequence[Placed]) -> BoolArray:
    """Which points, shape (n, 3), lie on another object."""
    inside = np.zeros(len(points), dtype=bool)
    for other, pose in others:
        in_other = np.nan_to_num((points[:, :2] - pose[:2]) @ rotation(pose[2]), nan=1e3)
        inside |= (other.nearest_distance(in_other) < 0.003) & (points[:, 2] > 0.5 * other.top_range[0])
    return inside


@dataclass(frozen=True, slots=True)
class UpperSide:
    """What is there, and not there, of the upper side of an object at a pose."""

    missing: float
    """Area of the upper side that is not there [m^2]."""
    height: float
    """Median height of what is measured there instead [m]; NaN where nothing is missing."""
    open_border: float
    """Fraction of the lines of sight just inside the outline that pass [-]."""
    crowded_border: float
    """Fraction of those just outside that are stopped, as by another thing that touches the object [-]."""

    @property
    def is_part_missing(self) -> bool:
        """Whether so much of an object is not where it should be that it is not one rigid thing, or not at this pose."""
        return self.missing > MISSING


def compare_upper_side(template: Template, view: FrameView, pose: Float64Array, others: Sequence[Placed] = ()) -> UpperSide:
    """Compare the upper side of an object with the lines of sight at a pose (x, y, yaw) [m, m, rad], table frame.

    Hidden spots, and those where something higher is measured, count neither as there nor as missing. Pixels at an edge may show either
    side: missing counts from 5 mm inside the outline, the border in strips of 3 mm, 4.5 mm to both sides. In each cell the lines of sight
    within 12 mm vote, more than their distance in a camera of 360 px at 1.5 m.

    Args:
        others: Other known objects; their pixels are left out.
    """
    lines = lines_of_sight(template, view, pose, template.radius, 3, others)
    if lines is None:
        return UpperSide(0.0, np.nan, 0.0, 0.0)
    positions, passed = lines.innermost_points(template, pose), lines.stopped < 0.5
    distance = template.nearest_distance(positions)
    at_border = np.abs(np.abs(distance) - 0.0045) < 0.0015
    is_open, is_crowded = _share(passed[at_border & (distance < 0)]), _share(~passed[at_border & (distance > 0)])
    inside = distance < -0.005
    positions, height = positions[inside], lines.height[inside]
    passed = height < template.nearest_top(positions, lowest=True) - max(NOISE_STEP, DEVIATIONS * view.noise)
    n = int(np.ceil(2.0 * template.radius / _VOTE_CELL)) + 1
    cell = np.floor((positions + template.radius) / _VOTE_CELL).astype(np.int64) @ np.array([1, n])
    votes = np.bincount(cell, weights=np.where(passed, 1.0, -1.0), minlength=n * n).reshape(n, n)
    missing = cv2.blur(votes, (3, 3), borderType=cv2.BORDER_CONSTANT) > 1e-6  # as many passing as stopped: not missing
    below = height[missing.ravel()[cell] & passed]
    return UpperSide(
        float(np.count_nonzero(missing)) * _VOTE_CELL**2, float(np.median(below)) if len(below) else np.nan, is_open, is_crowded
    )


def contradictions(template: Template, view: FrameView, pose: Float64Array, others: Sequence[Placed] = ()) -> tuple[float, float]:
    """Fractions of the lines of sight clearly outside and clearly inside of an outline at a pose that contradict it [-]: those outside that
    are stopped, and those inside that pass.

    Args:
        others: Other known objects; their pixels are left out.
    """
    _, band, stride, *_ = _LEVELS[-1]
    lines = lines_of_sight(template, view, pose, band, stride, others)
    if lines is None:
        return 0.0, 0.0
    distance, stopped = template.distance(lines.innermost_points(template, pose))[0], lines.stopped > 0.5
    return _share(stopped[distance > _CLEAR]), _share(~stopped[distance < -_CLEAR])


def _share(values: BoolArray) -> float:
    return float(np.mean(values)) if len(values) else 0.0


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


def _edges(template: Template, view: FrameView, pose: Float64Array) -> Float64Array:
    """What a camera does to the edges of an object at a pose, as the kernels take it, shape (4,)."""
    return np.array(
        [*view.camera_in_table[:2, 3], template.traced.displaced, wall_visibility(view, pose, float(np.mean(template.top_range)))]
    )


def _compare(template: Template, view: FrameView, lines: LinesOfSight, pose: Float64Array, width: float) -> _Comparison:
    edges, widths = _edges(template, view, pose), (width, 3.0 * width, _CLEAR)
    return _Comparison(*compare_lines(template.field, lines.upper, lines.lower, lines.stopped, pose, widths, edges))


def _gauss_newton(
    template: Template, view: FrameView, lines: LinesOfSight, pose: Float64Array, widths: tuple[float, float], iterations: int
) -> Float64Array:
    """Fitted pose, after so many iterations or a step shorter than the second of `widths` [m]; the first is that of the expected step."""
    width, enough = widths
    for _ in range(iterations):
        now = _compare(template, view, lines, pose, width)
        diagonal = np.diag(now.normal)
        damped = now.normal.copy()
        damped.flat[:: len(damped) + 1] = diagonal + (1e-3 * diagonal + _DAMPING)
        if template.has_heading:
            step = np.linalg.solve(damped, now.gradient)
        else:
            step = np.append(np.linalg.solve(damped[:2, :2], now.gradient[:2]), 0.0)
        length = max(float(np.hypot(step[0], step[1])), template.radius * abs(float(step[2])), 1e-12)
        # The linearisation does not hold beyond the width.
        step *= 1.0 / _OVERSHOOT if length < width else min(1.0, 2.0 * width / length)
        pose = pose + step
        if np.hypot(step[0], step[1]) < enough and abs(step[2]) < 10.0 * enough:
            break  # the turn moves an edge 10 cm from the middle by as much
    return pose


def _with_any_heading(covariance: Float64Array) -> Float64Array:
    """The covariance, shape (3, 3), with a yaw of which nothing is known."""
    result = np.zeros((3, 3))
    result[:2, :2], result[2, 2] = covariance[:2, :2], _ANY_HEADING
    return result


def _jackknife(template: Template, view: FrameView, lines: LinesOfSight, pose: Float64Array, normal: Float64Array) -> Float64Array:
    """Covariance of the pose from fits without one square of the object each, shape (3, 3).

    Residuals within a square may be correlated in any way: those of an edge that a sensor displaces over a whole window, and of errors of
    the outline, are. Delete-a-group jackknife, linear in the residuals (Efron & Stein, "The jackknife estimate of variance", 1981).
    """
    squares, gradient = scores_of_squares(
        template.field, lines.upper, lines.lower, lines.stopped, pose, (EDGE_WIDTH, MATCHER_WINDOW), _edges(template, view, pose)
    )
    used = np.trace(squares, axis1=1, axis2=2) > 0
    n = int(np.count_nonzero(used))
    moved = np.linalg.solve(normal - squares[used], gradient[used][..., None])[..., 0]
    return np.asarray((n - 1) / max(n, 1) * moved.T @ moved)


def _covariance_shared_by_frames(
    template: Template, view: FrameView, lines: LinesOfSight, pose: Float64Array, normal: Float64Array
) -> Float64Array:
    """Covariance of the errors that every frame at this pose has, shape (3, 3)."""
    covariance = in_table(template.traced.frame_covariance, pose)
    if template.camera_positions is None or template.traced.displaced_std == 0.0:
        return covariance
    moved = template.traced.displaced_std * _displaced_pose(template, view, lines, pose, normal)
    return covariance + np.outer(moved, moved)


def _displaced_pose(template: Template, view: FrameView, lines: LinesOfSight, pose: Float64Array, normal: Float64Array) -> Float64Array:
    """As `displaced_by_camera`, of a template whose `camera_positions` are known; `normal` is J'J."""
    edges, seen_from = _edges(template, view, pose), template.camera_positions
    scores = displaced_scores(template.field, lines.upper, lines.lower, pose, EDGE_WIDTH, edges, seen_from)
    of_frame = template.traced.displaced_frame
    return np.asarray(np.linalg.solve(normal, scores) + np.append(rotation(float(pose[2])) @ of_frame[:2], of_frame[2]))


def displaced_by_camera(template: Template, view: FrameView, pose: Float64Array) -> Float64Array:
    """Change of the pose fitted at `pose` by edges that the camera displaces, all alike, per metre [-, -, rad/m], shape (3,), table frame.

    It is 0 where the positions of the cameras are unknown.
    """
    width, band, stride, *_ = _LEVELS[-1]
    lines = lines_of_sight(template, view, pose, band, stride)
    if template.camera_positions is None or lines is None:
        return np.zeros(3)
    normal = _compare(template, view, lines, pose, width).normal + 1e-6 * np.diag(_DAMPING)
    return _displaced_pose(template, view, lines, np.ascontiguousarray(pose, dtype=np.float64), normal)


def frame_step(covariance: Float64Array, yaw: float, n_rests: int) -> Float64Array:
    """Covariance of the step of an object frame that follows the old outline, shape (3, 3), object frame.

    Args:
        covariance: Of the pose at the latest rest, with the old outline, of the errors that frames do not share, shape (3, 3), table frame.
        yaw: Of the object there [rad].
        n_rests: Of the new outline.
    """
    return in_table(covariance, np.array([0.0, 0.0, -yaw])) / n_rests**2


def in_table(covariance: Float64Array, pose: Float64Array) -> Float64Array:
    """Covariance of (x, y, yaw), shape (3, 3), given in the object frame, in the table frame."""
    turn = np.eye(3)
    turn[:2, :2] = rotation(float(pose[2]))
    return np.asarray(turn @ covariance @ turn.T)


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
