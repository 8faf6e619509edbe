"""One object in Bullet whose cells each rest on their own weight, and the engine and table that it needs.

With fixed links of one body the contacts do not determine how the cells share its load; it would change from step to step. So the
object is a chain: two sliding joints and a turning one carry a frame that moves in the plane, and below that frame every cell
hangs on a vertical sliding joint of its own. Cells touch only the table; the pusher touches only the outline, which is a
body of its own in that frame, so that it never catches on the edge between two cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
import pybullet as bullet
from numpy.typing import ArrayLike
from pybullet_utils.bullet_client import BulletClient  # type: ignore[import-untyped]

from push_ident.types import Float64Array
from push_ident_sim.engines.bullet.support import SupportEffects, cone_friction_correction
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.injected.shared import friction_of_pusher, outline_growth, restitution
from push_ident_sim.objects import SimObject, outline_rectangles

TABLE = (-0.8, 0.8, -0.7, 0.7)
"""x_min, x_max, y_min, y_max of the table [m]."""
TABLE_GROUP, CELL_GROUP, OUTLINE_GROUP, PUSHER_GROUP, ARM_GROUP = (1 << bit for bit in range(8, 13))


class Link(IntEnum):
    """Links of the chain; the first three joints are those of the plane (x, y, yaw)."""

    FRAME = 2
    """Moves in the plane; outline and cells hang below it."""
    OUTLINE = 3
    """A force little larger than its weight holds it up, for friction along z, which cannot push, to take no share of the cone."""
    FIRST_CELL = 4


_FRAME_MASS = 1e-4
"""Of each link that is no cell [kg]: small against any cell."""
_CORNER_RADIUS = 1e-4
_NONE = InjectedEffects()
_FOOT_RADIUS = 0.004
"""A cell rests on one point below its centre [m]: on a flat base its four corners share the load in a way that turns a sliding disc."""


def connect(time_step: float, gravity: float, effects: InjectedEffects = _NONE) -> BulletClient:
    """A new engine of its own, with the settings that Coulomb friction needs; `disconnect()` frees it."""
    client = BulletClient(connection_mode=bullet.DIRECT)
    along = np.sin(effects["table_tilt"])
    client.setGravity(*(gravity * along).tolist(), -_normal_gravity(gravity, effects))
    client.setPhysicsEngineParameter(
        fixedTimeStep=time_step,
        numSolverIterations=50,
        # With the default pyramid, friction is stronger along some directions of the table than along others.
        enableConeFriction=1,
        # Contacts at rest would otherwise bounce at very low speed.
        restitutionVelocityThreshold=0.0,
        # Bullet keeps a contact with its old normal until it has moved by this [m]. At the default of 0.02 the normal of a face that has
        # turned by 10 degrees stays beside the new one, and the pusher sticks where it should slide.
        contactBreakingThreshold=2e-3,
        deterministicOverlappingPairs=1,
    )
    return client


def _normal_gravity(gravity: float, effects: InjectedEffects) -> float:
    """Component along the table's normal."""
    along = np.sin(effects["table_tilt"])
    return float(gravity * np.sqrt(1.0 - along @ along))


def add_table(client: BulletClient, bounds: Sequence[float] = TABLE) -> int:
    """Put a table with its top at z = 0, from x_min to x_max and from y_min to y_max [m]; returns its body."""
    x_min, x_max, y_min, y_max = bounds
    half = 0.5 * np.array([x_max - x_min, y_max - y_min, 0.04])
    shape = client.createCollisionShape(bullet.GEOM_BOX, halfExtents=half.tolist())
    table: int = client.createMultiBody(0.0, shape, basePosition=[0.5 * (x_min + x_max), 0.5 * (y_min + y_max), -half[2]])
    # Bullet multiplies the coefficients of the two bodies: the table and the pusher have 1, the object's side the coefficient itself.
    client.changeDynamics(table, -1, lateralFriction=1.0, restitution=0.0)
    client.setCollisionFilterGroupMask(table, -1, TABLE_GROUP, CELL_GROUP | ARM_GROUP)
    return table


