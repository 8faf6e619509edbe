"""Random objects, pushers and pushes for the proofs of the physics, and the kinds of contact in their steps.

The proofs try a few dozen fixed cases. To try more (those of hypothesis: other ones each time) and to print the largest errors:
`PUSH_IDENT_EXAMPLES=1000 pytest test/push_ident/physics/test_proof_*.py -rP --hypothesis-show-statistics`.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import outline_of_cells, signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.physics.contact import Field, find_contacts, max_candidates
from push_ident.physics.modes import MAX_CONTACTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import BodyParameters, Motion, SimulationSettings, body_of_cells, simulate_body
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath

DT = 1 / 256
"""Length of a step [s]: a binary fraction, so that sampling times fall on the steps exactly."""
ENGINES = {
    "circle": SimulationSettings(step=DT),
    "pyramid": SimulationSettings(step=DT, friction_cone="pyramid"),
    "quasi-static": SimulationSettings(step=DT, quasi_static=True),
}
CLASSES = ("sticking", "sliding", "separating", "turning")
_REACH = 2e-3  # of the engines: features nearer than this take part in a step [m]
_REST_SPEED = 1e-7  # of the compiled engine [m/s]


_MORE = int(os.environ.get("PUSH_IDENT_EXAMPLES", "0"))


def fixed_seeds(n: int) -> range:
    """`n` seeds, or as many as PUSH_IDENT_EXAMPLES asks for."""
    return range(max(n, _MORE))


def examples(n: int) -> settings:
    """`n` fixed cases, or as many new ones as PUSH_IDENT_EXAMPLES asks for."""
    return settings(
        max_examples=max(n, _MORE),
        derandomize=_MORE == 0,
        deadline=None,
        database=None,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )


@dataclass(frozen=True)
class Case:
    """An object at rest and a pusher that all but touches it."""

    model: ObjectModel
    pusher: PusherPath
    """One sample a step."""
    pose: Float64Array
    """Of the object in the table frame, shape (3,)."""

    @property
    def body(self) -> BodyParameters:
        return body_of_cells(self.model.shape, self.model.mass, self.model.friction)

    def simulate(self, how: SimulationSettings, *, jacobian: bool = False) -> Motion:
        """Poses at the start and at the end of every step."""
        return simulate_body(
            self.model.shape,
            self.body,
            self.model.pusher_friction,
            PushScenario(self.pusher, self.pose, self.pusher.time),
            settings=how,
            jacobian=jacobian,
        )


def random_shape(rng: np.random.Generator, n_cells: int, size: float = 0.011) -> ObjectShape:
    """Cells that grew one by one, each beside another, with the exact outline of their union (holes are left out)."""
    taken = {(0, 0)}
    rim = [(1, 0), (-1, 0), (0, 1), (0, -1)]
    while len(taken) < n_cells:
        cell = rim.pop(int(rng.integers(len(rim))))
        if cell not in taken:
            taken.add(cell)
            rim += [(cell[0] + a, cell[1] + b) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)) if (cell[0] + a, cell[1] + b) not in taken]
    centres = size * np.array(sorted(taken), dtype=np.float64)
    centres -= centres.mean(axis=0)
    return ObjectShape(CellGrid(centres, size), outline_of_cells(centres, size))


def random_model(rng: np.random.Generator, shape: ObjectShape) -> ObjectModel:
    """Masses that differ a few times over; in half of the objects a third of the cells has no friction."""
    n_cells = len(shape.cells)
    mass = np.exp(0.6 * rng.normal(size=n_cells))
    friction = rng.uniform(0.1, 0.6, n_cells)
    if rng.uniform() < 0.5:
        friction[rng.permutation(n_cells)[: n_cells // 3]] = 0.0
    pusher_friction = 0.0 if rng.uniform() < 0.1 else rng.uniform(0.0, 1.5)
    return ObjectModel(shape, 0.6 * mass / mass.sum(), friction, pusher_friction)


def clearance(outline_in_table: Float64Array, corners_in_table: Float64Array, radius: float) -> float:
    """Distance between the outline and the pusher with these corners of its core [m]; negative where they overlap."""
    gap = signed_distance(corners_in_table, outline_in_table).min()
    if len(corners_in_table) > 2:
        gap = min(gap, signed_distance(outline_in_table, corners_in_table).min())
    return float(gap - radius)


def corners_at(pusher: PusherPath, i: int) -> Float64Array:
    """Corners of the pusher's core at sample i, shape (n_corners, 2), table frame."""
    yaw = 0.0 if pusher.yaw is None else pusher.yaw[i]
    return transform_points(np.array([*pusher.position[i], yaw]), pusher.shape.core)


