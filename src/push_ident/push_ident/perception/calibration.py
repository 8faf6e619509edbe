"""Extrinsics of the camera from the table plane and a mark of known shape that lies at a known pose on the table.

The plane determines tilt and height of the camera, three of its six coordinates, with the precision of thousands of pixels. The mark
determines the other three, position and heading on the table. It is a flat-topped block, 20 mm high or more, whose outline differs in every
heading, such as a right triangle or an L. Its advantages over a printed mark: a depth camera measures its edges in any light, no colour
image has to be aligned with the depth, and its known height reveals an error of scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError, PerceptionError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import points_in_polygon, polygon_area, signed_distance
from push_ident.geometry.se2 import compose, inverse, rotation, transform_points
from push_ident.perception.frame.view import STRIDE, FrameView, median_frame, points_in_table
from push_ident.perception.known_object import PoseFit, Segment, SegmentedView, Template, TracedObject, TrackStatus
from push_ident.perception.outline.tracing import trace_object
from push_ident.perception.search.segments import find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking.pose_fit import relocate
from push_ident.types import BoolArray, DepthFrame, Float64Array, ObjectShape

_MIN_SHARE: Final = 0.15
"""Least fraction of all points that must lie on the plane of the table."""
_LEVEL: Final = 0.02
"""Range of heights in which a second plane is looked for [m]: the reach of its fit."""
_DIFFERENT: Final = 0.004
"""Least mean distance between the outlines of the mark and of a turned copy [m]: below it the heading is ambiguous."""
_MARK_AREA: Final = (0.6, 1.6)
"""Range of the area of a segment that may be the mark, relative to the area of the mark."""
_MAX_RESIDUAL: Final = 0.003
"""A larger distance between measured and known outline means that something else was taken for the mark [m]."""
_MAX_HEIGHT_ERROR: Final = 0.006
"""A larger difference between measured and known height means the same [m]."""


@dataclass(frozen=True, slots=True)
class Mark:
    """The calibration block: its outline in its own frame, its height, and its pose on the table."""

    outline: Float64Array
    """Corners [m], shape (n, 2), frame of the mark."""
    height: float
    """[m]"""
    pose_mark_in_table: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """(x, y, yaw) [m, m, rad]."""

    def __post_init__(self) -> None:
        outline = np.array(self.outline, dtype=np.float64)
        if outline.ndim != 2 or outline.shape[1] != 2 or len(outline) < 3 or not np.isfinite(outline).all():
            raise InputError(f"The outline of the mark has shape {outline.shape}, expected at least three finite corners (n, 2) in metres.")
        if not self.height >= 0.02:
            raise InputError(f"The mark is {self.height} m high, expected 0.02 m or more: noise hides the edges of a lower mark.")
        outline = outline if polygon_area(outline) > 0 else outline[::-1]
        middle = outline.mean(axis=0)
        edge = _dense(outline, 200) - middle
        different = [
            float(np.mean(np.abs(signed_distance(edge @ rotation(turn).T, outline - middle)))) for turn in np.linspace(0.35, np.pi, 33)
        ]
        if min(different) < _DIFFERENT:
            raise InputError(
                f"The mark differs from a turned copy by only {min(different) * 1e3:.1f} mm, so its heading is ambiguous; "
                "use an outline without symmetry, such as a right triangle or an L."
            )
        outline.setflags(write=False)
        object.__setattr__(self, "outline", outline)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Extrinsics, and how well they explain the images."""

    camera_in_table: Float64Array
    """Optical frame in the table frame, homogeneous, shape (4, 4)."""
    plane_noise: float
    """Standard deviation of the table about its plane, in the mean of the frames [m]."""
    outline_residual: float
    """Root mean square distance of the measured outline of the mark from the known one [m]."""
    height_error: float
    """Measured minus known height of the mark [m]: an error of scale, or of the plane."""
    covariance: Float64Array
    """Covariance of (x, y, yaw) of the mark, shape (3, 3)."""
    n_frames: int
    """Number of frames used."""


