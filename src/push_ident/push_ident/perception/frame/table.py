"""The table plane, as measured near z = 0 of the extrinsics' table frame, and the pose of the camera that it corrects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import PerceptionError
from push_ident.geometry.outline import points_in_polygon
from push_ident.perception.frame.depth_unit import wrong_unit
from push_ident.perception.frame.robot import RobotPart
from push_ident.perception.frame.view import DEVIATIONS, STRIDE, FrameView, points_in_table
from push_ident.perception.settings import PerceptionSettings, TableSettings
from push_ident.types import BoolArray, DepthFrame, Float64Array

_MIN_POINTS: Final = 125
"""Least number of points on the plane, after the stride."""


class TableElsewhereError(PerceptionError):
    """The plane of the table is further from its place in the extrinsics than those of a usable calibration."""


@dataclass(frozen=True, slots=True)
class TablePlane:
    """z = slope_x x + slope_y y + offset in the table frame of the extrinsics; all zero where the extrinsics are exact."""

    slope: tuple[float, float]
    offset: float
    """[m]"""
    noise: float
    """Standard deviation of the heights of single points about the plane [m]."""

    @property
    def least_height(self) -> float:
        """Height below which nothing can be told from the table [m]."""
        return DEVIATIONS * self.noise

    def height(self, x: float, y: float) -> float:
        """Height of the plane above the expected one at (x, y) [m]."""
        return self.slope[0] * x + self.slope[1] * y + self.offset

    def difference(self, other: TablePlane, settings: PerceptionSettings) -> float:
        """Largest difference of the heights of two planes at the corners of the workspace [m]."""
        (x0, y0), (x1, y1) = settings.workspace_low, settings.workspace_high
        return max(abs(self.height(x, y) - other.height(x, y)) for x, y in ((x0, y0), (x0, y1), (x1, y0), (x1, y1)))

    def correct(self, camera_in_table: ArrayLike) -> Float64Array:
        """Camera pose, shape (4, 4), corrected by the smallest rigid motion that moves the plane to z = 0."""
        normal = np.array([-self.slope[0], -self.slope[1], 1.0])
        normal /= np.linalg.norm(normal)
        # Smallest rotation that takes the normal to the z axis (Rodrigues with the axis normal x z).
        ax, ay = normal[1], -normal[0]
        skew = np.array([[0.0, 0.0, ay], [0.0, 0.0, -ax], [-ay, ax, 0.0]])
        correction = np.eye(4)
        correction[:3, :3] += skew + skew @ skew / (1.0 + normal[2])
        correction[2, 3] = -normal[2] * self.offset
        return np.asarray(correction @ np.asarray(camera_in_table, dtype=np.float64))


def fit_table(points: NDArray[np.float32], settings: PerceptionSettings) -> TablePlane:
    """Fit the plane to the points near z = 0 in the workspace: a few random planes, then least squares on the inliers.

    Args:
        points: [m], shape (height, width, 3), table frame of the extrinsics; NaN where nothing was measured.

    Raises PerceptionError: No valid pixel, too few points on a plane, too many under it, or (TableElsewhereError) a correction larger than
    the error of usable extrinsics.
    """
    sample = points[::STRIDE, ::STRIDE]
    pixels = np.argwhere(np.isfinite(sample[..., 2]))
    valid = sample[tuple(pixels.T)].astype(np.float64)
    if len(valid) == 0:
        raise PerceptionError(f"Depth image has 0 valid of {points.shape[0] * points.shape[1]} pixels; check the camera and its range.")
    low, high, accepted = settings.workspace_low, settings.workspace_high, settings.table
    in_workspace = np.all((valid[:, :2] >= low) & (valid[:, :2] <= high), axis=1)
    near = valid[in_workspace & (np.abs(valid[:, 2]) < accepted.search_height)]
    needed = max(_MIN_POINTS, int(accepted.min_share * np.count_nonzero(in_workspace)))
    if len(near) < needed:
        _check_that_it_is_nowhere_else(valid, accepted)
        raise PerceptionError(
            f"{len(near)} of {len(valid)} points lie within {accepted.search_height * 1e3:.0f} mm of the table, expected at least "
            f"{needed}; check the extrinsics and that the camera sees the workspace."
        )
    plane, design = _best_random_plane(near, accepted.max_tilt), np.column_stack([near[:, :2], np.ones(len(near))])
    for _ in range(4):
        distance = near[:, 2] - design @ plane
        noise = 1.4826 * float(np.median(np.abs(distance[np.abs(distance) < 0.01]))) if np.any(np.abs(distance) < 0.01) else 0.01
        inliers = np.abs(distance) < 3.0 * max(noise, 2e-4)
        if np.count_nonzero(inliers) < needed:
            _check_that_it_is_nowhere_else(valid, accepted)
            raise PerceptionError(
                f"{np.count_nonzero(inliers)} of {len(near)} points agree on a plane, expected {needed}; clear the table."
            )
        chosen = design[inliers]
        plane = np.linalg.lstsq(chosen.T @ chosen, chosen.T @ near[inliers, 2], rcond=None)[0]
    _check_place(plane, accepted, "calibrate the camera")
    if noise > accepted.max_noise:
        raise PerceptionError(
            f"The points of the table deviate by {noise * 1e3:.1f} mm from a plane, expected at most {accepted.max_noise * 1e3:.0f} mm; "
            "it is not flat, or glossy, or too far from the camera."
        )
    height = valid[in_workspace] @ np.array([-plane[0], -plane[1], 1.0]) - plane[2]
    below = height < -max(accepted.under, DEVIATIONS * noise)
    # The floor of the room may be in view beside the table; a reflection, and the floor of a bin, are seen inside it.
    of_table = np.abs(height) < 3.0 * max(noise, 2e-4)
    under = float(np.mean(below & _surrounded(pixels[in_workspace], of_table, sample.shape[:2])))
    if under > accepted.max_share_under:
        raise PerceptionError(
            f"{under:.0%} of the points in the workspace lie more than {accepted.under * 1e3:.0f} mm under the table, expected at most "
            f"{accepted.max_share_under:.0%}: a reflection, or the rim of a bin taken for the table; check extrinsics and workspace."
        )
    return TablePlane((float(plane[0]), float(plane[1])), float(plane[2]), max(noise, 1e-4))


def _check_place(plane: Float64Array, accepted: TableSettings, remedy: str) -> None:
    tilt = float(np.hypot(plane[0], plane[1]))
    if tilt > accepted.max_tilt or abs(plane[2]) > accepted.max_offset:
        raise TableElsewhereError(
            f"The table is tilted by {tilt:.3f} rad and {plane[2] * 1e3:.0f} mm from its place in the extrinsics, "
            f"expected at most {accepted.max_tilt} rad and {accepted.max_offset * 1e3:.0f} mm; {remedy}."
        )


def _check_that_it_is_nowhere_else(points: Float64Array, accepted: TableSettings) -> None:
    """Raises PerceptionError where enough of all points, shape (n, 3), lie on a plane that is not where the extrinsics have the table."""
    plane = _best_random_plane(points, np.inf)
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    on_plane = np.abs(points[:, 2] - design @ plane) < 0.01
    if np.mean(on_plane) > accepted.min_share and np.count_nonzero(on_plane) >= _MIN_POINTS:
        elsewhere = np.linalg.lstsq(design[on_plane], points[on_plane, 2], rcond=None)[0]
        _check_place(elsewhere, accepted, "calibrate the camera, or clear the table where that plane is a thing on it")


def _surrounded(pixels: NDArray[np.intp], of_table: BoolArray, shape: tuple[int, int]) -> BoolArray:
    """Which pixels (row, column), shape (n, 2), lie in the convex hull of those of the table in an image of a shape."""
    mask = np.zeros(shape, dtype=np.uint8)
    mask[tuple(pixels[of_table].T)] = 1
    # What crosses the height of the table elsewhere, as a chair does, has few pixels there.
    solid = cv2.findNonZero(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)))
    if solid is None:
        return np.ones(len(pixels), dtype=bool)
    return points_in_polygon(pixels[:, ::-1].astype(np.float64), cv2.convexHull(solid)[:, 0].astype(np.float64))


def _best_random_plane(points: Float64Array, max_tilt: float) -> Float64Array:
    rng, n_planes = np.random.default_rng(0), 60
    scored = points[rng.integers(len(points), size=min(len(points), 1500))]
    triples = points[rng.integers(len(points), size=(n_planes, 3))]
    design = np.concatenate([triples[:, :, :2], np.ones((n_planes, 3, 1))], axis=2)
    spread = np.abs(np.linalg.det(design)) > 1e-3
    planes = np.linalg.solve(design[spread], triples[spread][:, :, 2:])[:, :, 0]
    planes = planes[np.hypot(planes[:, 0], planes[:, 1]) < 2 * max_tilt]
    if len(planes) == 0:
        return np.zeros(3)
    distance = scored[:, 2:] - scored[:, :2] @ planes[:, :2].T - planes[:, 2]
    return np.asarray(planes[np.argmax(np.count_nonzero(np.abs(distance) < 0.006, axis=0))])


class TableCamera:
    """The camera over the table: its extrinsics, corrected by the plane of the table in its frames.

    Args:
        extrinsics: Optical frame in the table frame, homogeneous, shape (4, 4).
        settings: May be replaced between frames.
    """

    def __init__(self, extrinsics: Float64Array, settings: PerceptionSettings) -> None:
        self._extrinsics = extrinsics
        self.settings = settings
        self.plane: TablePlane | None = None
        """In use; None before the first frame."""
        self.camera_in_table = extrinsics
        """Optical frame in the table frame, shape (4, 4); another array after each change."""
        self.n_hidden = 0
        """Checks in which too little of the table was visible."""
        self.last_check = -np.inf
        """Stamp of the frame of the last check [s]."""

    def view(self, frame: DepthFrame, robot: Sequence[RobotPart]) -> FrameView:
        """The frame seen by this camera; the first frame gives the plane. Raises PerceptionError: No table is found in the first frame."""
        if self.plane is None:
            try:
                self._use(fit_table(FrameView(frame, self._extrinsics, settings=self.settings).points, self.settings))
            except PerceptionError:
                if wrong := wrong_unit(frame, self._extrinsics):
                    remedy = "publish millimetres as 16UC1 and metres as 32FC1 (REP 118)"
                    raise PerceptionError(f"No table is where the extrinsics say, since {wrong}; {remedy}.") from None
                raise
        assert self.plane is not None
        # An object is higher than the noise of the table.
        limits = replace(self.settings, min_object_height=max(self.settings.min_object_height, self.plane.least_height))
        return FrameView(frame, self.camera_in_table, robot, limits, self.plane.noise)

    def current(self, view: FrameView) -> FrameView:
        """The view, with the plane as it is now."""
        return view if view.camera_in_table is self.camera_in_table else self.view(view.frame, view.robot)

    def check_plane(self, view: FrameView) -> None:
        """Use another plane from now on if the table or the camera was moved. Smaller differences are noise and would make the poses jump.

        A plane that was fitted to a noisy image, such as the first one of a camera that starts, gets the noise of a better one: otherwise
        the low parts of objects would count as table. One that was fitted to an image in which the table was elsewhere is fitted again.
        """
        self.last_check = view.frame.stamp
        assert self.plane is not None
        try:
            plane = self._plane_in(view, self.plane)
        except PerceptionError:
            self.n_hidden += 1  # The robot may cover the table for a while; the plane in use remains valid.
            return
        if plane is not self.plane:
            self._use(plane)

    def _plane_in(self, view: FrameView, plane: TablePlane) -> TablePlane:
        """The plane to use from this frame on, `plane` as a rule. Raises PerceptionError: the table is hidden."""
        try:
            moved = fit_table(view.points, self.settings)
        except PerceptionError:
            # As far from the plane in use as a correction goes, and as near to the extrinsics.
            anew = fit_table(points_in_table(view.frame, self._extrinsics), self.settings)
            if anew.difference(plane, self.settings) <= self.settings.table.moved:
                raise
            return anew
        if moved.difference(TablePlane((0.0, 0.0), 0.0, 0.0), self.settings) > self.settings.table.moved:
            return fit_table(points_in_table(view.frame, self._extrinsics), self.settings)
        return replace(plane, noise=moved.noise) if moved.noise < self.settings.table.calmer * plane.noise else plane

    def _use(self, plane: TablePlane) -> None:
        self.plane, self.camera_in_table = plane, plane.correct(self._extrinsics)
