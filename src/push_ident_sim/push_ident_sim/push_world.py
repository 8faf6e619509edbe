"""Table, object and a disc that pushes it in Bullet: pushes without arm and camera, for experiments that need many."""

from __future__ import annotations

import numpy as np
import pybullet as bullet
from numpy.typing import ArrayLike, NDArray

from push_ident.physics.simulation import GRAVITY
from push_ident.types import PusherPath
from push_ident_sim.bullet_object import OUTLINE_GROUP, PUSHER_GROUP, BulletObject, add_table, checked_pose, connect
from push_ident_sim.objects import SimObject
from push_ident_sim.true_motion import TrueMotion

__all__ = ["PushWorld"]

FloatArray = NDArray[np.float64]

_PUSHER_LINK = 1
_PUSHER_MASS = 1.0
_PUSHER_EFFORT = 1e4
"""[N]: the object cannot hold the pusher back."""
_SETTLING_STEPS = 10
"""After the object was put down, so that every foot bears its load."""


class PushWorld:
    """An object on a table, and a disc that follows a path whatever the object does. Not safe to share between threads."""

    def __init__(self, thing: SimObject, pusher_radius: float, *, time_step: float = 1.0 / 240.0, solver_iterations: int = 50) -> None:
        """`pusher_radius` [m] > 0, `time_step` [s]."""
        self.pusher_radius = pusher_radius
        self.time_step = time_step
        self._client = connect(time_step, solver_iterations, GRAVITY)
        add_table(self._client)
        self._object = BulletObject(self._client, thing, GRAVITY)
        self._pusher = self._add_pusher(float(thing.height.max()) / 2)

    def _add_pusher(self, height: float) -> int:
        """A ball with its centre at `height` [m], on two sliding joints.

        Upright walls touch it where they would touch a disc, and at one point: of the contacts along a cylinder Bullet keeps some with the
        normal that the wall had when it turned less, and the pusher then sticks where it should slide.
        """
        client = self._client
        shape = client.createCollisionShape(bullet.GEOM_SPHERE, radius=self.pusher_radius, collisionFramePosition=[0.0, 0.0, height])
        pusher: int = client.createMultiBody(
            baseMass=0.0,
            linkMasses=[_PUSHER_MASS] * 2,
            linkCollisionShapeIndices=[-1, shape],
            linkVisualShapeIndices=[-1, -1],
            linkPositions=[[0.0, 0.0, 0.0]] * 2,
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * 2,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * 2,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * 2,
            linkParentIndices=[0, 1],
            linkJointTypes=[bullet.JOINT_PRISMATIC] * 2,
            linkJointAxis=[[1, 0, 0], [0, 1, 0]],
        )
        for link in range(2):
            client.changeDynamics(pusher, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, restitution=0.0)
        client.changeDynamics(pusher, _PUSHER_LINK, lateralFriction=1.0)
        client.setCollisionFilterGroupMask(pusher, _PUSHER_LINK, PUSHER_GROUP, OUTLINE_GROUP)
        return pusher

    def push(self, pose_object_in_table: ArrayLike, path: PusherPath, *, rest_speed: float = 1e-4, longest_rest: float = 1.0) -> TrueMotion:
        """Put the object down at rest and lead the pusher along `path`, then wait until the object rests.

        Args:
            pose_object_in_table: first pose (x, y, yaw), shape (3,), clear of the first position of the pusher.
            path: of the pusher; its clock starts at the first sample. Beyond the last sample the pusher stands.
            rest_speed: the object rests when its frame is slower than this [m/s] and turns at less than ten times it [rad/s].
            longest_rest: wait no longer than this after the path [s].
        """
        step = self.time_step
        self._place_pusher(path.position[0])
        self._object.place(checked_pose(pose_object_in_table))
        for _ in range(_SETTLING_STEPS):
            self._step(path.position[0], np.zeros(2))
        # Settling may creep by micrometres.
        self._object.place(checked_pose(pose_object_in_table))
        n_driven = int(np.ceil((path.time[-1] - path.time[0]) / step))
        n_most = n_driven + int(np.ceil(longest_rest / step))
        clock = path.time[0] + step * np.arange(n_most + 1)
        targets = np.column_stack([np.interp(clock, path.time, path.position[:, axis]) for axis in (0, 1)])
        poses, positions, forces = [self._object.pose()], [self._pusher_position()], [np.zeros(2)]
        for k in range(1, n_most + 1):
            self._step(targets[k], (targets[k] - positions[-1]) / step)
            poses.append(self._object.pose())
            positions.append(self._pusher_position())
            forces.append(self._object.force_of(self._pusher, _PUSHER_LINK)[:2])
            speed = np.abs(self._object.velocity())
            if k >= n_driven and speed[:2].max() < rest_speed and speed[2] < 10 * rest_speed:
                break
        time = np.arange(len(poses)) * np.float64(step)
        return TrueMotion(time, np.array(poses), np.array(positions), np.array(forces))

    def close(self) -> None:
        """Free the engine."""
        self._client.disconnect()

    def _step(self, target: FloatArray, velocity: FloatArray) -> None:
        self._client.setJointMotorControlArray(
            self._pusher, range(2), bullet.VELOCITY_CONTROL, targetVelocities=velocity.tolist(), forces=[_PUSHER_EFFORT] * 2
        )
        self._object.correct_friction()
        self._client.stepSimulation()

    def _place_pusher(self, position: FloatArray) -> None:
        for joint in range(2):
            self._client.resetJointState(self._pusher, joint, float(position[joint]), 0.0)

    def _pusher_position(self) -> FloatArray:
        return np.array([s[0] for s in self._client.getJointStates(self._pusher, range(2))])
