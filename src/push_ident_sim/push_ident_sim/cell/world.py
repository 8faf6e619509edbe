"""The simulated cell in Bullet: arm, hand, table and one object: `bullet_object`, or `rigid_object` where the table ends near it."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pybullet as bullet
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.physics.support import GRAVITY
from push_ident.types import Float64Array
from push_ident_sim.cell.robot import CONTACT_LINK, CellRobot, bullet_description, iiwa_with_hand
from push_ident_sim.engines.bullet.bullet_object import (
    ARM_GROUP,
    OUTLINE_GROUP,
    PUSHER_GROUP,
    TABLE,
    TABLE_GROUP,
    BulletObject,
    add_table,
    connect,
)
from push_ident_sim.engines.bullet.rigid_object import RigidObject
from push_ident_sim.engines.true_motion import checked_pose
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.injected.shared import ToolErrors, bearing_torque, restitution
from push_ident_sim.objects import SimObject


@dataclass(frozen=True, slots=True)
class WorldConfig:
    """Numbers of the simulation that are no property of the object."""

    time_step: float = 1.0 / 240.0
    """[s]"""
    table: tuple[float, float, float, float] = TABLE
    """x_min, x_max, y_min, y_max of the table [m]. With another one than the default, the object is one rigid body that may tilt and fall,
    and no effects can be injected."""
    effects: InjectedEffects = field(default_factory=InjectedEffects)
    """Injected effects; those on the camera act in `camera.py`."""

    def __post_init__(self) -> None:
        if self.is_rigid and self.effects.as_dict():
            raise InputError(
                f"The table is {self.table} m, and {', '.join(self.effects.as_dict())} is injected: an object that may fall has none; "
                f"leave them out, or take the table {TABLE}."
            )

    @property
    def is_rigid(self) -> bool:
        """Whether the object is one rigid body."""
        return tuple(self.table) != TABLE


class CellWorld:
    """The cell at one moment; all poses in the `table` frame. Not safe to share between threads."""

    def __init__(
        self,
        sim_object: SimObject,
        config: WorldConfig | None = None,
        *,
        pose: ArrayLike = (0.0, 0.0, 0.0),
        robot: CellRobot | None = None,
    ) -> None:
        """Put the object at `pose` (x, y, yaw) [m, m, rad] and the arm at its start; `robot`: another arm than the iiwa."""
        self.robot = robot or iiwa_with_hand()
        self.object = sim_object
        self.config = config or WorldConfig()
        self.joint_names = self.robot.joint_names
        self._start_pose = checked_pose(pose)
        effects = self.config.effects
        if "rolling_finger" in effects and not self.robot.tool.is_cylinder:
            raise InputError("rolling_finger is injected, and the tool has two contacts, expected a single disc; leave out the effect.")
        self._client = connect(self.config.time_step, GRAVITY, effects)
        self._table = add_table(self._client, self.config.table)
        self._add_robot()
        self._tool = _DrivenTool(effects, self.config.time_step, self.robot) if ToolErrors.needed(effects) else None
        self._body = self._new_body(sim_object)
        self._body.place(self._start_pose)
        self._body.start_push()
        self._n_steps = 0
        self.set_joint_targets(self.robot.start, np.zeros(len(self.joint_names)))
        self._impulse = np.zeros(3)
        self._impulse_steps = 0
        self._force = np.zeros(3)
        self._n_pushes = 0
        self._last_touch = -np.inf

    # --- what is in the cell -------------------------------------------------------------------------------------------

    def _add_robot(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(bullet_description(self.robot, turning_finger="rolling_finger" in self.config.effects))
            # Without this flag a cylinder becomes a prism, which is no smooth pusher.
            self._robot = self._client.loadURDF(str(path), useFixedBase=True, flags=bullet.URDF_USE_IMPLICIT_CYLINDER)
        infos = [self._client.getJointInfo(self._robot, i) for i in range(self._client.getNumJoints(self._robot))]
        joint_index = {info[1].decode(): info[0] for info in infos}
        link_index = {info[12].decode(): info[0] for info in infos}
        self._arm_joints = [joint_index[name] for name in self.joint_names]
        self.joint_lower = np.array([infos[i][8] for i in self._arm_joints])
        self.joint_upper = np.array([infos[i][9] for i in self._arm_joints])
        self._link_names = list(link_index)
        self._contact_link = link_index[CONTACT_LINK]
        self._tip_link = link_index["tool_tip"]
        for index in range(-1, len(infos)):
            self._client.changeDynamics(self._robot, index, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, restitution=0.0)
            self._client.setCollisionFilterGroupMask(self._robot, index, ARM_GROUP, 0)
        for name in self.robot.low_links:
            self._client.setCollisionFilterGroupMask(self._robot, link_index[name], ARM_GROUP, TABLE_GROUP)
        self._client.setCollisionFilterGroupMask(self._robot, self._contact_link, PUSHER_GROUP, OUTLINE_GROUP)
        bounce = 1.0 if restitution(self.config.effects) > 0.0 else 0.0
        self._client.changeDynamics(self._robot, self._contact_link, lateralFriction=1.0, restitution=bounce)
        if "rolling_finger" in self.config.effects:
            torque = bearing_torque(self.config.effects)
            self._client.setJointMotorControl2(self._robot, self._contact_link, bullet.VELOCITY_CONTROL, targetVelocity=0.0, force=torque)
        for joint, position in zip(self._arm_joints, self.robot.start, strict=True):
            self._client.resetJointState(self._robot, joint, position)

    # --- time ----------------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time since the start [s]."""
        return self._n_steps * self.config.time_step

    def step(self) -> None:
        """Advance by one time step."""
        self._body.prepare_step(self._force[:2], self.config.time_step)
        self._client.stepSimulation()
        self._n_steps += 1
        self._force = self._body.force_of(self._robot, self._contact_link)
        self._impulse += self._force * self.config.time_step
        self._impulse_steps += 1
        self._count_pushes()

    def _count_pushes(self) -> None:
        """Count a push when it is over: when the pusher has not touched the object for half a second."""
        if self._force.any():
            self._last_touch = self.time
        elif np.isfinite(self._last_touch) and self.time - self._last_touch > 0.5:
            self._last_touch = -np.inf
            self._n_pushes += 1
            self._tell_pushes_done()

    def _tell_pushes_done(self) -> None:
        self._body.set_pushes_done(self._n_pushes)
        if self._tool is not None:
            self._tool.set_pushes_done(self._n_pushes)

    def close(self) -> None:
        """Free the engine."""
        self._client.disconnect()

    # --- arm -----------------------------------------------------------------------------------------------------------

    def joint_state(self) -> tuple[Float64Array, Float64Array]:
        """Positions [rad] and velocities [rad/s] that the arm reports, each shape (n_joints,), in the order of `joint_names`."""
        states = self._client.getJointStates(self._robot, self._arm_joints)
        position, velocity = np.array([s[0] for s in states]), np.array([s[1] for s in states])
        return (position, velocity) if self._tool is None else self._tool.reported(position, velocity)

    def set_joint_targets(self, position: ArrayLike, velocity: ArrayLike) -> None:
        """Where the arm should be after the next step [rad] and how fast it should then move [rad/s], each shape (n_joints,)."""
        position, velocity = np.asarray(position, dtype=np.float64), np.asarray(velocity, dtype=np.float64)
        n_joints = len(self.joint_names)
        if position.shape != (n_joints,) or velocity.shape != (n_joints,) or not np.all(np.isfinite([position, velocity])):
            raise InputError(f"Joint targets must be {n_joints} finite positions and velocities, got {position} and {velocity}.")
        if self._tool is not None:
            position, velocity = self._tool.driven(position, velocity)
        # The motor works on the error at the start of the step; the target is for its end.
        self._client.setJointMotorControlArray(
            self._robot,
            self._arm_joints,
            bullet.POSITION_CONTROL,
            targetPositions=(position - velocity * self.config.time_step).tolist(),
            targetVelocities=velocity.tolist(),
            positionGains=[0.3] * n_joints,  # of the error, in one time step
            velocityGains=[1.0] * n_joints,
            forces=[300.0] * n_joints,  # the largest torque [N m],
        )

    def tool_tip(self) -> Float64Array:
        """True position of the tool tip [m], shape (3,)."""
        return np.array(self._client.getLinkState(self._robot, self._tip_link, computeForwardKinematics=1)[4])

    def robot_link_poses(self) -> dict[str, Float64Array]:
        """Pose of each robot link's frame, homogeneous (4, 4), by link name."""
        states = self._client.getLinkStates(self._robot, range(len(self._link_names)), computeForwardKinematics=1)
        return {name: self._homogeneous(state[4], state[5]) for name, state in zip(self._link_names, states, strict=True)}

    def _homogeneous(self, position: Sequence[float], quaternion: Sequence[float]) -> Float64Array:
        pose = np.eye(4)
        pose[:3, :3] = np.reshape(self._client.getMatrixFromQuaternion(quaternion), (3, 3))
        pose[:3, 3] = position
        return pose

    # --- object --------------------------------------------------------------------------------------------------------

    def _new_body(self, sim_object: SimObject) -> BulletObject | RigidObject:
        if self.config.is_rigid:
            return RigidObject(self._client, sim_object, self._table)
        return BulletObject(self._client, sim_object, GRAVITY, self.config.effects)

    @property
    def has_fallen(self) -> bool:
        """Whether the object tips over an edge of the table, or lies below it."""
        return self._body.has_fallen

    def object_transform(self) -> Float64Array:
        """True pose of the object frame, homogeneous, shape (4, 4); of one that cannot tilt, planar, shape (3,)."""
        return self._body.transform()

    def object_pose(self) -> Float64Array:
        """True (x, y, yaw) [m, m, rad] of the object frame, shape (3,); yaw is not wrapped."""
        return self._body.pose()

    def object_velocity(self) -> Float64Array:
        """True (vx, vy, yaw rate) [m/s, m/s, rad/s], shape (3,)."""
        return self._body.velocity()

    def place_object(self, pose: ArrayLike, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put the object at `pose` (x, y, yaw) with `velocity` (vx, vy, yaw rate).

        Raises InputError where the pusher occupies the place, and then does not move the object.
        """
        before = self.object_pose(), self.object_velocity()
        self._body.place(checked_pose(pose), velocity)
        if self._body.touches(self._robot, self._contact_link):
            self._body.place(*before)
            raise InputError(f"The pusher occupies the place of the object, {np.round(np.asarray(pose), 4)}; lift or move the tool first.")
        self._body.start_push()

    def replace_object(self, sim_object: SimObject, pose: ArrayLike) -> None:
        """Replace the object by another one at `pose`, at rest; `pose` becomes its start pose.

        Raises InputError where the pusher occupies the place, and then keeps the old object.
        """
        pose = checked_pose(pose)
        body = self._new_body(sim_object)
        body.place(pose)
        if body.touches(self._robot, self._contact_link):
            self._client.removeBody(body.body)
            raise InputError(f"The pusher occupies the place of the object, {np.round(pose, 4)}; lift or move the tool first.")
        self._client.removeBody(self._body.body)
        self.object, self._body, self._start_pose = sim_object, body, pose
        self._body.start_push()
        self._tell_pushes_done()

    def reset_object(self) -> None:
        """Put the object back to its start pose, at rest; raises InputError where the pusher occupies the place."""
        self.place_object(self._start_pose)

    # --- forces --------------------------------------------------------------------------------------------------------

    def cell_loads(self) -> Float64Array:
        """Normal force of the table on each cell in the last step [N], shape (n_cells,)."""
        return self._body.cell_loads(self._table)

    def take_pusher_force(self) -> Float64Array:
        """Force of the pusher on the object [N], shape (3,): mean over the steps since the last call."""
        force = self._impulse / (max(self._impulse_steps, 1) * self.config.time_step)
        self._impulse = np.zeros(3)
        self._impulse_steps = 0
        return force


class _DrivenTool:
    """Moves the arm so that the lowered tool is where the effects on it place it, not where the arm reports it."""

    def __init__(self, effects: InjectedEffects, time_step: float, robot: CellRobot) -> None:
        self._errors = ToolErrors(effects, time_step)
        self._time_step = time_step
        self._kinematics = ArmKinematics(robot.description, neutral=robot.neutral)
        self._bend = self._bend_rate = np.zeros(len(robot.joint_names))
        """True minus reported joint positions [rad], and its rate of change [rad/s]."""

    def set_pushes_done(self, n_pushes: int) -> None:
        """Number of pushes made; some effects grow with it."""
        self._errors.pushes_done = n_pushes

    def driven(self, position: Float64Array, velocity: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Targets [rad], [rad/s] of the motors where the arm commands those given; called once per time step."""
        tip = self._kinematics.forward(position)[:3, 3]
        # Below the first height the effects on the position of the tool act in full, above the second not at all [m].
        lowered, raised = 0.06, 0.10
        if tip[2] > raised:
            self._errors.start(tip[:2])
        share = float(np.clip((raised - tip[2]) / (raised - lowered), 0.0, 1.0))
        displacement = share * (self._errors.true_position(tip[:2]) - tip[:2])
        bend = np.linalg.pinv(self._kinematics.jacobian(position)) @ [*displacement, 0.0, 0.0, 0.0, 0.0]
        self._bend_rate = (bend - self._bend) / self._time_step
        self._bend = bend
        return position + bend, velocity + self._bend_rate

    def reported(self, position: Float64Array, velocity: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Reported positions [rad] and velocities [rad/s] of joints whose true ones are given."""
        return position - self._bend, velocity - self._bend_rate