def outline_shape(client: BulletClient, sim_object: SimObject, growth: float) -> int:
    """Collision shape of the outline of `sim_object`, moved outwards by `growth` [m]: one box per rectangle and one post per convex corner.

    Bullet rounds the edges of a box by its collision margin of 1 mm, which would displace a pusher at a corner by up to 0.4 mm.
    """
    height = float(sim_object.height.max())
    rectangles = outline_rectangles(sim_object.cells, sim_object.cell_size)
    before, after = (
        sim_object.outline - np.roll(sim_object.outline, 1, axis=0),
        np.roll(sim_object.outline, -1, axis=0) - sim_object.outline,
    )
    outward = before / np.linalg.norm(before, axis=1)[:, None] - after / np.linalg.norm(after, axis=1)[:, None]
    convex = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] > 0
    posts = (sim_object.outline + (growth - _CORNER_RADIUS) * outward)[convex]
    centres = [*(centre for centre, _ in rectangles), *posts]
    shape: int = client.createCollisionShapeArray(
        shapeTypes=[bullet.GEOM_BOX] * len(rectangles) + [bullet.GEOM_CAPSULE] * len(posts),
        halfExtents=[[edges[0] / 2 + growth, edges[1] / 2 + growth, height / 2] for _, edges in rectangles]
        + [[0.0, 0.0, 0.0]] * len(posts),
        radii=[0.0] * len(rectangles) + [_CORNER_RADIUS] * len(posts),
        lengths=[0.0] * len(rectangles) + [height] * len(posts),
        collisionFramePositions=[[float(x), float(y), height / 2] for x, y in centres],
    )
    return shape


class BulletBody:
    """What the two kinds of an object have in common; all poses in the `table` frame."""

    body: int
    """The engine's number of it."""
    outline_link: int
    """Link that the pusher touches."""
    first_cell: int
    """Link of the first cell."""
    has_fallen = False
    """Whether it tips over an edge, or lies below the table."""

    def __init__(self, client: BulletClient, sim_object: SimObject) -> None:
        self._client, self._sim_object = client, sim_object

    def cell_loads(self, table: int) -> Float64Array:
        """Normal force of the table on each cell in the last step [N], shape (n_cells,)."""
        loads = np.zeros(len(self._sim_object))
        for contact in self._client.getContactPoints(self.body, table):
            loads[contact[3] - self.first_cell] += contact[9]
        return loads

    def force_of(self, pusher: int, link: int) -> Float64Array:
        """Force on the outline of one link of the body `pusher` in the last step [N], shape (3,)."""
        force = np.zeros(3)
        for contact in self._client.getContactPoints(self.body, pusher, self.outline_link, link):
            force += contact[9] * np.array(contact[7]) + contact[10] * np.array(contact[11]) + contact[12] * np.array(contact[13])
        return force

    def touches(self, pusher: int, link: int) -> bool:
        """Whether the outline overlaps a link of the body `pusher`."""
        return bool(self._client.getClosestPoints(pusher, self.body, 0.0, link, self.outline_link))