def camera_over_table(frame: DepthFrame) -> tuple[Float64Array, float, float]:
    """Camera pose over the table, without prior knowledge: z points up, the origin is the middle of its plane.

    The table is the largest plane in view, or a plane so far above it that it can be no object: the largest is the floor then.

    Args:
        frame: Preferably the `median_frame` of several frames.

    Returns:
        Optical frame in a frame of the plane, shape (4, 4); noise about the plane [m]; fraction of the points on it.

    Raises PerceptionError: Too few valid pixels, or no plane with enough of them.
    """
    points = points_in_table(frame, np.eye(4))[::STRIDE, ::STRIDE].reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points[:, 2])]
    if len(points) < 200:
        raise PerceptionError(f"Depth image has {len(points) * STRIDE**2} valid of {frame.depth.size} pixels; check the camera.")
    normal, offset, noise, inliers = _refined_plane(points, *_largest_plane(points))
    above = _level_above(points @ normal - offset)
    if above is not None:
        table = _refined_plane(points, normal, offset + above)
        if np.mean(table[3]) >= _MIN_SHARE:
            normal, offset, noise, inliers = table
    share = float(np.mean(inliers))
    if share < _MIN_SHARE:
        raise PerceptionError(f"{share:.0%} of {len(points)} points lie on one plane, expected {_MIN_SHARE:.0%}; show more of the table.")
    origin = np.median(points[inliers], axis=0)
    origin -= (origin @ normal - offset) * normal
    x_axis = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x_axis /= np.linalg.norm(x_axis)
    table_in_camera = np.eye(4)
    table_in_camera[:3, :3] = np.column_stack([x_axis, np.cross(normal, x_axis), normal])
    table_in_camera[:3, 3] = origin
    return np.asarray(np.linalg.inv(table_in_camera), dtype=np.float64), max(noise, 1e-4), share


def table_extent(frame: DepthFrame, camera_in_table: Float64Array, noise: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Low and high corner [m] of the box that holds 99 % of the plane's points along each axis."""
    points = points_in_table(frame, camera_in_table)[::STRIDE, ::STRIDE].reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        flat = points[np.abs(points[:, 2]) < 4.0 * noise, :2].astype(np.float64)
    low, high = np.quantile(flat, [0.005, 0.995], axis=0)
    return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))


def calibrate(frames: Sequence[DepthFrame], mark: Mark) -> Calibration:
    """Extrinsics from frames at rest in which all of the mark is visible on the table; other objects may lie there as well.

    Raises PerceptionError: No table, no segment of the mark's size, or a fit whose residual is too large; the text gives the counts.
    """
    if not frames:
        raise PerceptionError("There are no depth frames to calibrate from; start the camera.")
    frame = median_frame(frames)
    camera, noise, _ = camera_over_table(frame)
    low, high = table_extent(frame, camera, noise)
    settings = PerceptionSettings(
        workspace_low=low, workspace_high=high, min_object_height=max(0.35 * mark.height, 0.008), max_object_height=3.0 * mark.height
    )
    view = FrameView(frame, camera, settings=settings, noise=noise)
    segments, counts = find_segments(view)
    area = polygon_area(mark.outline)
    similar = [segment for segment in segments if segment.whole and _MARK_AREA[0] * area < segment.area < _MARK_AREA[1] * area]
    if not similar:
        raise PerceptionError(
            f"None of {counts['segments']} segments on the table is whole and of the area of the mark, {area * 1e4:.0f} cm^2 "
            f"(they have {', '.join(f'{s.area * 1e4:.0f}' for s in segments[:5]) or 'none'}); show all of the mark."
        )
    outline = transform_points(inverse([*mark.outline.mean(axis=0), 0.0]), mark.outline)
    shape = ObjectShape(cells_in_outline(outline, float(np.sqrt(polygon_area(outline) / 50))), outline)
    template = Template(TracedObject(shape, np.zeros(3), np.full((1, 1), mark.height, dtype=np.float32), np.zeros(2), 1.0))
    fitted = [_fit(template, view, segment) for segment in similar]
    fit, residual, height = min(fitted, key=lambda result: (result[0].status is not TrackStatus.TRACKED, result[1]))
    if fit.status is not TrackStatus.TRACKED or residual > _MAX_RESIDUAL or abs(height - mark.height) > _MAX_HEIGHT_ERROR:
        raise PerceptionError(
            f"The segment most similar to the mark differs from it by {residual * 1e3:.1f} mm in outline and "
            f"{(height - mark.height) * 1e3:.1f} mm in height ({fit.status.value}), expected at most {_MAX_RESIDUAL * 1e3:.0f} and "
            f"{_MAX_HEIGHT_ERROR * 1e3:.0f} mm; check its dimensions."
        )
    pose_mark_in_plane = compose(fit.pose, inverse([*mark.outline.mean(axis=0), 0.0]))
    x, y, yaw = compose(mark.pose_mark_in_table, inverse(pose_mark_in_plane))
    plane_in_table = np.eye(4)
    plane_in_table[:2, :2] = rotation(yaw)
    plane_in_table[:2, 3] = x, y
    return Calibration(plane_in_table @ camera, noise, residual, height - mark.height, fit.covariance, len(frames))


