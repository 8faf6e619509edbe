"""The simulated cell as a ROS node: the topics of the real cell, and the truth on private ones for tests and scoring.

With `camera_rate` 0 there is no camera. With `truth_as_perception` the cell itself publishes the topics of perception for an object
`truth`: its shape and its true poses with a little noise, for work on the stages after perception.
"""

from __future__ import annotations

import json
import queue
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from push_ident.errors import InputError
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.geometry.table import Table
from push_ident.limits import LIMITS, plain_text
from push_ident.nodes.base.cell_node import CellNode, Component, Health
from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.convert.messages import (
    TABLE_FRAME,
    depth_frame_to_msgs,
    force_to_msg,
    planar_pose_to_msg,
    position_to_msg,
    shape_to_msgs,
    stamp_from_msg,
    stamp_to_msg,
)
from push_ident.nodes.convert.table import TABLE_TOPIC, table_to_msg
from push_ident.types import DepthFrame, Float64Array
from push_ident_sim.cell.camera import DepthCamera
from push_ident_sim.cell.robot import cell_robot
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import PLAIN, SENSOR_NAMES
from push_ident_sim.cell.trajectory import JointTrajectory
from push_ident_sim.cell.world import CellWorld, WorldConfig
from push_ident_sim.engines.bullet.bullet_object import TABLE
from push_ident_sim.injected import INJECTED, InjectedEffects
from push_ident_sim.injected.equations import reported_forces
from push_ident_sim.injected.sensing import PoseSensor, check_rendered, stamp_delay, true_camera
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object
from push_ident_sim.recordings.truth import true_model


