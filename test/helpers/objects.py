"""Objects and pushes that several tests share."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from push_ident.geometry.outline import outline_of_cells, signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PoseTrack, PusherPath, PushRecord, WrenchTrack

if TYPE_CHECKING:
    from push_ident.physics.overhang import TableEdge


def hammer_shape(size: float = 0.011) -> ObjectShape:
    """A handle two cells wide and a head ten cells long, 70 cells; the frame's origin lies in the handle near the head."""
    handle = [(i, j) for i in range(15) for j in range(-1, 1)]
    head = [(i, j) for i in range(15, 19) for j in range(-5, 5)]
    centres = (np.array(handle + head) + np.array([-12.4, 0.5])) * size
    return ObjectShape(CellGrid(centres, size), outline_of_cells(centres, size))


def hammer(seed: int = 0, pusher_friction: float = 0.25) -> ObjectModel:
    """A hammer with a heavy head; the seed varies cells and contrast."""
    rng = np.random.default_rng(seed)
    shape = hammer_shape()
    head = shape.cells.centres[:, 0] > 0.02
    mass = np.where(head, rng.uniform(3, 8), 1.0) * np.exp(0.2 * rng.normal(size=len(head)))
    friction = np.where(head, 0.35, 0.25) * np.exp(0.15 * rng.normal(size=len(head)))
    return ObjectModel(shape, mass * 0.6 / mass.sum(), friction, pusher_friction)


def square(n: int = 9, size: float = 0.01) -> ObjectShape:
    """A square of n x n cells, centred on its frame."""
    centres = (np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2) - (n - 1) / 2) * size
    return ObjectShape(CellGrid(centres, size), outline_of_cells(centres, size))


def uniform(shape: ObjectShape, mass: float = 0.7, friction: float = 0.37, pusher_friction: float = 0.2) -> ObjectModel:
    """An object whose cells all have the same mass and friction."""
    n = len(shape.cells)
    return ObjectModel(shape, np.full(n, mass / n), np.full(n, friction), pusher_friction)


def straight_push(
    start: tuple[float, float],
    heading: float,
    *,
    travel: float = 0.09,
    speed: float = 0.15,
    radius: float = 0.008,
    rest: float = 0.4,
    rate: float = 60.0,
) -> PusherPath:
    """A pusher that stands, drives straight at constant speed, and stands again."""
    time = np.arange(0.0, travel / speed + 2 * rest, 1 / rate)
    travelled = np.clip((time - rest) * speed, 0.0, travel)
    return PusherPath(time, np.array(start) + travelled[:, None] * [np.cos(heading), np.sin(heading)], radius)


def random_push(shape: ObjectShape, pose: Float64Array, rng: np.random.Generator, *, radius: float = 0.008) -> PusherPath:
    """A push at a random point of the outline, within 40 degrees of its normal, that starts clear of the object."""
    outline = shape.outline
    edge = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(edge, axis=1)
    while True:
        i = rng.choice(len(edge), p=length / length.sum())
        point = outline[i] + rng.uniform(0.1, 0.9) * edge[i]
        normal = np.array([edge[i, 1], -edge[i, 0]]) / length[i]
        heading = np.arctan2(-normal[1], -normal[0]) + rng.uniform(-0.7, 0.7)
        along = np.array([np.cos(heading), np.sin(heading)])
        start = point + normal * (radius + 1e-4) - 0.02 * along
        if signed_distance(start[None], outline)[0] > radius:
            break
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    x, y = pose[:2] + turn @ start
    return straight_push((x, y), heading + pose[2], travel=rng.uniform(0.06, 0.1), speed=rng.uniform(0.1, 0.2), radius=radius)