def clearances(case: Case, poses: Float64Array) -> Float64Array:
    """Clearance at each sample of the pusher [m], shape (n_samples,)."""
    outline = case.model.shape.outline
    return np.array(
        [clearance(transform_points(pose, outline), corners_at(case.pusher, i), case.pusher.radius) for i, pose in enumerate(poses)]
    )


def random_case(seed: int, n_cells: int, polygon: bool, n_steps: int, *, shape: ObjectShape | None = None) -> Case:
    """A pusher that goes at a random cell of a random object (or of one of this shape), swerves, and at last brakes or backs off.

    A polygon has three to six corners, sharp or rounded, and turns at up to 3 rad/s.
    """
    rng = np.random.default_rng((seed, n_cells, polygon))
    model = random_model(rng, random_shape(rng, n_cells) if shape is None else shape)
    pose = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(-np.pi, np.pi)])
    core, yaw, radius = np.zeros((1, 2)), None, rng.uniform(0.003, 0.02)
    if polygon:
        angle = 2 * np.pi * (np.arange(n := int(rng.integers(3, 7))) + rng.uniform(-0.3, 0.3, n)) / n
        core = rng.uniform(0.006, 0.02) * np.column_stack([np.cos(angle), np.sin(angle)])
        yaw = rng.uniform(-np.pi, np.pi) + rng.uniform(-3.0, 3.0) * DT * np.arange(n_steps + 1)
        radius = rng.choice([0.0, 0.003])

    # From afar towards the cell, each time by the clearance, which never leads into the object.
    heading = rng.uniform(-np.pi, np.pi)
    along = np.array([np.cos(heading), np.sin(heading)])
    start = transform_points(pose, model.shape.cells.centres[rng.integers(n_cells), None])[0] - 0.3 * along
    outline = transform_points(pose, model.shape.outline)
    for _ in range(300):
        at = transform_points(np.array([*start, 0.0 if yaw is None else yaw[0]]), core)
        gap = clearance(outline, at, radius)
        if gap < 1e-5:
            break
        start = start + gap * along

    first, second = sorted(rng.integers(1, n_steps, 2)) if n_steps > 1 else (1, 1)
    speed = rng.uniform(0.05, 0.3)
    angle = np.full(n_steps, heading + rng.uniform(-0.6, 0.6))
    pace = np.full(n_steps, speed)
    angle[first:] += rng.uniform(-1.0, 1.0)
    pace[first:] *= rng.uniform(0.3, 1.5)
    pace[second:] *= rng.uniform(-0.5, 1.0)
    travelled = DT * np.cumsum(pace[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)
    position = start + np.vstack([np.zeros(2), travelled])
    pusher = PusherPath(DT * np.arange(n_steps + 1), position, radius, core if polygon else None, yaw)
    return Case(model, pusher, pose)


def line_tool_case(seed: int, tool: str, n_steps: int, *, on_corner: bool = False, speed: float = 0.1) -> Case:
    """A plate or two fingers on a face of a random rectangle, or fingers on the two faces beside a corner of it, that move and turn.

    Args:
        tool: "plate" or "fingers".
        on_corner: each finger touches another face.
        speed: of the tool [m/s].
    """
    rng = np.random.default_rng((seed, n_steps, on_corner))
    half = rng.uniform([0.03, 0.02], [0.05, 0.04])
    outline = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    model = random_model(rng, ObjectShape(cells_in_outline(outline, float(np.sqrt(4.0 * half.prod() / 20))), outline))
    model = replace(model, pusher_friction=rng.uniform(0.05, 0.6))
    radius, apart = rng.uniform(0.002, 0.005), rng.uniform(0.01, 0.03)
    ends = np.array([[0.0, 0.5 * apart], [0.0, -0.5 * apart]])
    gap = 1e-6
    # Tool frame in the object frame; its x axis points at the object. Of a corner at (-a, -b): both faces are `radius` away.
    if on_corner:
        turn = np.pi / 4 + rng.uniform(-0.3, 0.3)
        across = apart * np.array([-np.sin(turn), np.cos(turn)])
        upper = np.array([-half[0] - radius - gap, -half[1] - radius - gap + across[1]])
        origin = upper - 0.5 * across
    else:
        turn = 0.0
        origin = np.array([-half[0] - radius - gap, rng.uniform(-0.5, 0.5) * (half[1] - 0.5 * apart)])
    pose = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(-np.pi, np.pi)])
    place, heading = transform_points(pose, origin[None])[0], pose[2] + turn
    angle = heading + rng.uniform(-0.9, 0.9)
    travelled = speed * DT * np.arange(n_steps + 1)[:, None] * np.array([np.cos(angle), np.sin(angle)])
    yaw = heading + rng.uniform(-1.0, 1.0) * speed / 0.05 * DT * np.arange(n_steps + 1)
    shape = {"polygon": ends} if tool == "plate" else {"fingers": ends}
    return Case(model, PusherPath(DT * np.arange(n_steps + 1), place + travelled, radius, yaw=yaw, **shape), pose)


