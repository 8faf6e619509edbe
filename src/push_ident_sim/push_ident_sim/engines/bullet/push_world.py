"""Table, object and what pushes it in Bullet, a disc or two fingers: pushes without arm and camera, for experiments that need many."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pybullet as bullet
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.physics.support import GRAVITY
from push_ident.types import Float64Array, PusherPath
from push_ident_sim.engines.bullet.bullet_object import OUTLINE_GROUP, PUSHER_GROUP, BulletObject, add_table, connect, outline_shape
from push_ident_sim.engines.bullet.rigid_object import RigidObject
from push_ident_sim.engines.true_motion import TrueMotion, checked_pose
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.injected.shared import ToolErrors, bearing_torque, restitution
from push_ident_sim.objects import SimObject

_FAR_AWAY = np.array([10.0, 10.0])
"""Far from any object [m]."""


class PushWorld:
    """An object on a table, and a disc or two fingers that follow a path whatever force the object exerts.

    Not safe to share between threads.
    """

    def __init__(
        self,
        sim_object: SimObject,
        pusher_radius: float,
        *,
        time_step: float = 1.0 / 240.0,
        effects: InjectedEffects | None = None,
        pusher_height: float | None = None,
        rigid: bool = False,
        fingers: Float64Array | None = None,
    ) -> None:
        """`pusher_radius` [m] > 0, `time_step` [s]; effects on poses and camera do not act here.

        `fingers`: axes of two fingers in the frame of the tool [m], shape (2, 2), as `PusherPath.fingers`; they turn with it. Effects on
        the tool need a single disc.

        `pusher_height`: of the contact above the table [m], half the height of the object by default; `rigid`: one body that may tilt and
        fall, without effects, instead of cells that each rest on their own weight.
        """
        effects = effects or InjectedEffects()
        if fingers is not None and (ToolErrors.needed(effects) or "rolling_finger" in effects):
            raise InputError("Effects on the tool act on a single disc, got two fingers; leave out the effects or the fingers.")
        self.pusher_radius = pusher_radius
        self._axes = np.zeros((1, 2)) if fingers is None else np.asarray(fingers, dtype=np.float64)
        self.time_step = time_step
        self._client = connect(time_step, GRAVITY, effects)
        self._table = add_table(self._client)
        self._object: BulletObject | RigidObject
        self._object = (
            RigidObject(self._client, sim_object, self._table) if rigid else BulletObject(self._client, sim_object, GRAVITY, effects)
        )
        self._tool = ToolErrors(effects, time_step) if ToolErrors.needed(effects) else None
        self._add_pusher(float(sim_object.height.max()) / 2 if pusher_height is None else pusher_height, effects)
        self._objects: list[BulletObject | RigidObject | None] = [self._object]
        """By their number; None for what is fixed to the table."""
        self._bodies = [(self._object.body, self._object.outline_link)]
        self.touched: set[int] = set()
        """Numbers of what the pushed object or the pusher touched beside each other since `begin`."""
        # An object on springs may only be reversing.
        self._still_steps = 30 if "compliant_table" in effects or "tether" in effects else 1
        self._force, self._at = np.zeros(2), np.zeros(len(self._driven))

    @property
    def _driven(self) -> range:
        """Joints that follow the path: x, y and, of fingers, the heading."""
        return range(2 if len(self._axes) == 1 else 3)

    def _add_pusher(self, height: float, effects: InjectedEffects) -> None:
        """A ball with its centre at `height` [m] for each axis, on two sliding joints; of fingers, on a rotary one beside them.

        Upright walls touch it where they would touch a disc, and at one point: of the contacts along a cylinder Bullet keeps some with the
        normal that the wall had when it turned less, and the pusher then sticks where it should slide.
        """
        client = self._client
        masses = [1.0, 1.0]
        joints = [(bullet.JOINT_PRISMATIC, [1, 0, 0]), (bullet.JOINT_PRISMATIC, [0, 1, 0])]
        if len(self._axes) > 1:
            joints.append((bullet.JOINT_REVOLUTE, [0, 0, 1]))
            masses.append(1.0)
        if "rolling_finger" in effects:
            joints.append((bullet.JOINT_REVOLUTE, [0, 0, 1]))
            masses.append(0.02)  # little, so that the finger turns at once
        n_links, n_balls = len(joints), len(self._axes)
        shape = client.createCollisionShapeArray(
            shapeTypes=[bullet.GEOM_SPHERE] * n_balls,
            radii=[self.pusher_radius] * n_balls,
            collisionFramePositions=[[x, y, height] for x, y in self._axes.tolist()],
        )
        self._pusher_link = n_links - 1
        self._pusher: int = client.createMultiBody(
            baseMass=0.0,
            linkMasses=masses,
            linkCollisionShapeIndices=[-1] * (n_links - 1) + [shape],
            linkVisualShapeIndices=[-1] * n_links,
            linkPositions=[[0.0, 0.0, 0.0]] * n_links,
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * n_links,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * n_links,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * n_links,
            linkParentIndices=list(range(n_links)),
            linkJointTypes=[kind for kind, _ in joints],
            linkJointAxis=[axis for _, axis in joints],
        )
        for link in range(n_links):
            client.changeDynamics(self._pusher, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, restitution=0.0)
        client.changeDynamics(self._pusher, self._pusher_link, lateralFriction=1.0)
        if restitution(effects) > 0.0:
            client.changeDynamics(self._pusher, self._pusher_link, restitution=1.0)
        if "rolling_finger" in effects:
            torque = bearing_torque(effects)
            client.setJointMotorControl2(self._pusher, self._pusher_link, bullet.VELOCITY_CONTROL, targetVelocity=0.0, force=torque)
        client.setCollisionFilterGroupMask(self._pusher, self._pusher_link, PUSHER_GROUP, OUTLINE_GROUP)

    def add(self, sim_object: SimObject, pose: ArrayLike, *, fixed: bool) -> int:
        """Put one more object onto the table, at a pose, shape (3,); `fixed`: nothing moves it. Its number; the first object has 0."""
        client, number = self._client, len(self._objects)
        if fixed:
            x, y, yaw = checked_pose(pose).tolist()
            body, link = (
                client.createMultiBody(
                    0.0,
                    outline_shape(client, sim_object, 0.0),
                    basePosition=[x, y, 0.0],
                    baseOrientation=client.getQuaternionFromEuler([0.0, 0.0, yaw]),
                ),
                -1,
            )
            self._objects.append(None)
        else:
            added = BulletObject(client, sim_object, GRAVITY)
            added.place(checked_pose(pose))
            body, link = added.body, added.outline_link
            self._objects.append(added)
        self._bodies.append((body, link))
        for some, its_link in self._bodies:
            client.setCollisionFilterGroupMask(some, its_link, OUTLINE_GROUP, PUSHER_GROUP | OUTLINE_GROUP)
        return number

    def remove(self, number: int) -> None:
        """Take what was added last off the table."""
        assert number == len(self._objects) - 1 > 0, "the last one"
        self._client.removeBody(self._bodies.pop()[0])
        self._objects.pop()

    def turn_to(self, number: int) -> None:
        """Push another object from now on, one that is not fixed."""
        chosen = self._objects[number]
        assert chosen is not None, "it can be moved"
        self._object = chosen

    def place(self, number: int, pose: ArrayLike) -> None:
        """Put an object that is not fixed at a pose, shape (3,), at rest."""
        chosen = self._objects[number]
        assert chosen is not None, "it can be moved"
        chosen.place(checked_pose(pose))

    def pose_of(self, number: int) -> Float64Array:
        """True pose of an object that is not fixed, shape (3,)."""
        chosen = self._objects[number]
        assert chosen is not None, "it can be moved"
        return chosen.pose()

    def push(
        self,
        pose_object_in_table: ArrayLike,
        path: PusherPath,
        *,
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        pushes_done: int = 0,
        watch: Callable[[], None] | None = None,
        rest_speed: float = 1e-4,
        longest_rest: float = 1.0,
    ) -> TrueMotion:
        """Place the object and move the pusher along `path`, then wait until the object rests.

        Args:
            pose_object_in_table: first pose (x, y, yaw), shape (3,), clear of the first position of the pusher.
            path: of the pusher, as its arm reports it; its clock starts at the first sample. After the last sample the pusher is at rest.
            velocity: first velocity of its frame (vx, vy, yaw rate) [m/s, m/s, rad/s], shape (3,).
            pushes_done: number of earlier pushes; some effects grow with it.
            watch: called after each time step, for quantities that the motion does not contain.
            rest_speed: the object rests when its frame is slower than this [m/s] and turns at less than ten times it [rad/s].
            longest_rest: wait no longer than this after the path [s].
        """
        step = self.time_step
        self.begin(pose_object_in_table, self._path(path)[0], velocity=velocity, pushes_done=pushes_done)
        n_driven = int(np.ceil((path.time[-1] - path.time[0]) / step))
        n_most = n_driven + int(np.ceil(longest_rest / step))
        clock = path.time[0] + step * np.arange(n_most + 1)
        targets = np.column_stack([np.interp(clock, path.time, axis) for axis in self._path(path).T])
        n_still = 0
        poses, positions, forces = [self._object.pose()], [self._at[:2]], [np.zeros(2)]
        for k in range(1, n_most + 1):
            pose, position, force = self.advance(targets[k])
            poses.append(pose)
            positions.append(position[:2])
            forces.append(force)
            if watch is not None:
                watch()
            n_still = n_still + 1 if self.is_still(rest_speed) else 0
            if k >= n_driven and n_still >= self._still_steps:
                break
        time, pusher = np.arange(len(poses)) * np.float64(step), np.array(positions)
        reported = pusher if self._tool is None else targets[: len(poses)]
        return TrueMotion(time, np.array(poses), pusher, reported, np.array(forces))

    def begin(
        self, pose_object_in_table: ArrayLike, tool: Float64Array, *, velocity: ArrayLike = (0.0, 0.0, 0.0), pushes_done: int = 0
    ) -> None:
        """Place the object and the pusher, for a push that `advance` makes step by step; arguments as in `push`.

        `tool`: axis of the pusher as its arm reports it [m], shape (2,); of fingers their frame (x, y, yaw), shape (3,).
        """
        start = self._begin(tool, pushes_done)
        self.touched = set()
        # Bullet keeps a contact of the push before where both bodies were put elsewhere, as long as they parted along its normal: it then
        # counts as a deep one, and throws the object away. Distant bodies have no contact.
        self._place_pusher(self._away(start))
        self._object.place(checked_pose(pose_object_in_table))
        self._client.performCollisionDetection()
        self._place_pusher(start)
        for _ in range(10):  # until every foot bears its load
            self._step(start, np.zeros(len(start)))
        # Settling may creep by micrometres.
        self._object.place(checked_pose(pose_object_in_table), velocity)
        self._object.start_push()
        self._object.set_pushes_done(pushes_done)
        self._at = self._pusher_position()

    def advance(self, tool: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
        """One time step, at the end of which the arm reports the pusher at `tool`, as in `begin`.

        Returns:
            Pose of the object, shape (3,), true axis or frame of the pusher, as `tool`, and its force on the object [N], shape (2,).
        """
        target = tool if self._tool is None else self._tool.true_position(tool)
        self._step(target, (target - self._at) / self.time_step)
        self._at = self._pusher_position()
        return self._object.pose(), self._at, self._force

    def displace(self, pose_object_in_table: ArrayLike) -> None:
        """Put the object elsewhere while the pusher stays, at rest: someone bumps into it. The two must not overlap."""
        self._place_pusher(self._away(self._at))
        self._object.place(checked_pose(pose_object_in_table))
        self._client.performCollisionDetection()
        self._place_pusher(self._at)

    def is_still(self, rest_speed: float = 1e-4) -> bool:
        """Whether the object is slower than this [m/s], and turns at less than ten times it [rad/s]."""
        speed = np.abs(self._object.velocity())
        return bool(speed[:2].max() < rest_speed and speed[2] < 10 * rest_speed)

    def cell_loads(self) -> Float64Array:
        """Normal force of the table on each cell in the last time step [N], shape (n_cells,)."""
        return self._object.cell_loads(self._table)

    def object_velocity(self) -> Float64Array:
        """(vx, vy, yaw rate) of the object frame [m/s, m/s, rad/s], shape (3,)."""
        return self._object.velocity()

    @property
    def has_fallen(self) -> bool:
        """Whether the object tips over the edge of the table, or lies beside it; only a rigid one can."""
        return self._object.has_fallen

    def close(self) -> None:
        """Free the engine."""
        self._client.disconnect()

    def _step(self, target: Float64Array, velocity: Float64Array) -> None:
        effort = 1e4  # [N]: the object cannot hold the pusher back
        self._client.setJointMotorControlArray(
            self._pusher, self._driven, bullet.VELOCITY_CONTROL, targetVelocities=velocity.tolist(), forces=[effort] * len(velocity)
        )
        for one in self._objects:
            if one is not None:
                one.prepare_step(self._force if one is self._object else np.zeros(2), self.time_step)
        self._client.stepSimulation()
        self._force = self._object.force_of(self._pusher, self._pusher_link)[:2]
        self._note_touched()

    def _note_touched(self) -> None:
        pushed = (self._object.body, self._object.outline_link)
        for number, (body, link) in enumerate(self._bodies if len(self._bodies) > 1 else ()):
            if (body, link) == pushed:
                continue
            for other, its_link in (pushed, (self._pusher, self._pusher_link)):
                # Bullet keeps contacts of bodies that are near: only those that overlap touch.
                if any(contact[8] <= 0.0 for contact in self._client.getContactPoints(other, body, its_link, link)):
                    self.touched.add(number)

    def _begin(self, reported: Float64Array, pushes_done: int) -> Float64Array:
        """True position of the tool when a path begins at `reported`, after some pushes."""
        self._force = np.zeros(2)
        if self._tool is None:
            return reported
        self._tool.pushes_done = pushes_done
        self._tool.start(reported)
        return self._tool.true_position(reported)

    def _path(self, path: PusherPath) -> Float64Array:
        """Position of the joints along a path, shape (n_samples, n_driven)."""
        if len(self._axes) == 1:
            return path.position
        return np.column_stack([path.position, np.zeros(len(path.time)) if path.yaw is None else path.yaw])

    def _away(self, position: Float64Array) -> Float64Array:
        return position + np.append(_FAR_AWAY, np.zeros(len(position) - 2))

    def _place_pusher(self, position: Float64Array) -> None:
        for joint in self._driven:
            self._client.resetJointState(self._pusher, joint, float(position[joint]), 0.0)

    def _pusher_position(self) -> Float64Array:
        return np.array([s[0] for s in self._client.getJointStates(self._pusher, self._driven)])