class BulletObject(BulletBody):
    """A `SimObject` standing on the table of one engine."""

    outline_link, first_cell = Link.OUTLINE, Link.FIRST_CELL

    def __init__(self, client: BulletClient, sim_object: SimObject, gravity: float, effects: InjectedEffects = _NONE) -> None:
        """Put the object at (0, 0, 0), at rest. `gravity` [m/s^2], `client` from `connect` with the same gravity and effects."""
        super().__init__(client, sim_object)
        gravity = _normal_gravity(gravity, effects)
        self._limit = sim_object.friction * sim_object.mass * gravity
        self._support = SupportEffects(sim_object, effects, gravity) if SupportEffects.needed(effects) else None
        self._friction, self._mass = sim_object.friction, sim_object.mass
        n_cells = len(sim_object)
        outline = outline_shape(client, sim_object, outline_growth(effects))
        foot = client.createCollisionShape(bullet.GEOM_SPHERE, radius=_FOOT_RADIUS)
        n_links = Link.FIRST_CELL + n_cells
        self.body = client.createMultiBody(
            baseMass=0.0,
            linkMasses=[_FRAME_MASS] * Link.FIRST_CELL + sim_object.mass.tolist(),
            linkCollisionShapeIndices=[-1, -1, -1, outline] + [foot] * n_cells,
            linkVisualShapeIndices=[-1] * n_links,
            linkPositions=[[0.0, 0.0, 0.0]] * Link.FIRST_CELL + [[x, y, _FOOT_RADIUS] for x, y in sim_object.cells.tolist()],
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * n_links,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * n_links,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * n_links,
            linkParentIndices=[0, 1, 2] + [Link.FRAME + 1] * (1 + n_cells),
            linkJointTypes=[bullet.JOINT_PRISMATIC, bullet.JOINT_PRISMATIC, bullet.JOINT_REVOLUTE]
            + [bullet.JOINT_PRISMATIC] * (1 + n_cells),
            linkJointAxis=[[1, 0, 0], [0, 1, 0], [0, 0, 1]] + [[0, 0, 1]] * (1 + n_cells),
        )
        client.setJointMotorControlArray(self.body, range(n_links), bullet.VELOCITY_CONTROL, forces=[0.0] * n_links)
        for link in range(n_links):
            client.changeDynamics(self.body, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, restitution=0.0)
            client.setCollisionFilterGroupMask(self.body, link, CELL_GROUP, TABLE_GROUP)
        for link in range(Link.FIRST_CELL):
            client.changeDynamics(self.body, link, localInertiaDiagonal=[1e-8] * 3)
        for link, (mass, friction) in enumerate(
            zip(sim_object.mass.tolist(), sim_object.friction.tolist(), strict=True), start=Link.FIRST_CELL
        ):
            client.changeDynamics(
                self.body, link, lateralFriction=friction, localInertiaDiagonal=[mass * sim_object.cell_size**2 / 6.0] * 3
            )
        pusher_friction = friction_of_pusher(effects, sim_object.pusher_friction)
        client.changeDynamics(self.body, Link.OUTLINE, lateralFriction=pusher_friction, restitution=restitution(effects))
        client.setJointMotorControl2(
            self.body, Link.OUTLINE, bullet.POSITION_CONTROL, targetPosition=0.0, force=2.0 * _FRAME_MASS * gravity
        )
        client.setCollisionFilterGroupMask(self.body, Link.OUTLINE, OUTLINE_GROUP, PUSHER_GROUP)

    def pose(self) -> Float64Array:
        """True (x, y, yaw) [m, m, rad] of the object frame, shape (3,); yaw is not wrapped."""
        return np.array([s[0] for s in self._client.getJointStates(self.body, range(Link.OUTLINE))])

    transform = pose

    def velocity(self) -> Float64Array:
        """True (vx, vy, yaw rate) [m/s, m/s, rad/s], shape (3,)."""
        return np.array([s[1] for s in self._client.getJointStates(self.body, range(Link.OUTLINE))])

    def place(self, pose: Float64Array, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put the object at `pose` (x, y, yaw) with `velocity` (vx, vy, yaw rate), even where something is in its place."""
        for joint, speed in enumerate(np.asarray(velocity, dtype=np.float64)):
            self._client.resetJointState(self.body, joint, pose[joint], speed)

    def start_push(self) -> None:
        """Reset what effects remember of a push; the object stays where it is."""
        if self._support is not None:
            self._support.start(self.pose())

    def set_pushes_done(self, n_pushes: int) -> None:
        """Set the number of finished pushes; some effects grow with it."""
        if self._support is not None:
            self._support.n_pushes = n_pushes

    def prepare_step(self, push_force: Float64Array, time_step: float) -> None:
        """Apply, for the next time step, the correction of Bullet's cone friction to Coulomb's law, and the effects on table and object.

        `push_force` is that of the pusher on the object in the last step [N], shape (2,); `time_step` [s].
        """
        states = self._client.getJointStates(self.body, range(Link.OUTLINE))
        velocity = np.array([state[1] for state in states])
        if self._support is None:
            cosine, sine = np.cos(states[2][0]), np.sin(states[2][0])
            wrench = cone_friction_correction(
                self._sim_object.cells @ np.array([[cosine, sine], [-sine, cosine]]),
                self._sim_object.mass,
                self._sim_object.cell_size,
                self._limit,
                velocity,
            )
        else:
            action = self._support.advance(np.array([state[0] for state in states]), velocity, push_force, time_step)
            wrench = action.wrench
            self._set_cells(action.friction, action.mass)
            cells = range(Link.FIRST_CELL, Link.FIRST_CELL + len(self._sim_object))
            self._client.setJointMotorControlArray(self.body, cells, bullet.TORQUE_CONTROL, forces=(-action.load).tolist())
        self._client.setJointMotorControlArray(self.body, range(Link.OUTLINE), bullet.TORQUE_CONTROL, forces=wrench.tolist())

    def _set_cells(self, friction: Float64Array, mass: Float64Array) -> None:
        if not np.array_equal(mass, self._mass):
            self._mass = mass
            for link, value in enumerate(mass.tolist(), start=Link.FIRST_CELL):
                inertia = [value * self._sim_object.cell_size**2 / 6.0] * 3
                self._client.changeDynamics(self.body, link, mass=value, localInertiaDiagonal=inertia)
        if not np.array_equal(friction, self._friction):
            self._friction = friction
            for link, value in enumerate(friction.tolist(), start=Link.FIRST_CELL):
                self._client.changeDynamics(self.body, link, lateralFriction=value)