def _largest_plane(points: Float64Array) -> tuple[Float64Array, float]:
    """Normal and offset of the plane through three points with the most points within 1 % of their depth, walls excluded."""
    rng = np.random.default_rng(0)
    scored = points[rng.integers(len(points), size=min(len(points), 3000))]
    best, best_count = (np.array([0.0, 0.0, -1.0]), -1.0), -1
    for triple in points[rng.integers(len(points), size=(300, 3))]:
        normal = np.cross(triple[1] - triple[0], triple[2] - triple[0])
        length = float(np.linalg.norm(normal))
        if length < 1e-4 or abs(normal[2]) < np.cos(np.deg2rad(80.0)) * length:
            continue
        normal /= length
        offset = float(normal @ triple[0])
        count = int(np.count_nonzero(np.abs(scored @ normal - offset) < 0.01 * scored[:, 2]))
        if count > best_count:
            best, best_count = (normal, offset), count
    return best


def _refined_plane(points: Float64Array, normal: Float64Array, offset: float) -> tuple[Float64Array, float, float, BoolArray]:
    """Least squares from a plane near by: normal towards the camera, offset, noise about the plane [m], and which points are on it."""
    # Noise grows with the square of the depth, so near points get more weight.
    weight = 1.0 / points[:, 2] ** 2
    noise, inliers = 0.01, np.abs(points @ normal - offset) < 0.02
    for _ in range(6):
        if np.count_nonzero(inliers) < _MIN_SHARE * len(points):
            break
        near, w = points[inliers], weight[inliers, None]
        middle = np.sum(near * w**2, axis=0) / np.sum(w**2)
        normal = np.linalg.svd((near - middle) * w, full_matrices=False)[2][2]
        offset = float(normal @ middle)
        distance = points @ normal - offset
        noise = 1.4826 * float(np.median(np.abs(distance[inliers])))
        inliers = np.abs(distance) < 3.0 * max(noise, 3e-4)
    return (-normal, -offset, noise, inliers) if offset > 0 else (normal, offset, noise, inliers)


def _level_above(heights: Float64Array) -> float | None:
    """Height at which most of the points lie that are higher above the largest plane than any object [m]; None where too few do."""
    higher = heights[heights > PerceptionSettings().max_object_height]
    if len(higher) < _MIN_SHARE * len(heights):
        return None
    higher = np.sort(higher)
    ends = np.searchsorted(higher, higher + _LEVEL, side="right")
    first = int(np.argmax(ends - np.arange(len(higher))))
    return float(np.median(higher[first : ends[first]]))


def _fit(template: Template, view: FrameView, segment: Segment) -> tuple[PoseFit, float, float]:
    """Pose of the mark at the segment, the residual of its outline [m], and its measured height [m]."""
    fit = relocate(template, view, segment.centre)
    if fit.status is not TrackStatus.TRACKED:
        return fit, np.inf, np.inf
    outline = transform_points(fit.pose, template.outline)
    traced = trace_object([SegmentedView(view, segment)], min_height=0.008, cell_count=50)
    edge = _dense(traced.shape.outline + traced.pose[:2], 30)
    residual = float(np.sqrt(np.mean(np.square(signed_distance(edge, outline)))))
    points = segment.points_in(view.points)
    top: NDArray[np.float32] = points[points_in_polygon(points[:, :2], outline), 2]
    return fit, residual, float(np.median(top[top > 0.5 * template.top_range[1]]))


def _dense(polygon: Float64Array, n_per_edge: int) -> Float64Array:
    """Points along the edges, shape (n_edges * n_per_edge, 2)."""
    part = np.linspace(0.0, 1.0, n_per_edge, endpoint=False)[:, None]
    return (polygon[:, None] + part * (np.roll(polygon, -1, axis=0) - polygon)[:, None]).reshape(-1, 2)
