"""Plates on three feet or on their whole base, and slow pushes of them, of which only the end poses are observed.

The plates resemble those of two recordings: a triangle on three supports, pushed by a thin rod (Zhou, Paolini, Bagnell, Mason, ICRA 2016),
and steel plates pushed by a disc of 4.75 mm radius (Yu, Bauza, Fazeli, Rodriguez, IROS 2016). The numbers are our own.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.cells import cell_error
from push_ident.geometry.outline import cells_in_outline, polygon_area, polygon_centroid, signed_distance
from push_ident.geometry.se2 import rotation
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, BodyParameters, Motion, simulate_body
from push_ident.pushing.push import PushSettings
from push_ident.pushing.sampling import sample_push
from push_ident.types import CellGrid, ObjectShape, PoseTrack, PusherPath, PushRecord
from push_ident_sim.engines.planar import LoadedBody

__all__ = ["KINDS", "SHAPES", "Plate", "SimulatedPush", "feet_errors", "make_plate", "make_push", "simulate_known_supports"]

FloatArray = NDArray[np.float64]

KINDS = ("tripod", "base")
"""On three feet; on the whole base."""
SHAPES = ("triangle", "rectangle", "angle", "hexagon", "ellipse", "disc")
_N_CELLS = 100
"""Into which identification divides a plate, about."""
_FINER = 1.5
"""Edge of an identified cell over that of a cell that bears load [-]."""
_LEAST_SHARE = 0.1
"""Of the weight on a foot."""
_FOOT_INSIDE = 0.008
"""Least distance of a foot from the outline [m]."""
_UNEVEN = (0.0, 0.3, 0.7)
"""Standard deviations of the logarithm of the pressure of whole bases, before it is balanced."""
_CLEARANCE = 0.008
"""Travel of the pusher before contact [m]."""
_LEAST_MOTION = 0.004
"""A push that moves the cells by less than this on average is drawn again [m]."""
_ARM = 0.05
"""Deviation of the position over that of the yaw [m/rad]: two points of the plate at this distance from its middle."""
_EXACT = np.full(3, 1e-9)
"""Standard deviations that true poses state, which may not be zero [m, m, rad]."""


@dataclass(frozen=True, slots=True)
class Plate:
    """A plate of even thickness, how it is pushed, and how well it is observed."""

    kind: str
    """One of `KINDS`."""
    seed: int
    """Of the plate and its pushes."""
    shape: ObjectShape
    """As identification knows it."""
    form: str
    """One of `SHAPES`."""
    body: LoadedBody
    """As the engine pushes it."""
    pusher_radius: float
    """[m]"""
    speed_range: tuple[float, float]
    """Of the pusher [m/s]."""
    pose_std: FloatArray
    """Standard deviations of an observed pose (x, y, yaw) [m, m, rad], shape (3,)."""


@dataclass(frozen=True, slots=True)
class SimulatedPush:
    """A push of which the poses before and after it are observed."""

    record: PushRecord
    """With the noise of the plate's poses."""
    exact: PushRecord
    """With the true poses."""


def make_plate(kind: str, seed: int) -> Plate:
    """One plate; `kind` is one of `KINDS`, and each seed >= 0 is another shape, mass, friction, support and pusher."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 31])
    form = str(rng.choice(SHAPES))
    outline = _outline(form, rng)
    size = float(np.sqrt(polygon_area(outline) / _N_CELLS))
    mass = float(np.exp(rng.uniform(np.log(0.1), np.log(2.0))))
    place, share = _feet(outline, rng) if kind == "tripod" else _base(outline, size / _FINER, rng)
    body = LoadedBody(
        outline=outline,
        place=place,
        share=share,
        mass=mass,
        inertia=mass * _polar_moment(outline),
        friction=float(rng.uniform(0.15, 0.45)),
        pusher_friction=float(rng.uniform(0.15, 0.45)),
    )
    thin, fast, position_std = rng.random() < 0.5, rng.random() < 0.25, rng.uniform(3e-4, 1e-3)
    return Plate(
        kind=kind,
        seed=seed,
        shape=ObjectShape(cells_in_outline(outline, size), outline),
        form=form,
        body=body,
        pusher_radius=0.002 if thin else 0.00475,
        speed_range=(0.05, 0.05) if fast else (0.01, 0.03),
        pose_std=position_std * np.array([1.0, 1.0, 1.0 / _ARM]),
    )


def _outline(form: str, rng: np.random.Generator) -> FloatArray:
    """Outline about its centroid [m], shape (n_vertices, 2), counter-clockwise."""
    long = rng.uniform(0.09, 0.16)
    if form == "triangle":
        a, b = rng.uniform(0.10, 0.15, 2)
        corners = np.array([[0, 0], [a, 0], [0, b]])
    elif form == "rectangle":
        short = long * rng.uniform(0.5, 1.0)
        corners = np.array([[0, 0], [long, 0], [long, short], [0, short]])
    elif form == "angle":
        arm = long * rng.uniform(0.4, 0.6)
        corners = np.array([[0, 0], [long, 0], [long, arm], [arm, arm], [arm, long], [0, long]])
    else:
        n, ratio = (6, 1.0) if form == "hexagon" else (32, 1.0 if form == "disc" else rng.uniform(0.6, 0.9))
        angle = 2 * np.pi * np.arange(n) / n
        corners = 0.5 * long * np.column_stack([np.cos(angle), ratio * np.sin(angle)])
    return np.asarray(corners - polygon_centroid(corners), dtype=np.float64)


def _polar_moment(outline: FloatArray) -> float:
    """Mean of the squared distance from the origin over the area of a polygon [m^2]."""
    following = np.roll(outline, -1, axis=0)
    cross = outline[:, 0] * following[:, 1] - following[:, 0] * outline[:, 1]
    squares = np.sum(outline**2 + outline * following + following**2, axis=1)
    return float(np.sum(cross * squares) / 6.0 / np.sum(cross))


def _feet(outline: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Places of three feet [m], shape (3, 2), and the shares of the weight that statics gives them, shape (3,)."""
    while True:
        place = rng.uniform(outline.min(axis=0), outline.max(axis=0), (3, 2))
        system = np.vstack([place.T, np.ones(3)])
        if np.max(signed_distance(place, outline)) > -_FOOT_INSIDE or abs(np.linalg.det(system)) < 1e-6:
            continue
        share = np.linalg.solve(system, np.array([0.0, 0.0, 1.0])).astype(np.float64)
        if share.min() > _LEAST_SHARE:
            return place, share


