"""What perception knows of an object, from its pixels in one frame to its pose: values that its rooms hand to each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.outline import dense
from push_ident.geometry.se2 import rotation
from push_ident.perception.frame.view import FrameView
from push_ident.perception.kernels import Grid, interpolate, nearest_values, outline_distances
from push_ident.perception.refusals import Reason, Refusal
from push_ident.types import BoolArray, Float64Array, ObjectShape

TOP_QUANTILE: Final = 0.98
"""Quantile of the heights of points that is the height of a thing [-]: single pixels are outliers."""
ON_OBJECT: Final = 0.008
"""Points within this distance of the outline of an object belong to it [m]."""
THIN: Final = np.ones((5, 5), np.uint8)
"""Pixels in strips thinner than this are the smeared border of a known object [px]."""
_FIELD_STEP: Final = 0.001
"""Edge of a cell of the signed distance field [m]."""
NOISE_STEP: Final = 0.005
"""A smaller difference of heights is noise [m]: three times the noise of a height."""
_TURNS: Final = 16
"""By which an outline is turned, up to a half one."""
FIELD_MARGIN: Final = 0.04
"""Width of the field around the outline [m]; further out the distance is held."""


@dataclass(frozen=True, slots=True)
class Segment:
    """One connected patch of object pixels."""

    rows: slice
    columns: slice
    """Its box in the image."""
    mask: BoolArray
    """Its pixels in the box."""
    centre: Float64Array
    """Mean of its points [m], shape (2,), table frame."""
    area: float
    """Approximate area that it covers on the table [m^2]."""
    fault: Reason | None
    """Why it cannot be registered in this frame; None where all of it is visible."""

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return self.rows, self.columns

    @property
    def whole(self) -> bool:
        """Whether all of it is visible."""
        return self.fault is None

    def points_in(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Of the points of an image, shape (height, width, 3), those at its pixels, shape (n, 3)."""
        return points[self.rows, self.columns][self.mask]

    def measured_in(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """The same without pixels that measure nothing."""
        inside = self.points_in(points)
        return inside[np.isfinite(inside[:, 2])]

    def refusal(self, points: NDArray[np.float32], reason: Reason, why: str = "") -> Refusal:
        """Its refusal in a frame with these points [m], shape (height, width, 3), table frame."""
        measured = self.measured_in(points)
        hull = cv2.convexHull(measured[:, :2].astype(np.float32))[:, 0].astype(np.float64)
        return Refusal(reason, why or reason.value, hull, float(np.quantile(measured[:, 2], TOP_QUANTILE)))


@dataclass(frozen=True, slots=True)
class SegmentedView:
    """An object at rest in the image of one camera."""

    view: FrameView
    """Preferably of the `median_frame` of several frames."""
    segment: Segment
    """Pixels of the object."""


@dataclass(frozen=True, slots=True)
class TracedObject:
    """An object as cameras traced it: shape, pose and heights."""

    shape: ObjectShape
    pose: Float64Array
    """(x, y, yaw) of the object frame in the table frame [m, m, rad]: origin in the centroid of the outline, yaw 0."""
    top: NDArray[np.float32]
    """Height of its upper side [m], shape (rows along y, columns along x); outside the object that of the nearest cell."""
    top_origin: Float64Array
    """Centre of the first cell of `top` [m], shape (2,), object frame."""
    top_resolution: float
    """Edge of a cell of `top` [m]."""
    hollow: BoolArray | None = None
    """Which cells of `top` lie over a hollow, same shape; `top` has the height of the rim there. None where nothing is hollow."""
    camera_positions: tuple[Float64Array, ...] | None = None
    """Of the cameras that traced it in each rest [m], shapes (n, 2), object frame; None: unknown."""
    displaced: float = 0.0
    """How far the camera is expected to displace edges whose wall it does not see, outwards and all of them alike [m]. The outline is
    without it."""
    displaced_std: float = 0.0
    """Standard deviation of that [m]."""
    displaced_frame: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement (x, y, yaw) of the object frame by such edges, per metre of theirs [-, -, rad/m], object frame: 0 for the first view."""
    frame_covariance: Float64Array = field(default_factory=lambda: np.zeros((3, 3)))
    """Covariance of the object frame by single edges of earlier outlines, shape (3, 3), object frame: 0 for the first view."""
    keeps_heading: bool = True
    """Whether pose fits that start at headings on both sides of the true one end near it."""


@dataclass(frozen=True, slots=True)
class NewObject:
    """A segment that has become an object."""

    traced: TracedObject
    area: float
    """Of its segment [m^2]."""
    views: tuple[SegmentedView, ...]
    """It was traced from."""
    doubt: str
    """Why contact may not be where its outline is, for people; empty where nothing speaks against it."""


@dataclass(frozen=True, slots=True)
class KnownObject:
    """What is needed to find an object again: how it was traced, and its latest pose."""

    traced: TracedObject
    area: float
    """Area of its segment [m^2]."""
    pose: Float64Array
    """(x, y, yaw) [m, m, rad], table frame."""


@dataclass(frozen=True, slots=True)
class Refined:
    """A known object as several rests show it."""

    traced: TracedObject
    """With the outline of all views, and the deviations of its edges."""
    poses: tuple[Float64Array, ...]
    """In each view."""
    area: float
    """Of its segment in the latest view [m^2]."""
    misfit: float
    """Scatter of its edges about the outline in the latest rest [m]."""
    misfit_before: float
    """The same about the outline before."""


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
    """The part of the covariance that the residuals of the frame show: without the errors that all frames at this pose share."""

    @property
    def can_start_next(self) -> bool:
        """Whether the fit of the next frame may start from this pose. That includes poses too hidden to be published, if all but 2 % of the
        pixels away from the edge agree with them, and more than 300 determine them to 2 mm and 0.03 rad."""
        return self.status is TrackStatus.TRACKED or (
            self.status is TrackStatus.HIDDEN
            and self.share_contradicting < 0.02
            and self.n_pixels > 300
            and bool(np.all(np.diag(self.covariance) < np.square((0.002, 0.002, 0.03))))
        )


class Template:
    """What a pose fit needs of an object: the signed distance field of its outline and the heights of its upper side."""

    def __init__(self, traced: TracedObject) -> None:
        self.outline = traced.shape.outline
        self.traced: Final = traced
        self.camera_positions: Final = None if traced.camera_positions is None else _padded(traced.camera_positions)
        """As of `TracedObject`, shape (n_rests, n_cameras, 2); NaN where a rest has fewer cameras."""
        self.tops: Final = Grid(
            traced.top.astype(np.float64, order="C"), np.array(traced.top_origin, dtype=np.float64), float(traced.top_resolution)
        )
        """Heights of the upper side [m]."""
        self.hollow: Final = None if traced.hollow is None else self.tops._replace(values=traced.hollow.astype(np.float64, order="C"))
        """1 in the cells of `tops` that lie over a hollow; None where there is none."""
        around = np.ones((5, 5), np.uint8)  # Steps of the upper side, and edges of hollows, are known to two cells.
        lowest = cv2.erode(self.tops.values, around)
        if traced.hollow is not None:
            lowest[cv2.dilate(traced.hollow.astype(np.uint8), around) > 0] = 0.0
        self.lowest: Final = self.tops._replace(values=lowest)
        """Lowest height of the upper side nearby [m]: 0 beside a hollow."""
        self.field: Final = _distance_field(np.ascontiguousarray(self.outline, dtype=np.float64))
        """Signed distance to the outline [m]."""
        self.top_range = float(traced.top.min()), float(traced.top.max())
        """Lowest and highest point of the upper side [m]."""
        self.radius = float(np.linalg.norm(self.outline, axis=1).max())
        """Radius of the circle around the origin that holds the outline [m]."""

    @cached_property
    def has_heading(self) -> bool:
        """Whether yaw means anything: fits keep it, and the outline turned about its centroid differs from itself by more than two
        tracings of it do."""
        std = self.traced.shape.outline_std
        if std is None or not self.traced.keeps_heading:
            return self.traced.keeps_heading
        points = dense(self.outline, ON_OBJECT / 2.0)
        turned = [points @ rotation(angle).T for angle in np.linspace(0.0, np.pi, _TURNS + 1)[1:]]
        most = max(float(np.mean(np.square(self.distance(one)[0]))) for one in turned)
        return most > 2.0 * float(np.mean(np.square(std)))

    def distance(self, points: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Signed distance [m], shape (n,), and its gradient, shape (n, 2), at points (n, 2) in the object frame."""
        value, gradient = interpolate(self.field, np.ascontiguousarray(points, dtype=np.float64))
        return value, gradient

    def nearest_distance(self, points: NDArray[np.floating]) -> Float64Array:
        """Signed distance [m] at the nearest node of the field, shape (n,): faster, and accurate to half a cell of the field."""
        return np.asarray(nearest_values(self.field, np.ascontiguousarray(points, dtype=np.float64)))

    def nearest_top(self, points: NDArray[np.floating], *, lowest: bool = False) -> Float64Array:
        """Height of the upper side [m] at the nearest cell, or the lowest within some millimetres, at points (n, 2), object frame."""
        return np.asarray(nearest_values(self.lowest if lowest else self.tops, np.ascontiguousarray(points, dtype=np.float64)))


Placed = tuple[Template, Float64Array]
"""A known object and its pose (x, y, yaw) [m, m, rad], table frame."""


def area_from_above(points: Float64Array) -> float:
    """Area of the 4 mm cells that hold points, shape (n, 3) [m^2]; independent of side walls and of the density of the pixels."""
    return 1.6e-5 * len(np.unique(np.floor(points[:, :2] / 0.004).astype(np.int64) @ np.array([1, 1 << 20])))


def _distance_field(outline: Float64Array) -> Grid:
    """Signed distance to an outline, shape (n, 2): exact near it; further out every fourth node, interpolated linearly, is enough."""
    origin = outline.min(axis=0) - FIELD_MARGIN
    columns, rows = (int(n) for n in np.ceil((outline.max(axis=0) + FIELD_MARGIN - origin) / (4 * _FIELD_STEP)) * 4 + 1)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    nodes = origin + _FIELD_STEP * np.stack([x, y], axis=-1)
    coarse = outline_distances(nodes[::4, ::4].reshape(-1, 2), outline).reshape(nodes[::4, ::4].shape[:2])
    distance = _interpolated(_interpolated(coarse, 4).T, 4).T.copy()
    near = np.abs(distance) < 0.012
    distance[near] = outline_distances(nodes[near], outline)
    return Grid(distance, origin, _FIELD_STEP)


def _interpolated(values: Float64Array, factor: int) -> Float64Array:
    """Linear interpolation along the rows of `values`, shape (n, m), to `factor` times as many steps, shape (n, factor (m - 1) + 1)."""
    slope = np.diff(values, axis=1) / factor
    between = slope[:, :, None] * np.arange(factor) + values[:, :-1, None]
    return np.hstack([between.reshape(len(values), -1), values[:, -1:]])


def _padded(rests: Sequence[Float64Array]) -> Float64Array:
    """Positions of the cameras of each rest as one array, NaN where a rest has fewer cameras."""
    padded = np.full((len(rests), max(len(positions) for positions in rests), 2), np.nan)
    for row, positions in zip(padded, rests, strict=True):
        row[: len(positions)] = positions
    return padded
