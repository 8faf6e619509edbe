"""The simulated cell as a ROS node: the topics of the real cell, and the truth on private ones for tests and scoring."""

from __future__ import annotations

import json
import queue
import sys
import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from push_ident.errors import InputError
from push_ident.nodes.convert import TABLE_FRAME, depth_frame_to_msgs, force_to_msg, position_to_msg, stamp_from_msg, stamp_to_msg
from push_ident.nodes.parameters import Parameter, Parameters
from push_ident.nodes.run import run_node
from push_ident.types import DepthFrame
from push_ident_sim.camera import DepthCamera, DepthNoise, pose_from_quaternion
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object
from push_ident_sim.robot import robot_description
from push_ident_sim.trajectory import JointTrajectory
from push_ident_sim.world import CellWorld, WorldConfig

__all__ = ["PARAMETERS", "SimCellNode", "main"]

FloatArray = NDArray[np.float64]

PARAMETERS: Final = (
    Parameter("object", "hammer", "what lies on the table", choices=OBJECT_NAMES, read_only=True),
    Parameter("seed", 0, "which ground truth of the object's masses and frictions", 0, 2**31 - 1, read_only=True),
    Parameter("start_pose", [0.0, 0.0, 0.0], "x [m], y [m], yaw [rad] of the object frame at the start", -3.2, 3.2, read_only=True),
    Parameter("pusher_friction", 0.3, "friction coefficient of the pusher on the object", 0.0, 2.0, read_only=True),
    Parameter("real_time_factor", 1.0, "simulated seconds per second at most; 0: as fast as it can", 0.0, 100.0),
    Parameter("time_step", 1.0 / 240.0, "of the simulation [s]", 1e-3, 1e-2, read_only=True),
    Parameter("state_rate", 100.0, "of joint states, wrench and clock, in simulated time [Hz]", 10.0, 240.0, read_only=True),
    Parameter("camera_rate", 15.0, "of depth images, in simulated time [Hz]", 0.5, 60.0, read_only=True),
    Parameter("camera_position", [0.55, 0.0, 0.85], "optical frame in the table frame, x y z [m]", -10.0, 10.0, read_only=True),
    Parameter(
        "camera_quaternion",
        [0.67815377, 0.67815377, -0.20026847, -0.20026847],
        "orientation of the optical frame in the table frame, x y z w",
        -1.0,
        1.0,
        read_only=True,
    ),
    Parameter("depth_noise", 1.0, "scale of the axial noise of the camera; 0: none, nor holes at edges", 0.0, 10.0, read_only=True),
    Parameter("wrench_noise", 0.05, "standard deviation of the measured force, each axis [N]", 0.0, 10.0, read_only=True),
    Parameter("noise_seed", 0, "of the noise of all sensors", 0, 2**31 - 1, read_only=True),
)
_LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_STOP_WITHIN: Final = 1.0
"""Longest wait for a thread at the end [s]."""
_LAG: Final = 0.1
"""A simulation further behind its pace than this gives up catching up [s]."""


@dataclass(frozen=True, slots=True)
class _Snapshot:
    """What the camera needs to know of one moment."""

    time: float
    pose_object: FloatArray
    robot_link_poses: dict[str, FloatArray]