def _base(outline: FloatArray, size: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Centres of small cells [m], shape (n, 2), and a smooth pressure whose moments about the centre of mass vanish, shape (n,)."""
    # The grid is turned, so that its cells do not lie on those of identification.
    turn = rotation(rng.uniform(0.1, np.pi / 2 - 0.1))
    place = cells_in_outline(outline @ turn.T, size).centres @ turn
    length = rng.uniform(0.15, 0.5) * np.linalg.norm(np.ptp(outline, axis=0))
    distance = np.linalg.norm(place[:, None] - place, axis=2) / length
    field = rng.multivariate_normal(np.zeros(len(place)), np.exp(-0.5 * distance**2), method="eigh")
    log_pressure = field * rng.choice(_UNEVEN)
    # Of all pressures with this balance, the nearest one (least relative entropy) has another exponential slope.
    slope = np.zeros(2)
    for _ in range(50):
        share = np.exp(log_pressure + place @ slope)
        share /= share.sum()
        mean = share @ place
        if np.linalg.norm(mean) < 1e-9:
            break
        slope -= np.linalg.solve((place - mean).T @ ((place - mean) * share[:, None]), mean)
    return place, share


def make_push(plate: Plate, number: int) -> SimulatedPush:
    """Push `number` of a plate that is placed anew; it does not depend on other pushes."""
    rng = np.random.default_rng([plate.seed, KINDS.index(plate.kind), 32, number])
    settings = PushSettings(
        workspace=(-1.0, 1.0, -1.0, 1.0),
        pusher_radius=plate.pusher_radius,
        clearance=_CLEARANCE,
        distance_range=(0.016, 0.030),
        speed_range=plate.speed_range,
        cone=float(np.radians(40.0)),
    )
    while True:
        start = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-np.pi, np.pi)])
        plan = sample_push(plate.shape, start, rng, settings)
        travel = _CLEARANCE + plan.distance
        time = np.cumsum([0.0, 0.2, travel / plan.speed, 0.4])
        path = PusherPath(time, plan.tool_start(_CLEARANCE) + np.outer([0.0, 0.0, travel, travel], plan.heading), plate.pusher_radius)
        end = plate.body.push(start, path).pose[-1]
        if cell_error(plate.shape.cells, start, end) >= _LEAST_MOTION:
            break
    true = np.array([start, end])
    return SimulatedPush(
        record=_observed(plate, number, path, true + plate.pose_std * rng.normal(size=(2, 3)), plate.pose_std),
        exact=_observed(plate, number, path, true, _EXACT),
    )


def _observed(plate: Plate, number: int, path: PusherPath, pose: FloatArray, std: FloatArray) -> PushRecord:
    """Record with two poses, shape (2, 3), and their standard deviations, shape (3,)."""
    poses = PoseTrack(path.time[[0, -1]], pose, np.broadcast_to(np.diag(std**2), (2, 3, 3)))
    return PushRecord("plate", plate.shape, poses, path, source=f"push {number + 1}")


def simulate_known_supports(plate: Plate, scenario: PushScenario) -> Motion:
    """The push in the engine of identification, with the true supports, loads and frictions."""
    body, size = plate.body, plate.shape.cells.size / _FINER
    standing = ObjectShape(CellGrid(body.place, size), body.outline)
    limit = body.friction * body.mass * GRAVITY * body.share
    return simulate_body(standing, BodyParameters(body.mass, np.zeros(2), body.inertia, limit), body.pusher_friction, scenario)


def feet_errors(place: FloatArray, share: FloatArray, plate: Plate) -> tuple[float, float]:
    """Mean distance of three named feet from the true ones [m], and mean error of their shares [-], each foot with its nearest one.

    Args:
        place: of the feet [m], shape (3, 2), object frame.
        share: of the weight on each of them [-], shape (3,).
        plate: a tripod.
    """
    orders = [list(order) for order in permutations(range(len(place)))]
    distances = [float(np.mean(np.linalg.norm(place[order] - plate.body.place, axis=1))) for order in orders]
    best = orders[int(np.argmin(distances))]
    return min(distances), float(np.mean(np.abs(share[best] - plate.body.share)))