def record_of(model: ObjectModel, pusher: PusherPath, pose: Float64Array, rng: np.random.Generator, *, noise: float = 1.0) -> PushRecord:
    """A push as a camera would observe it at 30 Hz, with `noise` times 1 mm and 0.5 degrees, from the simulation of `model`."""
    from push_ident.physics.scenario import PushScenario
    from push_ident.physics.simulation import SimulationSettings, simulate

    time = np.arange(pusher.time[0], pusher.time[-1], 1 / 30)
    motion = simulate(model, PushScenario(pusher, pose, time), settings=SimulationSettings(step=1 / 960))
    std = noise * np.array([1e-3, 1e-3, np.radians(0.5)])
    observed = motion.pose + std * rng.normal(size=motion.pose.shape)
    covariance = np.broadcast_to(np.diag(np.maximum(std, 1e-5) ** 2), (len(time), 3, 3))
    return PushRecord("1", model.shape, PoseTrack(time, observed, covariance), pusher)


def random_records(model: ObjectModel, n: int, seed: int, *, noise: float = 1.0) -> list[PushRecord]:
    """Random pushes that all move the object, each from a pose of its own."""
    from push_ident.physics.scenario import PushScenario
    from push_ident.physics.simulation import simulate

    rng = np.random.default_rng(seed)
    records: list[PushRecord] = []
    while len(records) < n:
        pose = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-np.pi, np.pi)])
        pusher = random_push(model.shape, pose, rng)
        end = simulate(model, PushScenario(pusher, pose, pusher.time[-1:])).pose[-1]
        if np.linalg.norm(end[:2] - pose[:2]) > 0.01 or abs(end[2] - pose[2]) > 0.1:
            records.append(record_of(model, pusher, pose, rng, noise=noise))
    return records


def with_frames(record: PushRecord, frames: ArrayLike, driven: ArrayLike | None = None) -> PushRecord:
    """The same push of which only these poses are known, and only these samples of the pusher's path."""
    poses, pusher = record.poses, record.pusher
    if driven is not None:
        pusher = replace(pusher, time=pusher.time[driven], position=pusher.position[driven])
    return replace(record, poses=PoseTrack(poses.time[frames], poses.pose[frames], poses.covariance[frames]), pusher=pusher)


def with_forces(record: PushRecord, model: ObjectModel, effects: dict[str, list[float]] | None = None, *, std: float = 0.05) -> PushRecord:
    """The same push with the forces of the true model, as a sensor measures them at 100 Hz with noise of `std` [N]."""
    from push_ident.physics.effect_values import effect_values, force_times, measured_forces
    from push_ident.physics.scenario import PushScenario
    from push_ident.physics.simulation import SimulationSettings, simulate

    rng = np.random.default_rng(len(record.poses.time))
    edges = np.arange(record.pusher.time[0] - 0.2, record.pusher.time[-1], 0.01)
    times = force_times(effect_values(effects), edges)[0]
    scenario = PushScenario(record.pusher, record.poses.pose[0], record.poses.time[-1:], record.order, times)
    motion = simulate(model, scenario, settings=SimulationSettings(step=1 / 960), effects=effects)
    force = measured_forces(effect_values(effects), np.diff(motion.impulse, axis=0) / 0.01)[0]
    return replace(record, wrench=WrenchTrack(edges[1:], force + std * rng.normal(size=force.shape)))


def overhung_loads(edge: TableEdge, model: ObjectModel, pose: Float64Array) -> Float64Array | None:
    """Load of each cell of an object at the edge of the table as a share of its weight, shape (n_cells,); None where it falls."""
    from push_ident.physics.overhang import Overhang, share_loads

    cells, weight = model.shape.cells.centres, model.mass / model.total_mass
    arms, factor = np.ascontiguousarray((cells - weight @ cells).T), np.ones(len(weight))
    centre, overhang = transform_points(pose, (weight @ cells)[None])[0], Overhang(edge.outward.copy(), float(edge.offset), weight)
    return weight * factor if share_loads(overhang, arms, centre, float(np.cos(pose[2])), float(np.sin(pose[2])), factor) else None
