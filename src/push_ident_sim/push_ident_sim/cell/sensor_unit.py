"""One unit of a depth sensor: what it reads of a view. `sensors.py` describes the errors and has the figures."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from push_ident.types import CameraAccuracy, CameraIntrinsics, Float64Array
from push_ident_sim.cell.camera import INTRINSICS, DepthCamera, DepthImage, DepthNoise, Placed, View
from push_ident_sim.cell.sensors import PLAIN, SENSORS, SensorModel, check_name
from push_ident_sim.objects import SimObject

Mask = NDArray[np.bool_]

_EDGE = np.float32(0.004)
"""Jump of depth between neighbours beyond what the slope of the surface explains that makes an edge [m]: half of the lowest object."""
_SLOPE = np.float32(1.5)
"""Margin on that slope, for rounding and for surfaces that bend."""
_STEEPEST_COSINE = np.float32(0.05)
"""Surfaces are taken for no steeper than this: 87 degrees."""
_NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)
_FIELDS = ("dropout", "edge", "noise")
"""Random fields of an image, in the order in which they are drawn."""


class Sensor:
    """What one unit reads, and its errors that stand still. One instance may be used by one thread at a time.

    `Sensor("plain")` is `DepthNoise` to the last bit, with the intrinsics `INTRINSICS`.
    """

    def __init__(self, model: str | SensorModel = PLAIN, seed: int = 0, noise_scale: float = 1.0) -> None:
        """A model, or its name in `SENSOR_NAMES`. Raises InputError where no sensor has that name.

        `seed`: of the errors that stand still, another seed is another unit; `noise_scale`: of the axial noise, with 0 the plain sensor has
        neither holes at edges nor steps of disparity.
        """
        if isinstance(model, str):
            check_name(model)
        self._model = SENSORS.get(model) if isinstance(model, str) else model
        self._plain = DepthNoise(scale=noise_scale)
        self._scale = np.float32(noise_scale)
        self._seed = seed
        self._static: dict[str, DepthImage] = {}

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """Those that it publishes."""
        return self._model.intrinsics if self._model else INTRINSICS

    @property
    def encoding(self) -> str:
        """Of its images in ROS: `16UC1` where whole millimetres hold its depth, else `32FC1`."""
        return "32FC1" if self._model and self._model.depth_unit < 1e-3 else "16UC1"

    def accuracy(self, reported: Float64Array) -> CameraAccuracy:
        """How well units of this model know where they are over the table, at this pose, shape (4, 4)."""
        if not self._model:
            return CameraAccuracy()
        distance = float(np.linalg.norm(reported[:3, 3]))
        # A rotation about an axis in the table displaces what lies in the middle of it by the distance.
        position = float(np.hypot(self._model.translation_std, self._model.rotation_std * distance))
        return CameraAccuracy(position, self._model.rotation_std)

    def table_as_seen(self, camera_in_table: Float64Array, reported: Float64Array) -> Float64Array:
        """The true table frame in that of perception (x, y, yaw), shape (3,): the error of the extrinsics that is left.

        `camera_in_table`: as perception has it, after it found the plane of the table; `reported`: as this unit publishes it; both (4, 4).
        """
        if not self._model:
            return np.zeros(3)
        motion = camera_in_table @ np.linalg.inv(reported @ self._model.extrinsics_error(self._seed))
        return np.array([*motion[:2, 3], np.arctan2(motion[1, 0], motion[0, 0])])

    def camera(
        self, sim_object: SimObject, reported: Float64Array, intrinsics: CameraIntrinsics | None = None, description: str | None = None
    ) -> DepthCamera:
        """Camera with the true lens and the true pose of this unit, before `sim_object`.

        `reported`: its pose in `table` as it is published, shape (4, 4); `intrinsics`: true ones but for the distortion, None: the
        published ones; `description`: URDF of the arm before it, None: the iiwa.
        """
        pinhole = intrinsics or self.intrinsics
        if not self._model:
            return DepthCamera(sim_object, reported, pinhole, description=description)
        return DepthCamera(sim_object, reported @ self._model.extrinsics_error(self._seed), pinhole, self._model.distortion, description)

    def look(self, camera: DepthCamera, pose_object: ArrayLike, robot_link_poses: dict[str, Float64Array]) -> View | DepthImage:
        """What lies before `camera`, for `read`: the plain sensor needs no more than depth. Arguments as of `DepthCamera.render`."""
        if not self._model:
            return camera.render(pose_object, robot_link_poses)
        return camera.view([Placed(camera.sim_object, pose_object)], robot_link_poses, self._model.second)

    def read(self, view: View | DepthImage, rng: np.random.Generator) -> DepthImage:
        """Depth as it is measured [m], shape (height, width), NaN where nothing is. What is `seen` comes from `look`."""
        if not isinstance(view, View):
            return self._plain.apply(view.copy(), rng)
        model = self._model or SENSORS["ideal"]
        depth = np.where(np.isfinite(view.depth), view.depth, np.float32(np.inf))
        slope = _slope(depth, view.cosine, model.intrinsics.fx)
        reads = _within_reach(model, depth) & view.lit & (self._field(model, "dropout", rng, depth.shape) > _threshold(model, view))
        ragged = np.float32(model.halo) + np.float32(model.edge_jitter) * self._field(model, "edge", rng, depth.shape)
        # No edge is displaced by more than three standard deviations from its mean displacement.
        reach = int(np.ceil(abs(model.halo) + 3.0 * model.edge_jitter))
        depth, reads = _displaced(depth, reads, slope, ragged, reach)
        depth, reads = _mixed(model, depth, reads, slope, rng)
        depth[~reads] = np.nan
        depth += self._scale * model.noise.deviation(depth, view.cosine) * self._field(model, "noise", rng, depth.shape)
        if model.disparity_step > 0:
            steps = np.float32((model.matching_focal or model.intrinsics.fx) * model.baseline / model.disparity_step)
            depth = steps / np.round(steps / depth)
        return np.asarray(np.round(depth / np.float32(model.depth_unit)) * np.float32(model.depth_unit), dtype=np.float32)

    def _field(self, model: SensorModel, name: str, rng: np.random.Generator, shape: tuple[int, ...]) -> DepthImage:
        """Standard normal numbers, correlated over the window of the matcher and in part the same in every image; shape (height, width)."""
        fresh = _correlated(rng, shape, model.window)
        if model.static_share == 0:
            return fresh
        if name not in self._static:
            generator = np.random.default_rng([self._seed, zlib.crc32(model.name.encode()), 2 + _FIELDS.index(name)])
            self._static[name] = _correlated(generator, shape, model.window)
        share = np.float32(model.static_share)
        return np.sqrt(share) * self._static[name] + np.sqrt(np.float32(1.0) - share) * fresh


def _correlated(rng: np.random.Generator, shape: tuple[int, ...], window: int) -> DepthImage:
    """Standard normal numbers; neighbours share as much of them as windows of that edge [px] around them overlap."""
    white = rng.standard_normal((shape[0] + window - 1, shape[1] + window - 1), dtype=np.float32)
    if window == 1:
        return white
    # The mean of window^2 numbers has the deviation 1 / window. Whole windows only, else the border would vary more.
    blurred = cv2.blur(white, (window, window), anchor=(0, 0))[: shape[0], : shape[1]]
    return np.asarray(blurred * np.float32(window), dtype=np.float32)


def _slope(depth: DepthImage, cosine: DepthImage, focal: float) -> DepthImage:
    """Largest change of depth between neighbours on the surface of each pixel [m], with a margin."""
    cosine = np.maximum(cosine, _STEEPEST_COSINE)
    tangent = np.sqrt(np.maximum(np.float32(1.0) - cosine**2, np.float32(0.0))) / cosine
    return np.where(np.isfinite(depth), depth, np.float32(0.0)) * tangent * (_SLOPE / np.float32(focal))


def _within_reach(model: SensorModel, depth: DepthImage) -> Mask:
    """Pixels whose surface is in range and, if it must, in the picture of the second imager."""
    nearest, farthest = model.depth_range
    reads = np.isfinite(depth) & (depth >= nearest) & (depth <= farthest)
    if model.common_field and model.baseline > 0:
        columns = np.arange(model.intrinsics.width, dtype=np.float32)
        other = columns - np.float32(model.side * model.intrinsics.fx * model.baseline) / depth
        reads &= (other >= 0) & (other <= model.intrinsics.width - 1)
    return reads


def _threshold(model: SensorModel, view: View) -> DepthImage:
    """Number below which a standard normal one lets a pixel read nothing, at grazing incidence and on dark surfaces."""
    chance = np.zeros(view.depth.shape, dtype=np.float32)
    (first, last), (none, all_read) = model.grazing, model.signal
    if first < np.pi / 2:
        angle = np.arccos(np.clip(view.cosine, 0.0, 1.0))
        chance = np.clip((angle - first) / max(last - first, 1e-6), 0.0, 1.0)
    if all_read > 0:
        signal = view.albedo * view.cosine / view.depth**2
        dark = np.clip((all_read - signal) / max(all_read - none, 1e-6), 0.0, 1.0)
        chance = np.nan_to_num(1.0 - (1.0 - chance) * (1.0 - dark))
    threshold = np.full(chance.shape, -np.inf, dtype=np.float32)
    threshold[chance > 0] = ndtri(chance[chance > 0])
    return threshold


def _edges(depth: DepthImage, slope: DepthImage) -> tuple[Mask, Mask]:
    """Pixels on the near and on the far side of a jump of depth."""
    near, far = np.zeros(depth.shape, dtype=bool), np.zeros(depth.shape, dtype=bool)
    for first, second in _pairs():
        with np.errstate(invalid="ignore"):
            jump = depth[second] - depth[first]
        limit = _EDGE + np.maximum(slope[first], slope[second])
        near[first] |= jump > limit
        far[second] |= jump > limit
        near[second] |= jump < -limit
        far[first] |= jump < -limit
    return near, far


def _pairs() -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Each pixel and its neighbour below, each pixel and its neighbour on the right."""
    every = slice(None)
    yield (slice(None, -1), every), (slice(1, None), every)
    yield (every, slice(None, -1)), (every, slice(1, None))


