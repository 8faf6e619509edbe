"""One object in Bullet that is a single rigid body with six degrees of freedom: it tilts, and falls over an edge.

Its feet are spheres below the cells, each with the friction of its cell. The engine's contacts share the load among them; on an even table
that is one of many shares in equilibrium, not the weight of each cell, which is why experiments on even tables take `BulletObject`.
"""

from __future__ import annotations

import numpy as np
import pybullet as bullet
from numpy.typing import ArrayLike
from pybullet_utils.bullet_client import BulletClient  # type: ignore[import-untyped]

from push_ident.geometry.se2 import rotation
from push_ident.types import Float64Array
from push_ident_sim.engines.bullet.bullet_object import CELL_GROUP, OUTLINE_GROUP, PUSHER_GROUP, TABLE_GROUP, BulletBody, outline_shape
from push_ident_sim.engines.bullet.support import cone_friction_correction
from push_ident_sim.objects import SimObject


class RigidObject(BulletBody):
    """A `SimObject` standing on the table of one engine, as `BulletObject`."""

    outline_link, first_cell = -1, 0

    def __init__(self, client: BulletClient, sim_object: SimObject, table: int) -> None:
        """Put the object at (0, 0, 0), at rest."""
        super().__init__(client, sim_object)
        self._table = table
        total = float(sim_object.mass.sum())
        self._height = float(sim_object.mass @ sim_object.height / total) / 2
        self._centre: Float64Array = sim_object.mass @ sim_object.cells / total
        arms = sim_object.cells - self._centre
        across = sim_object.mass @ (arms**2 + sim_object.cell_size**2 / 12.0)
        upright = float(sim_object.mass @ sim_object.height**2) / 12.0
        radius = 0.002  # of a foot [m]
        foot = client.createCollisionShape(bullet.GEOM_SPHERE, radius=radius)
        n = len(sim_object)
        self.body = client.createMultiBody(
            baseMass=total,
            baseCollisionShapeIndex=outline_shape(client, sim_object, 0.0),
            baseInertialFramePosition=[*self._centre, self._height],
            linkMasses=[1e-6] * n,  # the body has the mass
            linkCollisionShapeIndices=[foot] * n,
            linkVisualShapeIndices=[-1] * n,
            linkPositions=[[x, y, radius] for x, y in sim_object.cells.tolist()],
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * n,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * n,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * n,
            linkParentIndices=[0] * n,
            linkJointTypes=[bullet.JOINT_FIXED] * n,
            linkJointAxis=[[0, 0, 1]] * n,
        )
        inertia = [across[1] + upright, across[0] + upright, across[0] + across[1]]
        client.changeDynamics(
            self.body,
            -1,
            localInertiaDiagonal=inertia,
            lateralFriction=sim_object.pusher_friction,
            restitution=0.0,
            linearDamping=0.0,
            angularDamping=0.0,
        )
        client.setCollisionFilterGroupMask(self.body, -1, OUTLINE_GROUP, PUSHER_GROUP)
        for link, friction in enumerate(sim_object.friction.tolist()):
            client.changeDynamics(self.body, link, lateralFriction=friction, restitution=0.0, localInertiaDiagonal=[1e-12] * 3)
            client.setCollisionFilterGroupMask(self.body, link, CELL_GROUP, TABLE_GROUP)

    def _state(self) -> tuple[Float64Array, Float64Array]:
        position, turn = self._client.getBasePositionAndOrientation(self.body)
        return np.array(position), np.reshape(self._client.getMatrixFromQuaternion(turn), (3, 3))

    def pose(self) -> Float64Array:
        """True (x, y, yaw) of the object frame, shape (3,)."""
        centre, turn = self._state()
        return np.array([*(centre - turn @ [*self._centre, self._height])[:2], np.arctan2(turn[1, 0], turn[0, 0])])

    def velocity(self) -> Float64Array:
        """True (vx, vy, yaw rate) of the object frame, shape (3,)."""
        linear, angular = self._client.getBaseVelocity(self.body)
        arm = -self._state()[1][:2, :2] @ self._centre
        return np.array([linear[0] - angular[2] * arm[1], linear[1] + angular[2] * arm[0], angular[2]])

    def transform(self) -> Float64Array:
        """Of the object frame in the table frame, homogeneous, shape (4, 4)."""
        centre, turn = self._state()
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, centre - turn @ [*self._centre, self._height]
        return pose

    @property
    def has_fallen(self) -> bool:  # type: ignore[override]
        """Whether it tips over an edge, or lies below the table."""
        centre, turn = self._state()
        # While it is held it leans by less than 0.01 rad.
        return float(np.arccos(np.clip(turn[2, 2], -1.0, 1.0))) > 0.1 or float(centre[2]) < 0.0

    def place(self, pose: Float64Array, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put the object at `pose` (x, y, yaw) with `velocity` (vx, vy, yaw rate)."""
        arm = rotation(pose[2]) @ self._centre
        vx, vy, rate = np.asarray(velocity, dtype=np.float64)
        turn = [0.0, 0.0, float(np.sin(pose[2] / 2)), float(np.cos(pose[2] / 2))]
        self._client.resetBasePositionAndOrientation(self.body, [*(pose[:2] + arm).tolist(), self._height], turn)
        self._client.resetBaseVelocity(self.body, [vx - rate * arm[1], vy + rate * arm[0], 0.0], [0.0, 0.0, rate])

    def start_push(self) -> None:
        """Nothing is remembered of a push."""

    def set_pushes_done(self, n_pushes: int) -> None:
        """No effects act here."""

    def prepare_step(self, push_force: Float64Array, time_step: float) -> None:
        """Apply, for the next time step, the correction of Bullet's cone friction to Coulomb's law."""
        sim_object = self._sim_object
        centre, turn = self._state()
        arms = (sim_object.cells - self._centre) @ turn[:2, :2].T
        linear, angular = self._client.getBaseVelocity(self.body)
        limit = sim_object.friction * self.cell_loads(self._table)
        velocity = np.array([linear[0], linear[1], angular[2]])
        wrench = cone_friction_correction(arms, sim_object.mass, sim_object.cell_size, limit, velocity)
        self._client.applyExternalForce(self.body, -1, [wrench[0], wrench[1], 0.0], centre.tolist(), bullet.WORLD_FRAME)
        self._client.applyExternalTorque(self.body, -1, [0.0, 0.0, wrench[2]], bullet.WORLD_FRAME)
