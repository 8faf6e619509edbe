"""An arm, a hand and an object played on the topics of push_executor_node, and the node as a process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point, PolygonStamped, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import JointState
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from helpers.memory_cell import BOX, PARKED, RADIUS, SHAPE
from helpers.node_process import NodeProcess, wait_for
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.convert.messages import force_to_msg, planar_pose_to_msg, shape_to_msgs, stamp_from_msg
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import HandStatus, PushRecord
from push_ident_sim.cell.robot import HOME, robot_description
from push_ident_sim.cell.trajectory import JointTrajectory as Followed

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ARM_TIMEOUT = 0.5  # five times the default: the processes of this test may have to share one core with other tests
QUICK = {
    "max_joint_velocity": 2.0,
    "max_joint_acceleration": 10.0,
    "free_speed": 0.5,
    "settle": 0.2,
    "rest": 0.4,
    "home_posture": PARKED,
    "workspace": [-0.1, 0.2, -0.25, 0.25],
    "arm_timeout": ARM_TIMEOUT,
    "tracking_lag": ARM_TIMEOUT,
    "lost_timeout": 0.4,  # twice the arm timeout, where that is more
    "force_limit": 30.0,
    "hand": "simulated",
    "hand_timeout": 2.0,
}
PAUSE = 1.0
"""Between the commands of two motions [s]; within one there is one every 20 ms, if the machine has time for it."""
HORIZON = 0.08
"""Of the commands that an arm is given ahead: motion_horizon [s]."""
FIST = {"g_act": 1, "g_mod": 0, "g_gto": 1, "g_imc": 3, "g_sta": 2, "g_flt": 0, "g_pra": 255}


class Cell(Node):
    """An arm that follows trajectories as ros2_control does, a hand that is a fist, and a box that the tool carries along."""

    def __init__(self, context: Context) -> None:
        super().__init__("cell", context=context)
        self.kinematics = ArmKinematics(robot_description(), neutral=HOME)
        self.q = np.array(PARKED)
        self._n_ticks = 0
        self.silent = False
        self.force = 1.0
        self.pose_variance = 1e-6
        self.fist = dict(FIST)
        self.box = np.array([0.0, 0.02, 0.3])
        self.commands: list[tuple[float, JointTrajectory]] = []
        self.states: list[tuple[float, np.ndarray]] = []
        self._followed = Followed.hold(self.q)
        self._lock = threading.Lock()  # a test places the arm while the thread of the node moves it
        self.tool: list[PoseStamped] = []
        self.pusher: list[PoseStamped] = []
        self.records: list[PushRecord] = []
        self.shapes: list[SolidPrimitive] = []
        self.diagnostics: list[DiagnosticArray] = []
        self._tip = self.kinematics.forward(self.q)[:3, 3]
        cells, outline = shape_to_msgs(SHAPE, "box", self.get_clock().now().to_msg())
        self._publish_once(String, "robot_description", String(data=robot_description()))
        self._publish_once(OccupancyGrid, "objects/box/cells", cells)
        self._publish_once(PolygonStamped, "objects/box/outline", outline)
        self._states = self.create_publisher(JointState, "joint_states", 10)
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "objects/box/pose", 10)
        self._wrenches = self.create_publisher(WrenchStamped, "pusher/wrench", qos_profile_sensor_data)
        self._hand = self.create_publisher(HandStatus, "Robotiq3FGripper/InputRegisters", 10)
        self.recording = self.create_publisher(DiagnosticStatus, "recording", LATCHED)
        self.create_subscription(JointTrajectory, "joint_trajectory", self._on_command, 10)
        for kind, topic, kept, qos in (
            (PoseStamped, "tool/pose", self.tool, 10),
            (PoseStamped, "pusher/pose", self.pusher, 10),
            (PushRecord, "push_record", self.records, 10),
            (SolidPrimitive, "pusher/shape", self.shapes, LATCHED),
            (DiagnosticArray, "/diagnostics", self.diagnostics, 10),
        ):
            self.create_subscription(kind, topic, kept.append, qos)
        self.create_timer(0.01, self._tick)
        self.client = ActionClient(self, ExecutePush, "execute_push")

    def reset(self) -> None:
        """As at the start: at home, all sensors alive, nothing recorded yet."""
        self.silent, self.force, self.fist, self.pose_variance = False, 1.0, dict(FIST), 1e-6
        self.box[:] = 0.0, 0.02, 0.3
        for kept in (self.commands, self.states, self.tool, self.pusher, self.records):
            kept.clear()
        if np.max(np.abs(self.q - PARKED)) > 1e-3:
            with self._lock:  # without a motion that would carry the box along
                self.q = np.array(PARKED)
                self._followed = Followed.hold(self.q)
                self._tip = self.kinematics.forward(self.q)[:3, 3]
            time.sleep(1.2)  # an arm that jumped is believed after a second

    @property
    def holds(self) -> list[tuple[float, JointTrajectory]]:
        """Commands of one point, which is how a motion ends before its time: received [s], message."""
        return [(received, msg) for received, msg in list(self.commands) if is_hold(msg)]

    def delays(self) -> float:
        """By how much gaps between the commands of a motion exceed half of what they give the arm ahead: so long it may have stood [s].

        A motion ends with a hold, or before a pause.
        """
        pairs = pairwise(list(self.commands))
        gaps = [second - first for (first, msg), (second, _) in pairs if second - first <= PAUSE and not is_hold(msg)]
        return float(np.sum(np.maximum(np.array(gaps) - HORIZON / 2, 0.0)))

    def _publish_once(self, kind: type, topic: str, msg: object) -> None:
        self.create_publisher(kind, topic, LATCHED).publish(msg)

    def _on_command(self, msg: JointTrajectory) -> None:
        received = time.monotonic()
        order = [list(msg.joint_names).index(name) for name in self.kinematics.joint_names]
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in msg.points])
        position, velocity = (np.array([getattr(p, name) for p in msg.points])[:, order] for name in ("positions", "velocities"))
        with self._lock:
            self._followed = Followed(times, position, velocity).from_state(received, *self._followed.sample(received))
        self.commands.append((received, msg))

    def _tick(self) -> None:
        with self._lock:
            self._move(time.monotonic())
        self._publish()

    def _move(self, now: float) -> None:
        """The arm goes on to `now` [s], with the box if it pushes it."""
        self.q = self._followed.sample(now)[0]
        self.states.append((now, self.q))
        before, self._tip = self._tip, self.kinematics.forward(self.q)[:3, 3]
        if self.touches(self._tip):
            self._carry_box(self._tip[:2], self._tip[:2] - before[:2])

    def touches(self, tip: np.ndarray) -> bool:
        """Whether a tip [m], shape (3,), is low and at the box."""
        return bool(tip[2] < 0.05 and signed_distance(tip[None, :2], transform_points(self.box, BOX))[0] < RADIUS)

    def _carry_box(self, tip: np.ndarray, moved: np.ndarray) -> None:
        """The tip, at `tip` [m], shape (2,), moved by `moved` [m], shape (2,), in contact: the box goes along and never turns."""
        self.box[:2] += moved

    def _publish(self) -> None:
        stamp = self.get_clock().now().to_msg()
        if not self.silent:
            state = JointState(name=list(self.kinematics.joint_names), position=self.q.tolist())
            state.header.stamp = stamp
            self._states.publish(state)
        self._wrenches.publish(force_to_msg(stamp, np.array([0.6 * self.force, -0.8 * self.force])))
        self._n_ticks += 1
        if self._n_ticks % 10 == 0:
            self._hand.publish(HandStatus(**self.fist))
        if self._n_ticks % 3 == 0:
            self.poses.publish(planar_pose_to_msg(stamp, self.box, np.eye(3) * self.pose_variance))


@dataclass
class Call:
    handle: object
    result: object
    feedback: list[int] = field(default_factory=list)

    def end(self, timeout: float = 20.0) -> ExecutePush.Result:
        wait_for(self.result.done, timeout)
        return self.result.result().result


def ask(node: Node, question: Callable[[], Any]) -> Any:
    """What `question` gives in the thread that spins.

    In another thread an answer may come before rclpy has noted the request, and be lost; what is destroyed there ends the spin.
    """
    task = node.executor.create_task(question)
    wait_for(task.done)
    return task.result()


def is_hold(command: JointTrajectory) -> bool:
    return len(command.points) == 1 and not np.any(command.points[0].velocities)


def wait_until_ready(cell: Cell, timeout: float = 120.0) -> None:
    """Until an executor that has just been started sees the box."""
    started = time.time()

    def sees_box(msg: DiagnosticArray) -> bool:
        return stamp_from_msg(msg.header.stamp) > started and "objects: box" in summary(msg)  # the one before it may be heard still

    wait_for(lambda: any(sees_box(msg) for msg in list(cell.diagnostics)), timeout)


def begin_push(cell: Cell, **fields: object) -> Call:
    """A push whose tool is on its way through the box."""
    call = send(cell, **(CONTACT | fields))
    wait_for(lambda: call.result.done() or (cell.pusher and ExecutePush.Feedback.PHASE_PUSH in call.feedback))
    assert not call.result.done(), call.end()
    return call


def send(cell: Cell, **fields: object) -> Call:
    feedback: list[int] = []
    goal = ExecutePush.Goal(**fields)
    sent = ask(cell, lambda: cell.client.send_goal_async(goal, feedback_callback=lambda m: feedback.append(int(m.feedback.phase))))
    wait_for(sent.done)
    handle = sent.result()
    assert handle.accepted
    return Call(handle, ask(cell, handle.get_result_async), feedback)


def start_node(domain: int, folder: Path, **parameters: object) -> NodeProcess:
    return NodeProcess("push_executor_node", "push_ident.nodes", QUICK | parameters, domain, folder)


def summary(msg: DiagnosticArray) -> str:
    return "; ".join(f"{v.key}: {v.value}" for v in msg.status[0].values)


CONTACT = {
    "object_id": "box",
    "contact_point": Point(x=0.05, y=0.0),
    "frame_id": "object_box",
    "direction": np.pi,
    "distance": 0.06,
    "speed": 0.2,
}


class Stalls:
    """How long this machine let a thread wait that wanted to run: what a bound on latency must be granted on a busy one."""

    def __init__(self) -> None:
        self.worst = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        last = time.monotonic()
        while not self._stop.wait(0.005):
            now = time.monotonic()
            self.worst = max(self.worst, now - last - 0.005)
            last = now

    def __enter__(self) -> Stalls:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()
