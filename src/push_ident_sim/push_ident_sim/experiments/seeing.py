"""What perception makes of rendered frames of a known object: errors of outline, cells and poses against the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.errors import PerceptionError
from push_ident.geometry.outline import points_in_polygon, signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.perception.pipeline import Observation, Perception
from push_ident.perception.topdown import OCCUPIED
from push_ident.perception.tracking import TrackStatus
from push_ident.types import BoolArray, DepthFrame, Float64Array, ObjectShape
from push_ident_sim.camera import DepthCamera, DepthNoise, look_at
from push_ident_sim.experiments.experiment import Json
from push_ident_sim.objects import make_object

__all__ = ["CAMERA_POSE", "RATE", "cover", "see_pushes", "views_of_pushes"]

CAMERA_POSE: Final = look_at((0.55, 0.0, 0.85), (0.0, 0.0, 0.0))
"""Of the simulated cell."""
RATE: Final = 30.0
"""Frames a second."""
_PUSHES: Final = 3
_MOVING: Final = 16
"""Frames of one push: 8 cm in half a second."""
_AT_REST: Final = 8
"""Frames between two pushes."""
_FINE: Final = 5e-4
"""Edge of the grid on which areas are compared [m]."""
_COVER_HEIGHT: Final = 0.25
"""Of what hides a part of the object, above the table [m]: as a forearm is."""


@dataclass(frozen=True, slots=True)
class _View:
    """One moment."""

    stamp: float
    pose: Float64Array
    """Of the object in `table`."""
    moving: bool


def views_of_pushes(rng: np.random.Generator, n_rest: int = 20) -> list[_View]:
    """The object at rest, then pushes of 5 to 10 cm that turn it by up to 40 degrees, each followed by frames at rest."""
    pose = np.array([*rng.uniform(-0.08, 0.08, size=2), rng.uniform(-np.pi, np.pi)])
    poses, moving = [pose] * n_rest, [False] * n_rest
    for _ in range(_PUSHES):
        # Towards the middle, more or less, so that the object stays on the table.
        heading = np.arctan2(-pose[1], -pose[0]) + rng.uniform(-1.0, 1.0)
        way = rng.uniform(0.05, 0.10)
        change = np.array([way * np.cos(heading), way * np.sin(heading), rng.uniform(-0.7, 0.7)])
        # Speed as of a push: from rest to even and back to rest.
        share = np.cumsum(np.sin(np.linspace(0.0, np.pi, _MOVING + 2)[1:-1]) ** 0.5)
        poses += [pose + change * s for s in share / share[-1]]
        moving += [True] * _MOVING
        pose = poses[-1]
        poses += [pose] * _AT_REST
        moving += [False] * _AT_REST
    return [_View(i / RATE, p, m) for i, (p, m) in enumerate(zip(poses, moving, strict=True))]


def cover(clear: NDArray[np.float32], empty: NDArray[np.float32], share: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Depth with something flat held over `share` of the pixels of the object, from a random side of the image.

    Args:
        clear, empty: Depth with and without the object [m], shape (height, width).
    """
    rows, columns = np.nonzero(clear < empty - 0.005)
    angle = rng.uniform(-np.pi, np.pi)
    along = columns * np.cos(angle) + rows * np.sin(angle)
    edge = np.quantile(along, 1.0 - share)
    reach = 1.3 * float(np.ptp(along)) + 40.0
    v, u = np.mgrid[: clear.shape[0], : clear.shape[1]]
    over = u * np.cos(angle) + v * np.sin(angle) - edge
    across = np.abs((v - rows.mean()) * np.cos(angle) - (u - columns.mean()) * np.sin(angle))
    # Parallel to the table: its depth is the same share of that of the table in all pixels.
    scale = np.float32(1.0 - _COVER_HEIGHT / CAMERA_POSE[2, 3])
    return np.where((over > 0) & (over < reach) & (across < reach), np.minimum(clear, empty * scale), clear)