def _nearest(depth: DepthImage) -> DepthImage:
    """Least depth of each pixel and its eight neighbours."""
    return np.asarray(cv2.erode(depth, _NEIGHBOURS, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)


def _farthest(depth: DepthImage) -> DepthImage:
    """Largest depth of each pixel and its eight neighbours."""
    return np.asarray(cv2.dilate(depth, _NEIGHBOURS, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)


def _displaced(depth: DepthImage, reads: Mask, slope: DepthImage, ragged: DepthImage, reach: int) -> tuple[DepthImage, Mask]:
    """Depth with its edges displaced by `ragged` [px], positive away from the nearer surface, and which pixels read; copies.

    Args:
        reach: Largest displacement [px].
    """
    displaced, readable = depth.copy(), reads.copy()
    near, far = _edges(depth, slope)
    if reach == 0 or not near.any():
        return displaced, readable
    front = np.where(near & reads, depth, np.float32(np.inf))
    back = np.where(far, depth, np.float32(-np.inf))
    back_read = np.where(far & reads, depth, np.float32(-np.inf))
    untouched = np.ones(depth.shape, dtype=bool)
    for distance in range(1, reach + 1):
        front, back, back_read = _nearest(front), _farthest(back), _farthest(back_read)
        limit = _EDGE + np.float32(distance) * slope
        # The edge lies half a pixel beside the centre of the last pixel of a surface.
        covered = untouched & (ragged >= distance - 0.5)
        eroded = untouched & (ragged <= 0.5 - distance)
        with np.errstate(invalid="ignore"):
            covered &= depth - front > limit
            eroded &= back - depth > limit
        displaced[covered], readable[covered] = front[covered], True
        displaced[eroded], readable[eroded] = np.abs(back_read[eroded]), np.isfinite(back_read[eroded])
        untouched &= ~(covered | eroded)
    return displaced, readable


def _mixed(model: SensorModel, depth: DepthImage, reads: Mask, slope: DepthImage, rng: np.random.Generator) -> tuple[DepthImage, Mask]:
    """Holes and flying pixels at edges: depth [m] and which pixels read, both changed in place."""
    if model.edge_dropout == 0 and model.flying == 0:
        return depth, reads
    near, far = _edges(depth, slope)
    edge = near | far
    lot, weight = rng.random((2, int(edge.sum())), dtype=np.float32)
    nearest = _nearest(np.where(reads, depth, np.float32(np.inf)))[edge]
    farthest = _farthest(np.where(reads, depth, np.float32(0.0)))[edge]
    holes = lot < model.edge_dropout
    # Without a jump between what reads around it there is nothing to mix: one of the surfaces is in the shadow.
    flies = ~holes & (lot < model.edge_dropout + model.flying) & reads[edge] & (farthest - nearest > _EDGE)
    at_edge = depth[edge]
    at_edge[flies] = 1.0 / (weight[flies] / nearest[flies] + (1.0 - weight[flies]) / farthest[flies])
    depth[edge] = at_edge
    reads[edge] &= ~holes
    return depth, reads
