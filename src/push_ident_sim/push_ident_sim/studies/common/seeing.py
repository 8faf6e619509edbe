"""Errors of perception on rendered frames of a known object: outline, cells and poses against the truth."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from push_ident.errors import InputError, PerceptionError, PlanningError
from push_ident.geometry.outline import points_in_polygon, signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.perception.frame.occupancy import OCCUPIED, TopDownGrid
from push_ident.perception.frame.robot import RobotPart
from push_ident.perception.known_object import TrackStatus
from push_ident.perception.observation import Observation
from push_ident.perception.pipeline import Perception
from push_ident.types import BoolArray, DepthFrame, Float64Array, ObjectShape
from push_ident_sim.cell.camera import DepthCamera, View
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import PLAIN, suitable_pose
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.studies.common.arm_in_view import ArmInView, first_touch
from push_ident_sim.studies.common.base import Json

__all__ = ["CAMERA_POSE", "RATE", "cover", "outline_errors", "postures_of_pushes", "see_pushes", "unit_of", "views_of_pushes"]

Seen = View | NDArray[np.float32]

CAMERA_POSE: Final = suitable_pose(PLAIN)
"""Of the simulated cell."""
RATE: Final = 30.0
"""Frames a second."""
_PUSHES: Final = 3
_MOVING: Final = 16
"""Frames of one push: 8 cm in half a second."""
_AT_REST: Final = 20
"""Frames between two pushes: long enough for a better outline."""
_LOWERED: Final = 4
"""Frames for which the tool waits before and after a push."""
_DRAWS: Final = 20
"""Draws of pushes, until the arm can make them."""
_CLEARANCE: Final = 0.03
"""Travel of the pusher before it touches [m], as the cell pushes."""
_FINE: Final = 5e-4
"""Edge of the grid on which areas are compared [m]."""
_NO_PARTS: Final[tuple[RobotPart, ...]] = ()
_RAISED: Final = 0.005
"""A pixel that is nearer than the table behind it by more than this is occluded [m]."""
_COVER_HEIGHT: Final = 0.25
"""Height of the occluding surface above the table [m]: that of a forearm."""


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
        # Roughly towards the middle, so that the object stays on the table.
        heading = np.arctan2(-pose[1], -pose[0]) + rng.uniform(-1.0, 1.0)
        travel = rng.uniform(0.05, 0.10)
        change = np.array([travel * np.cos(heading), travel * np.sin(heading), rng.uniform(-0.7, 0.7)])
        # Speed of a push: from rest to a constant speed and back to rest.
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
    rows, columns = np.nonzero(clear < empty - _RAISED)
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


def postures_of_pushes(arm: ArmInView, views: Sequence[_View], outline: Float64Array) -> list[Float64Array]:
    """Posture of the arm [rad] in each view: its tool moves with the object and waits before and after; else it is parked.

    Args:
        outline: Of the object, shape (n, 2), object frame [m].

    Raises:
        PlanningError: The arm does not reach the object.
    """
    postures = [arm.home] * len(views)
    for first in (i for i, view in enumerate(views) if view.moving and not views[i - 1].moving):
        before, last = views[first - 1].pose, first + _MOVING - 1
        touch, heading = first_touch(outline, before, views[last].pose - before)
        postures[first - _LOWERED : first] = [arm.lowered(touch - _CLEARANCE * heading)] * _LOWERED
        in_object = transform_points(inverse(before), touch[None])
        posture = arm.moved(postures[first - 1], touch)
        for i in range(first, last + 1):
            postures[i] = posture = arm.moved(posture, transform_points(views[i].pose, in_object)[0])
        postures[last + 1 : last + 1 + _LOWERED] = [posture] * _LOWERED
    return postures


def _pushes_of_arm(arm: ArmInView, outline: Float64Array, rng: np.random.Generator) -> tuple[list[_View], list[Float64Array]]:
    """Views of pushes that the arm can make, and its posture in each; pushes that it cannot make are drawn again."""
    for _ in range(_DRAWS - 1):
        views = views_of_pushes(rng)
        with contextlib.suppress(PlanningError):
            return views, postures_of_pushes(arm, views, outline)
    views = views_of_pushes(rng)
    return views, postures_of_pushes(arm, views, outline)


def see_pushes(object_name: str, seed: int, hidden: float = 0.0, *, with_arm: bool = False, sensor: str = PLAIN) -> Json:
    """Errors of perception over a few pushes of one object.

    Args:
        hidden: Share of the object's pixels that is covered once the object is known; of the plain sensor only, since nobody knows what
            shadow that which covers it casts.
        with_arm: The arm that pushes is in the picture; perception gets its true posture.
        sensor: Model of the camera, at a pose that suits it. Each case is another unit, and perception gets the pose and the intrinsics
            that the unit publishes. Errors are those in the table frame that the camera sees; the object first lies `table_m` off.

    Returns:
        Of the outline from one view `outline_m` (root mean square), `placed_m` (the same, placed as well as a rigid motion can),
        `outline_95_m`, `grid_iou`; after the last push `refined_m` and `refined_placed_m`; `occupancy_iou`, and per kind of frame
        (`rest`, `moving`) lists `position_m`, `yaw`, `squared` (errors in standard deviations, squared), `hidden` (share of the object's
        pixels) and the number of frames `not_tracked`.

    Raises:
        InputError: No sensor has that name, or the object is to be covered before another sensor than the plain one.
        PerceptionError: The object was not taken in.
        PlanningError: The arm does not reach it.
    """
    if hidden > 0 and sensor != PLAIN:
        raise InputError(f"hidden is {hidden} with the sensor {sensor}, expected 0: only the plain one takes a picture that is covered.")
    thing = make_object(object_name, seed)
    rng = np.random.default_rng([seed, len(object_name), int(100 * hidden)])
    unit, reported = Sensor(sensor, unit_of(object_name, seed)), suitable_pose(sensor)
    camera, perception = unit.camera(thing, reported), Perception(reported)
    empty = camera.render((5.0, 5.0, 0.0), {})
    kinds: dict[str, Json] = {k: {"position_m": [], "yaw": [], "squared": [], "hidden": [], "not_tracked": 0} for k in ("rest", "moving")}
    shape: ObjectShape | None = None
    refined: ObjectShape | None = None
    occupancy = None
    arm = ArmInView() if with_arm else None
    views, postures = _pushes_of_arm(arm, thing.outline, rng) if arm else (views_of_pushes(rng), [])
    for i, (view, seen) in enumerate(_looked_at(unit, camera, views)):
        depth, parts = _depth(seen), _NO_PARTS
        if shape is not None and hidden > 0:
            seen = cover(depth, empty, hidden, rng)
        elif arm:
            seen, parts = unit.look(camera, view.pose, arm.link_poses(postures[i])), arm.parts(postures[i])
        observed = perception.observe(DepthFrame(view.stamp, unit.read(seen, rng), unit.intrinsics), parts)
        if shape is None:
            occupancy = observed.occupancy or occupancy
            if observed.new_shapes:
                shape, table = observed.new_shapes["o1"], unit.table_as_seen(perception.camera_in_table, reported)
                at_first = compose(table, view.pose)
                off, offset = at_first - view.pose, compose(inverse(at_first), perception.first_pose("o1"))
            continue
        refined = observed.refined.get("o1", refined)
        kind = kinds["moving" if view.moving else "rest"]
        on_object = depth < empty - _RAISED
        kind["hidden"].append(round(float(np.mean(_depth(seen)[on_object] < depth[on_object] - _RAISED)), 4))
        _note(kind, observed, compose(compose(table, view.pose), offset))
    if shape is None or occupancy is None:
        raise PerceptionError(f"{object_name} {seed} was not found: {observed.why_no_pose()}.")
    truth = transform_points(inverse(offset), thing.outline)
    last = outline_errors((refined or shape).outline, truth)
    scores = _scores(shape, occupancy, truth, transform_points(at_first, thing.outline)) | {"table_m": round(float(np.hypot(*off[:2])), 6)}
    return scores | {"refined_m": last["outline_m"], "refined_placed_m": last["placed_m"], "kinds": kinds}


def unit_of(object_name: str, seed: int) -> int:
    """Seed of the unit of a sensor in the case of an object: no two cases share one, since five objects before one badly calibrated unit
    would count as five."""
    return len(OBJECT_NAMES) * seed + OBJECT_NAMES.index(object_name)


def outline_errors(outline: Float64Array, truth: Float64Array) -> Json:
    """Root mean square distance of an outline from the true one [m]: `outline_m` where it is, `placed_m` after the best rigid motion.

    Args:
        outline, truth: In one frame [m], shapes (n, 2) and (m, 2).
    """
    points = _dense(outline)

    def distance(motion: Float64Array) -> Float64Array:
        return signed_distance(transform_points(motion, points), truth)

    placed = least_squares(distance, np.zeros(3), x_scale=(1e-3, 1e-3, 1e-2)).x
    return {name: round(float(np.sqrt(np.mean(distance(at) ** 2))), 6) for name, at in (("outline_m", np.zeros(3)), ("placed_m", placed))}


def _scores(shape: ObjectShape, occupancy: TopDownGrid, truth: Float64Array, in_table: Float64Array) -> Json:
    """Errors of the outline and overlaps of areas.

    Args:
        truth, in_table: True outline in the perceived object frame, and in `table` when the object was taken in [m], shape (n, 2).
    """
    distance = np.abs(signed_distance(_dense(shape.outline), truth))
    area = _cells_of(in_table, occupancy.origin, occupancy.resolution, occupancy.occupancy.shape)
    occupied = occupancy.occupancy == OCCUPIED
    return outline_errors(shape.outline, truth) | {
        "outline_95_m": round(float(np.quantile(distance, 0.95)), 6),
        "grid_iou": round(_overlap(shape.outline, truth), 4),
        "occupancy_iou": round(float(np.sum(area & occupied) / np.sum(area | occupied)), 4),
    }


def _looked_at(unit: Sensor, camera: DepthCamera, views: list[_View]) -> Iterator[tuple[_View, Seen]]:
    seen, pose = None, None
    for view in views:
        if seen is None or view.pose is not pose:
            seen, pose = unit.look(camera, view.pose, {}), view.pose
        yield view, seen


def _depth(seen: Seen) -> NDArray[np.float32]:
    """Without errors [m]."""
    return seen.depth if isinstance(seen, View) else seen


def _note(kind: Json, observed: Observation, expected: Float64Array) -> None:
    known = next(known for known in observed.objects if known.object_id == "o1")
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