def cases(n_steps: int) -> st.SearchStrategy[Case]:
    return st.builds(random_case, st.integers(0, 2**31), st.integers(9, 120), st.booleans(), st.just(n_steps))


@dataclass(frozen=True)
class Step:
    """One step of a simulated push, table axes."""

    old: Float64Array
    """Velocity of the centre of mass and rate of turn before it, shape (3,)."""
    twist: Float64Array
    """After it."""
    centre: Float64Array
    """Of mass, before it, shape (2,)."""
    arms: Float64Array
    """From the centre of mass to the cells, before it, shape (n_cells, 2)."""
    force: Float64Array
    """Of the pusher on the object, shape (2,)."""
    contacts: Float64Array
    """As `find_contacts` gives them, object frame, shape (n_contacts, Field.WIDTH)."""
    normal: Float64Array
    """Outward normal at the first contact, shape (2,); zeros without one."""
    point: Float64Array
    """First contact, shape (2,)."""
    pusher_velocity: Float64Array
    """Of the pusher's point at the first contact, shape (2,)."""
    kind: str
    """sticking, sliding, separating (near, but no force), cornered (contacts on several faces), away or resting."""
    turning: bool
    """Whether its turning moves it more than its centre travels."""


def steps_of(case: Case, motion: Motion) -> list[Step]:
    """The steps of a push that was reported at every step."""
    body, pusher, shape = case.body, case.pusher, case.model.shape
    reach = np.sqrt(body.inertia / body.mass)
    centres = np.concatenate([transform_points(pose, body.centre[None]) for pose in motion.pose])
    velocity = np.diff(np.column_stack([centres, motion.pose[:, 2]]), axis=0) / DT
    outline = np.array(shape.outline)
    steps: list[Step] = []
    for n, twist in enumerate(velocity):
        old = steps[-1].twist if steps else np.zeros(3)
        # An untouched object as slow as this has come to rest.
        if steps and not steps[-1].force.any() and max(np.hypot(*old[:2]), abs(old[2]) * reach) < _REST_SPEED:
            old = np.zeros(3)
        pose = motion.pose[n]
        going = (pusher.position[n + 1] - pusher.position[n]) / DT
        spin = 0.0 if pusher.yaw is None else float(pusher.yaw[n + 1] - pusher.yaw[n]) / DT
        speed = np.hypot(*going) + abs(spin) * pusher.shape.reach
        tips = transform_points(inverse(pose), corners_at(pusher, n))
        contacts = np.zeros((MAX_CONTACTS, Field.WIDTH))
        found = np.zeros((max_candidates(len(tips), len(outline)), Field.WIDTH))
        separate = pusher.fingers is not None
        count = find_contacts(np.ascontiguousarray(tips), pusher.radius, outline, _REACH + speed * DT, found, contacts, separate)
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[cos, -sin], [sin, cos]])
        normal, point = turn @ contacts[0, 1:3], pose[:2] + turn @ contacts[0, 3:5]
        from_pusher = point - pusher.position[n]
        force = motion.force[n]
        press, drag = -normal @ force, abs(normal[0] * force[1] - normal[1] * force[0])
        if not force.any():
            kind = "resting" if not twist.any() else "separating" if count else "away"
        elif count > 1 and np.any(contacts[1:count, 1:3] @ contacts[0, 1:3] < 1 - 1e-9):
            kind = "cornered"
        else:
            kind = "sliding" if drag >= case.model.pusher_friction * press * (1 - 1e-9) else "sticking"
        steps.append(
            Step(
                old=old,
                twist=twist,
                centre=centres[n],
                arms=(shape.cells.centres - body.centre) @ turn.T,
                force=force,
                contacts=contacts[:count],
                normal=normal,
                point=point,
                pusher_velocity=going + spin * np.array([-from_pusher[1], from_pusher[0]]),
                kind=kind,
                turning=bool(abs(twist[2]) * reach > np.hypot(*twist[:2])),
            )
        )
    return steps


