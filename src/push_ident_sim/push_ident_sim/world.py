"""The simulated cell in Bullet: arm, hand, table and one object whose cells each rest on their own weight.

Cells that are fixed links of one body would share its load in a way that contacts leave open, and differently at each step. So the
object is a chain: two sliding joints and a turning one carry a frame that moves in the plane, and below that frame every cell
hangs on a vertical sliding joint of its own. Cells touch the table alone; the pusher touches the outline alone, which is a
body of its own in that frame, so that it never catches on the edge between two cells.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pybullet as bullet
from numpy.typing import ArrayLike, NDArray
from pybullet_utils.bullet_client import BulletClient  # type: ignore[import-untyped]

from push_ident.errors import InputError
from push_ident_sim.friction import cone_friction_correction
from push_ident_sim.objects import SimObject, outline_rectangles
from push_ident_sim.robot import HOME, JOINT_NAMES, robot_description

__all__ = ["CellWorld", "WorldConfig"]

FloatArray = NDArray[np.float64]

_TABLE_GROUP, _CELL_GROUP, _OUTLINE_GROUP, _PUSHER_GROUP, _ARM_GROUP = (1 << bit for bit in range(8, 13))
_N_PLANE_JOINTS = 3
_FRAME_LINK = 2
"""Link that moves in the plane (x, y, yaw); outline and cells hang below it."""
_OUTLINE_LINK = 3
"""Held up by little more than its weight: friction along z, which cannot push the object, then takes no share of the friction cone."""
_FIRST_CELL_LINK = 4
_FRAME_MASS = 1e-4
"""Of each link that is no cell [kg]: small against any cell."""
_CORNER_RADIUS = 1e-4
_FOOT_RADIUS = 0.004
"""A cell stands on one point below its centre [m]: on a flat base its four corners share the load in a way that turns a sliding disc."""


@dataclass(frozen=True, slots=True)
class WorldConfig:
    """Numbers of the simulation that are no property of the object."""

    time_step: float = 1.0 / 240.0
    """[s]"""
    solver_iterations: int = 50
    gravity: float = 9.81
    """[m/s^2]"""
    position_gain: float = 0.3
    """Share of the joint position error that the arm takes back in one time step."""
    joint_effort: float = 300.0
    """[N m], largest motor torque."""


class CellWorld:
    """The cell at one moment; all poses in the `table` frame. Not safe to share between threads."""

    def __init__(self, sim_object: SimObject, config: WorldConfig | None = None, *, pose: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put the object at `pose` (x, y, yaw) [m, m, rad] and the arm at its home."""
        self.object = sim_object
        self.config = config or WorldConfig()
        self.joint_names = JOINT_NAMES
        self._start_pose = _checked_pose(pose)
        self._client = BulletClient(connection_mode=bullet.DIRECT)
        self._client.setGravity(0.0, 0.0, -self.config.gravity)
        self._client.setPhysicsEngineParameter(
            fixedTimeStep=self.config.time_step,
            numSolverIterations=self.config.solver_iterations,
            # With the default pyramid, friction is stronger along some directions of the table than along others.
            enableConeFriction=1,
            # Contacts at rest would otherwise bounce at very low speed.
            restitutionVelocityThreshold=0.0,
            deterministicOverlappingPairs=1,
        )
        self._add_table()
        self._add_robot()
        self._add_object()
        self._n_steps = 0
        self.set_joint_targets(HOME, np.zeros(len(HOME)))
        self._impulse = np.zeros(3)
        self._impulse_steps = 0

    # --- what is in the cell -------------------------------------------------------------------------------------------

    def _add_table(self) -> None:
        half = np.array([0.8, 0.7, 0.02])
        shape = self._client.createCollisionShape(bullet.GEOM_BOX, halfExtents=half.tolist())
        self._table = self._client.createMultiBody(0.0, shape, basePosition=[0.0, 0.0, -half[2]])
        # Bullet multiplies the coefficients of the two bodies: the table and the pusher have 1, the object's side the coefficient itself.
        self._client.changeDynamics(self._table, -1, lateralFriction=1.0, restitution=0.0)
        self._client.setCollisionFilterGroupMask(self._table, -1, _TABLE_GROUP, _CELL_GROUP | _ARM_GROUP | _PUSHER_GROUP)

    def _add_robot(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(robot_description())
            # Without this flag a cylinder becomes a prism, which is no smooth pusher.
            self._robot = self._client.loadURDF(str(path), useFixedBase=True, flags=bullet.URDF_USE_IMPLICIT_CYLINDER)
        infos = [self._client.getJointInfo(self._robot, i) for i in range(self._client.getNumJoints(self._robot))]
        joint_index = {info[1].decode(): info[0] for info in infos}
        link_index = {info[12].decode(): info[0] for info in infos}
        self._arm_joints = [joint_index[name] for name in self.joint_names]
        self.joint_lower = np.array([infos[i][8] for i in self._arm_joints])
        self.joint_upper = np.array([infos[i][9] for i in self._arm_joints])
        self._link_names = list(link_index)
        self._pusher_link = link_index["hand_pusher"]
        self._tip_link = link_index["tool_tip"]
        for index in range(-1, len(infos)):
            self._client.changeDynamics(self._robot, index, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, restitution=0.0)
            self._client.setCollisionFilterGroupMask(self._robot, index, _ARM_GROUP, 0)
        for name, index in link_index.items():
            if name.startswith("hand_") or name in {"lbr_iiwa_link_5", "lbr_iiwa_link_6", "lbr_iiwa_link_7"}:
                self._client.setCollisionFilterGroupMask(self._robot, index, _ARM_GROUP, _TABLE_GROUP)
        self._client.setCollisionFilterGroupMask(self._robot, self._pusher_link, _PUSHER_GROUP, _OUTLINE_GROUP | _TABLE_GROUP)
        self._client.changeDynamics(self._robot, self._pusher_link, lateralFriction=1.0)
        for joint, position in zip(self._arm_joints, HOME, strict=True):
            self._client.resetJointState(self._robot, joint, position)

    def _add_object(self) -> None:
        thing, n_cells = self.object, len(self.object)
        outline = self._outline_shape()
        foot = self._client.createCollisionShape(bullet.GEOM_SPHERE, radius=_FOOT_RADIUS)
        n_links = _FIRST_CELL_LINK + n_cells
        self._body = self._client.createMultiBody(
            baseMass=0.0,
            linkMasses=[_FRAME_MASS] * _FIRST_CELL_LINK + thing.mass.tolist(),
            linkCollisionShapeIndices=[-1, -1, -1, outline] + [foot] * n_cells,
            linkVisualShapeIndices=[-1] * n_links,
            linkPositions=[[0.0, 0.0, 0.0]] * _FIRST_CELL_LINK + [[x, y, _FOOT_RADIUS] for x, y in thing.cells.tolist()],
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * n_links,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * n_links,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * n_links,
            linkParentIndices=[0, 1, 2] + [_FRAME_LINK + 1] * (1 + n_cells),
            linkJointTypes=[bullet.JOINT_PRISMATIC, bullet.JOINT_PRISMATIC, bullet.JOINT_REVOLUTE]
            + [bullet.JOINT_PRISMATIC] * (1 + n_cells),
            linkJointAxis=[[1, 0, 0], [0, 1, 0], [0, 0, 1]] + [[0, 0, 1]] * (1 + n_cells),
        )
        self._client.setJointMotorControlArray(self._body, range(n_links), bullet.VELOCITY_CONTROL, forces=[0.0] * n_links)
        for link in range(n_links):
            self._client.changeDynamics(self._body, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, restitution=0.0)
            self._client.setCollisionFilterGroupMask(self._body, link, _CELL_GROUP, _TABLE_GROUP)
        for link in range(_FIRST_CELL_LINK):
            self._client.changeDynamics(self._body, link, localInertiaDiagonal=[1e-8] * 3)
        for link, (mass, friction) in enumerate(zip(thing.mass.tolist(), thing.friction.tolist(), strict=True), start=_FIRST_CELL_LINK):
            self._client.changeDynamics(
                self._body, link, lateralFriction=friction, localInertiaDiagonal=[mass * thing.cell_size**2 / 6.0] * 3
            )
        self._client.changeDynamics(self._body, _OUTLINE_LINK, lateralFriction=thing.pusher_friction)
        self._client.setJointMotorControl2(
            self._body, _OUTLINE_LINK, bullet.POSITION_CONTROL, targetPosition=0.0, force=2.0 * _FRAME_MASS * self.config.gravity
        )
        self._client.setCollisionFilterGroupMask(self._body, _OUTLINE_LINK, _OUTLINE_GROUP, _PUSHER_GROUP)
        self._friction_limit = thing.friction * thing.mass * self.config.gravity
        self._place_object(self._start_pose, np.zeros(3))

    def _outline_shape(self) -> int:
        """Collision shape of the outline: one box per rectangle and one thin post per convex corner.

        Bullet rounds the edges of a box by its collision margin of 1 mm, which would put a pusher at a corner up to 0.4 mm off.
        """
        thing = self.object
        height = float(thing.height.max())
        rectangles = outline_rectangles(thing.cells, thing.cell_size)
        before, after = thing.outline - np.roll(thing.outline, 1, axis=0), np.roll(thing.outline, -1, axis=0) - thing.outline
        outward = before / np.linalg.norm(before, axis=1)[:, None] - after / np.linalg.norm(after, axis=1)[:, None]
        convex = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] > 0
        posts = (thing.outline - _CORNER_RADIUS * outward)[convex]
        centres = [*(centre for centre, _ in rectangles), *posts]
        shape: int = self._client.createCollisionShapeArray(
            shapeTypes=[bullet.GEOM_BOX] * len(rectangles) + [bullet.GEOM_CAPSULE] * len(posts),
            halfExtents=[[edges[0] / 2, edges[1] / 2, height / 2] for _, edges in rectangles] + [[0.0, 0.0, 0.0]] * len(posts),
            radii=[0.0] * len(rectangles) + [_CORNER_RADIUS] * len(posts),
            lengths=[0.0] * len(rectangles) + [height] * len(posts),
            collisionFramePositions=[[float(x), float(y), height / 2] for x, y in centres],
        )
        return shape

    # --- time ----------------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time since the start [s]."""
        return self._n_steps * self.config.time_step

    def step(self) -> None:
        """Advance by one time step."""
        self._client.setJointMotorControlArray(
            self._body, range(_N_PLANE_JOINTS), bullet.TORQUE_CONTROL, forces=self._friction_correction().tolist()
        )
        self._client.stepSimulation()
        self._n_steps += 1
        self._impulse += self._contact_force() * self.config.time_step
        self._impulse_steps += 1

    def close(self) -> None:
        """Free the engine."""
        self._client.disconnect()

    # --- arm -----------------------------------------------------------------------------------------------------------

    def joint_state(self) -> tuple[FloatArray, FloatArray]:
        """Positions [rad] and velocities [rad/s] of the arm, each shape (7,), in the order of `joint_names`."""
        states = self._client.getJointStates(self._robot, self._arm_joints)
        return np.array([s[0] for s in states]), np.array([s[1] for s in states])

    def set_joint_targets(self, position: ArrayLike, velocity: ArrayLike) -> None:
        """Where the arm should be after the next step [rad] and how fast it should then move [rad/s], each shape (7,)."""
        position, velocity = np.asarray(position, dtype=np.float64), np.asarray(velocity, dtype=np.float64)
        n_joints = len(self.joint_names)
        if position.shape != (n_joints,) or velocity.shape != (n_joints,) or not np.all(np.isfinite([position, velocity])):
            raise InputError(f"Joint targets must be {n_joints} finite positions and velocities, got {position} and {velocity}.")
        # The motor works on the error at the start of the step; the target is for its end.
        self._client.setJointMotorControlArray(
            self._robot,
            self._arm_joints,
            bullet.POSITION_CONTROL,
            targetPositions=(position - velocity * self.config.time_step).tolist(),
            targetVelocities=velocity.tolist(),
            positionGains=[self.config.position_gain] * n_joints,
            velocityGains=[1.0] * n_joints,
            forces=[self.config.joint_effort] * n_joints,
        )

    def tool_tip(self) -> FloatArray:
        """Position of the tool tip [m], shape (3,)."""
        return np.array(self._client.getLinkState(self._robot, self._tip_link, computeForwardKinematics=1)[4])

    def robot_link_poses(self) -> dict[str, FloatArray]:
        """Pose of each robot link's frame, homogeneous (4, 4), by link name."""
        states = self._client.getLinkStates(self._robot, range(len(self._link_names)), computeForwardKinematics=1)
        return {name: self._homogeneous(state[4], state[5]) for name, state in zip(self._link_names, states, strict=True)}

    def _homogeneous(self, position: Sequence[float], quaternion: Sequence[float]) -> FloatArray:
        pose = np.eye(4)
        pose[:3, :3] = np.reshape(self._client.getMatrixFromQuaternion(quaternion), (3, 3))
        pose[:3, 3] = position
        return pose

    # --- object --------------------------------------------------------------------------------------------------------

    def object_pose(self) -> FloatArray:
        """True (x, y, yaw) [m, m, rad] of the object frame, shape (3,); yaw is not wrapped."""
        return np.array([s[0] for s in self._client.getJointStates(self._body, range(_N_PLANE_JOINTS))])

    def object_velocity(self) -> FloatArray:
        """True (vx, vy, yaw rate) [m/s, m/s, rad/s], shape (3,)."""
        return np.array([s[1] for s in self._client.getJointStates(self._body, range(_N_PLANE_JOINTS))])

    def place_object(self, pose: ArrayLike, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put the object at `pose` (x, y, yaw) with `velocity` (vx, vy, yaw rate).

        Raises InputError where the pusher is in the way, and leaves the object where it was.
        """
        before = self.object_pose(), self.object_velocity()
        self._place_object(_checked_pose(pose), np.asarray(velocity, dtype=np.float64))
        if self._client.getClosestPoints(self._robot, self._body, 0.0, self._pusher_link, _OUTLINE_LINK):
            self._place_object(*before)
            raise InputError(f"The pusher stands where the object should go, {np.round(np.asarray(pose), 4)}; lift or move the tool first.")

    def reset_object(self) -> None:
        """Put the object back to its start pose, at rest; raises InputError where the pusher is in the way."""
        self.place_object(self._start_pose)

    def _place_object(self, pose: FloatArray, velocity: FloatArray) -> None:
        for joint in range(_N_PLANE_JOINTS):
            self._client.resetJointState(self._body, joint, pose[joint], velocity[joint])

    def _friction_correction(self) -> FloatArray:
        states = self._client.getJointStates(self._body, range(_N_PLANE_JOINTS))
        cosine, sine = np.cos(states[2][0]), np.sin(states[2][0])
        return cone_friction_correction(
            self.object.cells @ np.array([[cosine, sine], [-sine, cosine]]),
            self.object.mass,
            self.object.cell_size,
            self._friction_limit,
            np.array([state[1] for state in states]),
        )

    # --- forces --------------------------------------------------------------------------------------------------------

    def cell_loads(self) -> FloatArray:
        """Normal force of the table on each cell in the last step [N], shape (n_cells,)."""
        loads = np.zeros(len(self.object))
        for contact in self._client.getContactPoints(self._body, self._table):
            loads[contact[3] - _FIRST_CELL_LINK] += contact[9]
        return loads

    def _contact_force(self) -> FloatArray:
        """Force of the pusher on the object in the last step [N], shape (3,)."""
        force = np.zeros(3)
        for contact in self._client.getContactPoints(self._body, self._robot, _OUTLINE_LINK, self._pusher_link):
            force += contact[9] * np.array(contact[7]) + contact[10] * np.array(contact[11]) + contact[12] * np.array(contact[13])
        return force

    def take_pusher_force(self) -> FloatArray:
        """Force of the pusher on the object [N], shape (3,): mean over the steps since the last call."""
        force = self._impulse / (max(self._impulse_steps, 1) * self.config.time_step)
        self._impulse = np.zeros(3)
        self._impulse_steps = 0
        return force


def _checked_pose(pose: ArrayLike) -> FloatArray:
    pose = np.array(pose, dtype=np.float64)
    if pose.shape != (3,) or not np.all(np.isfinite(pose)):
        raise InputError(f"An object pose is three finite numbers (x, y, yaw), got {pose}.")
    return pose