class Meter:
    """Speed of the simulation and processor time of its parts."""

    def __init__(self) -> None:
        self.simulated = 0.0
        """Simulated time [s]."""
        self.n_images = 0
        self._used: defaultdict[str, float] = defaultdict(float)
        self._last = (time.perf_counter(), 0.0, 0, self._used.copy())

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Count the processor time that this thread spends inside; only one thread may measure each part."""
        begin = time.thread_time()
        yield
        self._used[part] += time.thread_time() - begin

    def read(self) -> dict[str, str]:
        """Since the last call, as text: real-time factor, images per simulated second, seconds of the processor per simulated second."""
        before = self._last
        self._last = now = (time.perf_counter(), self.simulated, self.n_images, self._used.copy())
        wall, simulated = now[0] - before[0], now[1] - before[1]
        values = {"real time factor": f"{simulated / wall:.3f}", "simulated time [s]": f"{now[1]:.2f}"}
        if simulated > 0:
            values["images [1/s]"] = f"{(now[2] - before[2]) / simulated:.1f}"
            values |= {f"processor, {part} [s/s]": f"{(now[3][part] - before[3][part]) / simulated:.3f}" for part in sorted(now[3])}
        return values


class Pace:
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
        elif ahead < -0.02:
            # It does not catch up: what it catches up goes by at once, without news from other processes. An arm that gets its motion in
            # pieces of 0.08 s would come to their ends, and brake.
            self._wall, self._sim = time.perf_counter(), now


_EFFECT: Final = "effects."
_SPAWNED: Final = "; takes effect with ~/spawn"


PARAMETERS: Final = (
    Parameter("object", "hammer", "object on the table" + _SPAWNED, choices=OBJECT_NAMES),
    Parameter("seed", 0, "seed of the ground truth of the object's masses and frictions" + _SPAWNED, 0, 2**31 - 1),
    Parameter("start_pose", [0.0, 0.0, 0.0], "x [m], y [m], yaw [rad] of the object frame at the start" + _SPAWNED, -3.2, 3.2),
    Parameter("pusher_friction", 0.3, "friction coefficient of the pusher on the object" + _SPAWNED, 0.0, 2.0),
    Parameter(
        "table",
        list(TABLE),
        "x_min, x_max, y_min, y_max of the table [m]; of another size the object is one rigid body, which may fall, without effects",
        -10.0,
        10.0,
        read_only=True,
    ),
    Parameter("real_time_factor", 1.0, "largest number of simulated seconds per second; 0: no limit", 0.0, 100.0),
    Parameter("robot", "", "robot file of the arm; empty: an iiwa with a closed hand", read_only=True),
    Parameter("time_step", 1.0 / 240.0, "of the simulation [s]", 1e-3, 1e-2, read_only=True),
    Parameter("state_rate", 100.0, "of joint states and wrench, in simulated time [Hz]", 10.0, 240.0, read_only=True),
    Parameter("clock_rate", 25.0, "of the clock, which wakes every node, in simulated time [Hz]", 10.0, 240.0, read_only=True),
    Parameter("camera_rate", 15.0, "of depth images, in simulated time [Hz]; 0: no camera", 0.0, 60.0, read_only=True),
    Parameter("camera_position", [0.55, 0.0, 0.85], "optical frame in the table frame, x y z [m]", -10.0, 10.0, read_only=True),
    Parameter(
        "camera_quaternion",
        [0.67815377, 0.67815377, -0.20026847, -0.20026847],
        "orientation of the optical frame in the table frame, x y z w",
        -1.0,
        1.0,
        read_only=True,
    ),
    Parameter("sensor", PLAIN, "model of the depth camera: its intrinsics and errors", read_only=True, choices=SENSOR_NAMES),
    Parameter("depth_noise", 1.0, "scale of the axial noise of the camera; 0: none (plain: nor holes)", 0.0, 10.0, read_only=True),
    Parameter("wrench_noise", 0.05, "standard deviation of the measured force, each axis [N]", 0.0, 10.0, read_only=True),
    Parameter("noise_seed", 0, "of the noise of all sensors", 0, 2**31 - 1, read_only=True),
    Parameter("truth_as_perception", False, "publish objects/truth/{pose,cells,outline} from the truth, without a camera", read_only=True),
    Parameter("truth_rate", 30.0, "of those poses, in simulated time [Hz]", 1.0, 240.0, read_only=True),
    Parameter("truth_noise", [0.0005, 0.005], "standard deviation of those poses: x and y [m], yaw [rad]", 1e-6, 0.1, read_only=True),
    *(
        Parameter(
            f"{_EFFECT}{effect.name}",
            list(effect.defaults),
            f"injected effect: {effect.what} " + "; ".join(f"{p.name} [{p.unit}]: {p.what}" for p in parameters),
            min(p.lowest for p in parameters),
            max(p.highest for p in parameters),
            read_only=True,
        )
        for effect in INJECTED.values()
        for parameters in (effect.parameters[: len(effect.defaults)],)
    ),
)
_LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_TRUTH_ID: Final = "truth"
"""Id of an object whose poses come from the truth."""


@dataclass(frozen=True, slots=True)
class _Snapshot:
    stamp: float
    """Of the image [s]; later than the state under a latency."""
    sim_object: SimObject
    pose_object: Float64Array
    """Planar, shape (3,), or homogeneous, shape (4, 4)."""
    robot_link_poses: dict[str, Float64Array]


class SimCellNode(CellNode):
    """The cell; simulated time stands while the node is not active, and a motion of the arm is not continued after."""

    yields = False

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("sim_cell_node", PARAMETERS, **kwargs)

    def make_component(self) -> Component:
        """World, camera and their threads."""
        return _SimCell(self)


class _SimCell(Component):
    """One thread steps the world and publishes its state, one renders; callbacks only hand requests to the first."""

    def __init__(self, node: CellNode) -> None:
        self._node, self._settings = node, node.settings
        values = self._settings.as_dict()
        effects = InjectedEffects.of({name: values[_EFFECT + name] for name in INJECTED})
        sim_object = _object_of(values)
        table = Table.rectangle(np.array(values["table"]))
        config = WorldConfig(time_step=values["time_step"], table=tuple(values["table"]), effects=effects)
        robot = cell_robot(values["robot"])
        self._world = CellWorld(sim_object, config, pose=values["start_pose"], robot=robot)
        self._camera_period = 1.0 / values["camera_rate"] if values["camera_rate"] > 0 else np.inf
        self._state_period, self._truth_period = 1.0 / values["state_rate"], 1.0 / values["truth_rate"]
        self._clock_period = 1.0 / values["clock_rate"]
        self._state_rng, self._camera_rng, self._drop_rng, self._truth_rng = np.random.default_rng(values["noise_seed"]).spawn(4)
        self._sensor = Sensor(values["sensor"], values["noise_seed"], values["depth_noise"])
        self._camera: DepthCamera | None = None
        if values["camera_rate"] > 0:
            check_rendered(effects)
            reported = pose_of_quaternion(values["camera_position"], values["camera_quaternion"])
            self._camera = self._sensor.camera(sim_object, *true_camera(effects, reported, self._sensor.intrinsics), robot.description)
            self._camera.set_table(values["table"])
        (self._dropped,) = effects["dropped_frames"]
        self._wrench_noise = float(values["wrench_noise"])
        self._truth_std = np.array(values["truth_noise"])[[0, 0, 1]]
        self._as_perception = PoseSensor(effects, self._truth_std, self._truth_rng) if values["truth_as_perception"] else None

        self._image_pub = node.create_publisher(Image, "depth/image_rect", qos_profile_sensor_data)
        self._info_pub = node.create_publisher(CameraInfo, "depth/camera_info", qos_profile_sensor_data)
        self._joint_pub = node.create_publisher(JointState, "joint_states", 10)
        self._wrench_pub = node.create_publisher(WrenchStamped, "pusher/wrench", 10)
        self._clock_pub = node.create_publisher(Clock, "/clock", 1)
        self._truth_pub = node.create_publisher(PoseStamped, "~/ground_truth/pose", 10)
        self._description_pub = node.create_publisher(String, "robot_description", _LATCHED)
        self._object_pub = node.create_publisher(String, "~/ground_truth/object", _LATCHED)
        self._table_pub = node.create_publisher(PolygonStamped, TABLE_TOPIC, _LATCHED)
        self._table_pub.publish(table_to_msg(table, stamp_to_msg(0.0)))
        if self._as_perception is not None:
            topic = f"objects/{_TRUTH_ID}/"
            self._pose_pub = node.create_publisher(PoseWithCovarianceStamped, topic + "pose", 10)
            self._cells_pub = node.create_publisher(OccupancyGrid, topic + "cells", _LATCHED)
            self._outline_pub = node.create_publisher(PolygonStamped, topic + "outline", _LATCHED)
        self._description_pub.publish(String(data=robot.description))
        self._publish_object(values["seed"])

        self._commanded = node.resolve_topic_name("joint_trajectory")
        self._trajectory = JointTrajectory.hold(self._world.joint_state()[0])
        self._new_trajectories: queue.SimpleQueue[JointTrajectoryMsg] = queue.SimpleQueue()
        self._requests: queue.SimpleQueue[_Request] = queue.SimpleQueue()
        self._snapshots: queue.Queue[_Snapshot] = queue.Queue(maxsize=1)
        self._stop = threading.Event()
        self._running = threading.Event()
        node.create_subscription(JointTrajectoryMsg, "joint_trajectory", self._new_trajectories.put, 10)
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_service(Trigger, "~/spawn", self._on_spawn)
        self._meter = Meter()
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._simulate, self._render)]
        for thread in self._threads:
            thread.start()

    def resume(self) -> None:
        """Let time go on; the arm stands."""
        self._trajectory = JointTrajectory.hold(self._world.joint_state()[0])
        self._running.set()

    def pause(self) -> None:
        """Stop time."""
        self._running.clear()

    def close(self) -> None:
        """Stop both threads."""
        self._stop.set()
        self._running.set()
        # A first rendering may take longer than a second; nothing is lost with it.
        deadline = time.monotonic() + 1.0
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        if not any(thread.is_alive() for thread in self._threads):
            self._world.close()

    # --- thread of the simulation --------------------------------------------------------------------------------------

    def _simulate(self) -> None:
        pace, schedule = Pace(), _Schedule()
        while not self._stop.is_set():
            if not self._running.is_set():
                self._running.wait()
                pace = Pace()
                continue
            was = self._node.guard.refused
            with self._node.guard.watch("simulation"):
                self._advance(schedule)
            if self._node.guard.refused > was and self._world.time == schedule.now:
                time.sleep(0.1)  # A world that cannot be stepped must not keep a core busy.
            schedule.now = self._world.time
            pace.wait(schedule.now, self._settings["real_time_factor"])

    def _advance(self, schedule: _Schedule) -> None:
        step = self._world.config.time_step
        with self._meter.measure("physics"):
            self._take_requests()
            self._world.set_joint_targets(*self._trajectory.sample(self._world.time + step))
            self._world.step()
        now = self._world.time
        self._meter.simulated = now
        if now >= schedule.clock - 0.5 * step:
            schedule.clock += self._clock_period
            self._clock_pub.publish(Clock(clock=stamp_to_msg(now)))
        if now >= schedule.state - 0.5 * step:
            schedule.state += self._state_period
            with self._meter.measure("state topics"):
                self._publish_state(now)
        if self._as_perception is not None and now >= schedule.truth - 0.5 * step:
            schedule.truth += self._truth_period
            self._publish_as_perception(now)
        if now >= schedule.image - 0.5 * step and self._camera is not None:
            schedule.image += self._camera_period
            if self._drop_rng.random() >= self._dropped:
                pose, links = self._world.object_transform(), self._world.robot_link_poses()
                schedule.late.append(_Snapshot(now + stamp_delay(self._world.config.effects, now), self._world.object, pose, links))
        while schedule.late and schedule.late[0].stamp <= now + 0.5 * step:
            self._hand_over(schedule.late.popleft())

    def _take_requests(self) -> None:
        while not self._new_trajectories.empty():
            msg = self._new_trajectories.get()
            # Where it is refused, the previous one continues.
            with self._node.guard.watch(self._commanded):
                self._trajectory = self._started(msg)
        while not self._requests.empty():
            request = self._requests.get()
            try:
                request.work()
            except Exception as error:
                request.done.set_exception(error)
            else:
                request.done.set_result(None)

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
        soon = 0.1  # nobody may remember having sent what starts later [s]
        start = stamp_from_msg(msg.header.stamp)
        if start > now + soon:
            raise InputError(f"it starts in {start - now:.3f} s, expected a stamp of 0 or of at most {soon} s from now.")
        return trajectory.from_state(now, *self._trajectory.sample(now), start=start or None)

    def _publish_state(self, now: float) -> None:
        stamp = stamp_to_msg(now)
        position, velocity = self._world.joint_state()
        joints = JointState(name=list(self._world.joint_names), position=position.tolist(), velocity=velocity.tolist())
        joints.header.stamp = stamp
        (force,) = reported_forces(self._world.config.effects, self._world.take_pusher_force()[None, :2])
        force = force + self._wrench_noise * self._state_rng.standard_normal(2)
        x, y, yaw = self._world.object_pose()
        self._joint_pub.publish(joints)
        self._wrench_pub.publish(force_to_msg(stamp, force))
        self._truth_pub.publish(position_to_msg(stamp, [x, y, 0.0], yaw=float(yaw), frame_id=TABLE_FRAME))

    def _publish_object(self, seed: int) -> None:
        sim_object = self._world.object
        self._object_pub.publish(String(data=_truth_json(sim_object, seed)))
        if self._as_perception is not None:
            cells, outline = shape_to_msgs(true_model(sim_object).shape, _TRUTH_ID, stamp_to_msg(self._world.time))
            self._cells_pub.publish(cells)
            self._outline_pub.publish(outline)

    def _publish_as_perception(self, now: float) -> None:
        assert self._as_perception is not None
        if self._world.has_fallen:
            return  # A camera would lose it.
        for stamp, pose in self._as_perception.measure(now, self._world.object_pose()):
            self._pose_pub.publish(planar_pose_to_msg(stamp_to_msg(stamp), pose, np.diag(self._truth_std**2)))

    def _hand_over(self, snapshot: _Snapshot) -> None:
        """Hand a state to the camera. Simulated time waits while the camera is busy, so that no image is dropped."""
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
            with self._node.guard.watch("camera"):
                self._render_one(snapshot)

    def _render_one(self, snapshot: _Snapshot) -> None:
        assert self._camera is not None
        if snapshot.sim_object is not self._camera.sim_object:
            self._camera.sim_object = snapshot.sim_object
        with self._meter.measure("rays"):
            view = self._sensor.look(self._camera, snapshot.pose_object, snapshot.robot_link_poses)
        with self._meter.measure("depth noise"):
            depth = self._sensor.read(view, self._camera_rng)
        with self._meter.measure("images"):
            frame = DepthFrame(snapshot.stamp, depth, self._sensor.intrinsics)
            image, info = depth_frame_to_msgs(frame, stamp_to_msg(snapshot.stamp), encoding=self._sensor.encoding)
            self._info_pub.publish(info)
            self._image_pub.publish(image)
        self._meter.n_images += 1

    # --- callbacks -----------------------------------------------------------------------------------------------------

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._run_between_steps(response, self._world.reset_object, "object at its start pose")

    def _on_spawn(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        values = self._settings.as_dict()

        def spawn() -> None:
            self._world.replace_object(_object_of(values), values["start_pose"])
            self._publish_object(values["seed"])

        return self._run_between_steps(response, spawn, f"{values['object']} of seed {values['seed']} at {values['start_pose']}")

    def _run_between_steps(self, response: Trigger.Response, work: Callable[[], None], done: str) -> Trigger.Response:
        if not self._running.is_set():
            raise InputError("The node is not active; activate it.")
        request = _Request(work)
        self._requests.put(request)
        try:
            request.done.result(timeout=2.0)
        except TimeoutError:
            raise InputError("The simulation did not answer within 2 s; it is stopping or too slow.") from None
        response.success, response.message = True, done
        return response

    def health(self) -> Health:
        """How fast simulated time goes, and what is injected."""
        values = self._meter.read()
        effects = self._world.config.effects.as_dict()
        factor = values["real time factor"]
        text = f"{factor} simulated seconds per second"
        if effects:
            text += f"; injected: {', '.join(effects)}"
        if self._world.has_fallen:
            text += "; the object has fallen from the table: call ~/reset to put it back"
        if self._as_perception is not None:
            text += f"; objects/{_TRUTH_ID} comes from the truth, not from a camera"
        return Health(DiagnosticStatus.OK, text, values | {f"effect {name}": str(size) for name, size in effects.items()})


@dataclass(slots=True)
class _Schedule:
    """Simulated times at which something is due [s]."""

    clock: float = 0.0
    state: float = 0.0
    truth: float = 0.0
    image: float = 0.0
    now: float = -1.0
    late: deque[_Snapshot] = field(default_factory=deque)


@dataclass(frozen=True, slots=True)
class _Request:
    work: Callable[[], None]
    done: Future[None] = field(default_factory=Future)


def _trajectory_from_msg(msg: JointTrajectoryMsg, joint_names: tuple[str, ...]) -> JointTrajectory:
    """Trajectory in the order of `joint_names`, from its start; raises InputError where it is not for these joints."""
    names = list(msg.joint_names)
    if sorted(names) != sorted(joint_names):
        raise InputError(f"it is for joints {plain_text(', '.join(names))}, expected {list(joint_names)} in any order.")
    LIMITS.POINTS.check(len(msg.points), "Trajectory")
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
    max_velocity = 100.0  # no arm comes near [rad/s]
    if velocities is not None and not np.all(np.abs(velocities) <= max_velocity):
        raise InputError(f"its velocities are not finite or over {max_velocity:.0f} rad/s.")
    return JointTrajectory(times, positions, velocities)


def _object_of(values: dict[str, Any]) -> SimObject:
    return make_object(values["object"], values["seed"], values["pusher_friction"])


def _truth_json(sim_object: SimObject, seed: int) -> str:
    """The object's truth: lengths in metres, masses in kilograms, object frame."""
    arrays = ("cells", "height", "mass", "friction", "outline")
    scalars = {"name": sim_object.name, "seed": seed, "cell_size": sim_object.cell_size, "pusher_friction": sim_object.pusher_friction}
    return json.dumps({**scalars, **{name: getattr(sim_object, name).tolist() for name in arrays}})