def classes_of(steps: list[Step]) -> Counter[str]:
    """How many steps are of each kind; a step in contact may turn besides."""
    count = Counter(step.kind for step in steps)
    count["turning"] = sum(step.turning and bool(step.force.any()) for step in steps)
    return count


_NUDGES = [(0, 0, 0), (1, 1, 1), (-1, -1, -1), (1, -1, -1), (-1, 1, 1)]


def rounding_decides(case: Case, how: SimulationSettings) -> bool:
    """Whether rounding decides what happens in a push: a change of the first pose by 1e-12 grows ten-thousandfold, or the pusher is wedged
    between two faces and equally near to both, of which the nearer one alone has friction."""
    motions = [replace(case, pose=case.pose + 1e-12 * np.array([a, b, c])).simulate(how) for a, b, c in _NUDGES]
    if not float(np.ptp([motion.pose[-1] for motion in motions], axis=0).max()) < 1e-8:
        return True
    return any(step.kind == "cornered" and step.contacts[1, 0] - step.contacts[0, 0] < 1e-9 for step in steps_of(case, motions[0]))


def moved(case: Case, *, by: Float64Array) -> Case:
    """The same push in a table frame that is moved by `by`."""
    pusher = case.pusher
    yaw = None if pusher.yaw is None else pusher.yaw + by[2]
    if yaw is None and not pusher.shape.is_cylinder:
        yaw = np.full(len(pusher.time), by[2])
    place = transform_points(by, case.pose[None, :2])[0]
    return replace(
        case,
        pusher=replace(pusher, position=transform_points(by, pusher.position), yaw=yaw),
        pose=np.array([*place, case.pose[2] + by[2]]),
    )


def mirrored(case: Case) -> Case:
    """The same in a mirror along the x axis of the table."""
    flip = np.array([1.0, -1.0])
    shape, pusher = case.model.shape, case.pusher
    cells = shape.cells
    mirror = ObjectShape(CellGrid(cells.centres * flip, cells.size, cells.squares * flip, cells.areas), (shape.outline * flip)[::-1])
    return Case(
        replace(case.model, shape=mirror),
        replace(
            pusher,
            position=pusher.position * flip,
            polygon=None if pusher.polygon is None else (pusher.polygon * flip)[::-1],
            fingers=None if pusher.fingers is None else (pusher.fingers * flip)[::-1],
            yaw=None if pusher.yaw is None else -pusher.yaw,
        ),
        case.pose * [1.0, -1.0, -1.0],
    )