class SimCellNode(Node):
    """One thread steps the world and publishes its state, one renders; callbacks only hand requests to the first."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("sim_cell_node", **kwargs)
        self._settings = Parameters(self, PARAMETERS)
        values = self._settings.as_dict()
        thing = make_object(values["object"], values["seed"], values["pusher_friction"])
        self._world = CellWorld(thing, WorldConfig(time_step=values["time_step"]), pose=values["start_pose"])
        self._camera = DepthCamera(thing, pose_from_quaternion(values["camera_position"], values["camera_quaternion"]))
        self._noise = DepthNoise(scale=values["depth_noise"])
        self._wrench_noise = float(values["wrench_noise"])
        self._camera_period, self._state_period = 1.0 / values["camera_rate"], 1.0 / values["state_rate"]
        self._state_rng, self._camera_rng = np.random.default_rng(values["noise_seed"]).spawn(2)

        self._image_pub = self.create_publisher(Image, "depth/image_rect", qos_profile_sensor_data)
        self._info_pub = self.create_publisher(CameraInfo, "depth/camera_info", qos_profile_sensor_data)
        self._joint_pub = self.create_publisher(JointState, "joint_states", 10)
        self._wrench_pub = self.create_publisher(WrenchStamped, "pusher/wrench", 10)
        self._clock_pub = self.create_publisher(Clock, "/clock", 1)
        self._truth_pub = self.create_publisher(PoseStamped, "~/ground_truth/pose", 10)
        self._description_pub = self.create_publisher(String, "robot_description", _LATCHED)
        self._object_pub = self.create_publisher(String, "~/ground_truth/object", _LATCHED)
        self._description_pub.publish(String(data=robot_description()))
        self._object_pub.publish(String(data=_truth_json(thing, values["seed"])))

        self._trajectory = JointTrajectory.hold(self._world.joint_state()[0])
        self._new_trajectories: queue.SimpleQueue[JointTrajectoryMsg] = queue.SimpleQueue()
        self._resets: queue.SimpleQueue[Future[None]] = queue.SimpleQueue()
        self._snapshots: queue.Queue[_Snapshot] = queue.Queue(maxsize=1)
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self.create_subscription(JointTrajectoryMsg, "joint_trajectory", self._new_trajectories.put, 10)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self._threads = [threading.Thread(target=self._guard, args=(work,), daemon=True) for work in (self._simulate, self._render)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop both threads; raises what ended one of them early."""
        self._stop.set()
        for thread in self._threads:
            thread.join(_STOP_WITHIN)
        if not any(thread.is_alive() for thread in self._threads):
            self._world.close()
        if self._failure is not None:
            raise self._failure

    def _guard(self, work: Any) -> None:
        try:
            work()
        except BaseException as error:
            self._failure = error
            self._stop.set()
            self.get_logger().fatal(f"The simulation ended: {error}")
            self.context.try_shutdown()

    # --- thread of the simulation --------------------------------------------------------------------------------------

    def _simulate(self) -> None:
        step = self._world.config.time_step
        next_state = next_image = 0.0
        pace = _Pace()
        while not self._stop.is_set():
            self._take_requests()
            self._world.set_joint_targets(*self._trajectory.sample(self._world.time + step))
            self._world.step()
            now = self._world.time
            if now >= next_state - 0.5 * step:
                next_state += self._state_period
                self._publish_state(now)
            if now >= next_image - 0.5 * step:
                next_image += self._camera_period
                self._hand_over(_Snapshot(now, self._world.object_pose(), self._world.robot_link_poses()))
            pace.wait(now, self._settings["real_time_factor"])

    def _take_requests(self) -> None:
        while not self._new_trajectories.empty():
            msg = self._new_trajectories.get()
            try:
                self._trajectory = self._started(msg)
            except InputError as error:
                self.get_logger().error(f"joint_trajectory refused, the last one goes on: {error}")
        while not self._resets.empty():
            done = self._resets.get()
            try:
                self._world.reset_object()
            except InputError as error:
                done.set_exception(error)
            else:
                done.set_result(None)

    def _started(self, msg: JointTrajectoryMsg) -> JointTrajectory:
        now = self._world.time
        if not msg.points:
            return JointTrajectory.hold(self._world.joint_state()[0])
        trajectory = _trajectory_from_msg(msg, self._world.joint_names)
        outside = (trajectory.position < self._world.joint_lower) | (trajectory.position > self._world.joint_upper)
        if outside.any():
            i, j = np.argwhere(outside)[0]
            raise InputError(
                f"{self._world.joint_names[j]} goes to {trajectory.position[i, j]:.3f} rad at point {i}, "
                f"expected {self._world.joint_lower[j]:.3f} to {self._world.joint_upper[j]:.3f}."
            )
        return trajectory.from_state(now, *self._trajectory.sample(now))

    def _publish_state(self, now: float) -> None:
        stamp = stamp_to_msg(now)
        position, velocity = self._world.joint_state()
        joints = JointState(name=list(self._world.joint_names), position=position.tolist(), velocity=velocity.tolist())
        joints.header.stamp = stamp
        force = self._world.take_pusher_force()[:2] + self._wrench_noise * self._state_rng.standard_normal(2)
        x, y, yaw = self._world.object_pose()
        self._clock_pub.publish(Clock(clock=stamp))
        self._joint_pub.publish(joints)
        self._wrench_pub.publish(force_to_msg(stamp, force))
        self._truth_pub.publish(position_to_msg(stamp, [x, y, 0.0], yaw=float(yaw), frame_id=TABLE_FRAME))

    def _hand_over(self, snapshot: _Snapshot) -> None:
        """Give a moment to the camera; while it is busy with the last one simulated time stands still, so that no image is left out."""
        while not self._stop.is_set():
            try:
                return self._snapshots.put(snapshot, timeout=0.1)
            except queue.Full:
                continue

    # --- thread of the camera ------------------------------------------------------------------------------------------

    def _render(self) -> None:
        while not self._stop.is_set():
            try:
                snapshot = self._snapshots.get(timeout=0.1)
            except queue.Empty:
                continue
            depth = self._noise.apply(self._camera.render(snapshot.pose_object, snapshot.robot_link_poses), self._camera_rng)
            image, info = depth_frame_to_msgs(DepthFrame(snapshot.time, depth, self._camera.intrinsics), stamp_to_msg(snapshot.time))
            self._info_pub.publish(info)
            self._image_pub.publish(image)

    # --- callbacks -----------------------------------------------------------------------------------------------------

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        done: Future[None] = Future()
        self._resets.put(done)
        try:
            done.result(timeout=2.0)
        except InputError as error:
            response.success, response.message = False, str(error)
        except TimeoutError:
            response.success, response.message = False, "The simulation did not answer within 2 s; it is stopping or too slow."
        else:
            response.success, response.message = True, "object at its start pose"
        return response