def see_pushes(object_name: str, seed: int, hidden: float) -> Json:
    """Errors of perception over a few pushes of one object.

    Args:
        hidden: Share of the object's pixels that is covered once the object is known.

    Returns:
        `outline_m` (root mean square), `outline_95_m`, `grid_iou`, `occupancy_iou`, and per kind of frame (`rest`, `moving`) lists
        `position_m`, `yaw`, `squared` (errors in standard deviations, squared) and the number of frames `not_tracked`.

    Raises:
        PerceptionError: The object was not taken in.
    """
    thing = make_object(object_name, seed)
    rng = np.random.default_rng([seed, len(object_name), int(100 * hidden)])
    camera, noise = DepthCamera(thing, CAMERA_POSE), DepthNoise()
    empty = camera.render((5.0, 5.0, 0.0), {})
    perception = Perception(CAMERA_POSE)
    kinds: dict[str, Json] = {k: {"position_m": [], "yaw": [], "squared": [], "not_tracked": 0} for k in ("rest", "moving")}
    shape: ObjectShape | None = None
    at_first, occupancy = np.zeros(3), None
    for view, depth in _rendered(camera, views_of_pushes(rng)):
        covered = depth if shape is None or hidden == 0 else cover(depth, empty, hidden, rng)
        seen = perception.observe(DepthFrame(view.stamp, noise.apply(covered.copy(), rng), camera.intrinsics))
        if shape is None:
            occupancy = seen.occupancy or occupancy
            if seen.new_shapes:
                shape, at_first = seen.new_shapes["o1"], view.pose
                offset = compose(inverse(view.pose), perception.first_pose("o1"))
            continue
        _note(kinds["moving" if view.moving else "rest"], seen, compose(view.pose, offset))
    if shape is None or occupancy is None:
        raise PerceptionError(f"{object_name} {seed} was not taken in: {seen.why_nothing()}.")
    truth = transform_points(inverse(offset), thing.outline)
    distance = signed_distance(_dense(shape.outline), truth)
    area = _cells_of(transform_points(at_first, thing.outline), occupancy.origin, occupancy.resolution, occupancy.occupancy.shape)
    return {
        "outline_m": round(float(np.sqrt(np.mean(distance**2))), 6),
        "outline_95_m": round(float(np.quantile(np.abs(distance), 0.95)), 6),
        "grid_iou": round(_overlap(shape.outline, truth), 4),
        "occupancy_iou": round(
            float(np.sum(area & (occupancy.occupancy == OCCUPIED)) / np.sum(area | (occupancy.occupancy == OCCUPIED))), 4
        ),
        "kinds": kinds,
    }


def _rendered(camera: DepthCamera, views: list[_View]) -> Iterator[tuple[_View, NDArray[np.float32]]]:
    depth, pose = None, None
    for view in views:
        if depth is None or view.pose is not pose:
            depth, pose = camera.render(view.pose, {}), view.pose
        yield view, depth


def _note(kind: Json, seen: Observation, expected: Float64Array) -> None:
    known = next(known for known in seen.objects if known.object_id == "o1")
    if known.status is not TrackStatus.TRACKED or known.pose is None or known.covariance is None:
        kind["not_tracked"] += 1
        return
    error = known.pose - expected
    error[2] = wrap_angle(error[2])
    kind["position_m"].append(round(float(np.hypot(*error[:2])), 6))
    kind["yaw"].append(round(float(error[2]), 6))
    kind["squared"].append(round(float(error @ np.linalg.solve(known.covariance, error)), 4))


def _dense(polygon: Float64Array, spacing: float = 5e-4) -> Float64Array:
    """Points along the outline, evenly spaced [m]."""
    parts = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        n = max(1, int(np.linalg.norm(b - a) / spacing))
        parts.append(a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a))
    return np.concatenate(parts)


def _cells_of(polygon: Float64Array, origin: tuple[float, float], size: float, shape: tuple[int, ...]) -> BoolArray:
    """Cells of a grid whose centres lie in the polygon."""
    corners = ((polygon - origin) / size - 0.5) * 16
    mask = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 1, shift=4)
    inside = points_in_polygon((np.argwhere(mask)[:, ::-1] + 0.5) * size + origin, polygon)
    mask[mask > 0] = inside
    return mask > 0


def _overlap(a: Float64Array, b: Float64Array) -> float:
    """Intersection over union of two polygons."""
    low, high = (np.vstack([a, b]).min(axis=0) - _FINE, np.vstack([a, b]).max(axis=0) + _FINE)
    shape = tuple(int(n) for n in np.ceil((high - low) / _FINE)[::-1])
    origin = (float(low[0]), float(low[1]))
    cells_a, cells_b = _cells_of(a, origin, _FINE, shape), _cells_of(b, origin, _FINE, shape)
    return float(np.sum(cells_a & cells_b) / np.sum(cells_a | cells_b))