class _Pace:
    """Keeps simulated time from running ahead of the wall clock."""

    def __init__(self) -> None:
        self._wall: float | None = None
        self._sim = self._factor = 0.0

    def wait(self, now: float, factor: float) -> None:
        """Sleep until `factor` times the wall time since the reference has reached `now` [s]; 0 never sleeps."""
        if self._wall is None or factor != self._factor:
            self._wall, self._sim, self._factor = time.perf_counter(), now, factor
        if factor == 0:
            return
        ahead = (now - self._sim) / factor - (time.perf_counter() - self._wall)
        if ahead > 0:
            time.sleep(ahead)
        elif ahead < -_LAG:
            self._wall, self._sim = time.perf_counter(), now


def _trajectory_from_msg(msg: JointTrajectoryMsg, joint_names: tuple[str, ...]) -> JointTrajectory:
    """Trajectory in the order of `joint_names`, on the clock of the message; raises InputError where it is not for these joints."""
    names = list(msg.joint_names)
    if sorted(names) != sorted(joint_names):
        raise InputError(f"it is for joints {names}, expected {list(joint_names)} in any order.")
    if stamp_from_msg(msg.header.stamp) != 0.0:
        raise InputError(f"its stamp is {stamp_from_msg(msg.header.stamp)} s, expected 0: it starts when it arrives.")
    order = [names.index(name) for name in joint_names]
    with_velocity = all(len(point.velocities) > 0 for point in msg.points)
    for i, point in enumerate(msg.points):
        if len(point.positions) != len(names) or (with_velocity and len(point.velocities) != len(names)):
            raise InputError(
                f"point {i} has {len(point.positions)} positions and {len(point.velocities)} velocities, expected {len(names)}."
            )
    times = np.array([point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in msg.points])
    positions = np.array([point.positions for point in msg.points])[:, order]
    velocities = np.array([point.velocities for point in msg.points])[:, order] if with_velocity else None
    return JointTrajectory(times, positions, velocities)


def _truth_json(thing: SimObject, seed: int) -> str:
    """The object's truth: lengths in metres, masses in kilograms, object frame."""
    arrays = ("cells", "height", "mass", "friction", "outline")
    scalars = {"name": thing.name, "seed": seed, "cell_size": thing.cell_size, "pusher_friction": thing.pusher_friction}
    return json.dumps({**scalars, **{name: getattr(thing, name).tolist() for name in arrays}})


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT."""
    return run_node(SimCellNode, args=args)


if __name__ == "__main__":
    sys.exit(main())
