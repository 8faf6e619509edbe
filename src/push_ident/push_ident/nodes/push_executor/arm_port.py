"""The arm on ROS: joint states and the force of the pusher in, joint trajectories out, and the lease that makes one executor command it."""

from __future__ import annotations

import errno
import hashlib
import math
import socket
import struct
import threading
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import WrenchStamped
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg
from trajectory_msgs.msg import JointTrajectoryPoint

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.parameters import description_in
from push_ident.nodes.convert.messages import force_from_msg, stamp_from_msg, stamp_to_msg
from push_ident.nodes.push_executor.controller_goals import TrajectoryController
from push_ident.nodes.push_executor.settings import EXECUTOR
from push_ident.pushing.arm_clock import ArmClock
from push_ident.pushing.ports import ArmState, ControllerGoal
from push_ident.pushing.push import PushCode
from push_ident.pushing.state_intake import StateCheck, StateIntake, no_positions
from push_ident.pushing.trajectory import JointTrajectory


def _message(joint_names: tuple[str, ...], piece: JointTrajectory, start: float | None) -> JointTrajectoryMsg:
    msg = JointTrajectoryMsg(joint_names=list(joint_names))
    if start is not None:  # a stamp of zero: start on receipt, whatever the controller's clock
        msg.header.stamp = stamp_to_msg(start)
    msg.points = [
        JointTrajectoryPoint(positions=array("d", q), velocities=array("d", v), time_from_start=_duration(t))
        for t, q, v in zip(piece.time, piece.position, piece.velocity, strict=True)
    ]
    return msg


def _duration(seconds: float) -> Duration:
    nanoseconds = round(1e9 * float(seconds))
    return Duration(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


class ArmPort:
    """Subscribes to `robot_description` and `joint_states`, publishes `joint_trajectory`."""

    def __init__(
        self,
        node: Node,
        *,
        description_file: str,
        tip_frame: str,
        neutral: list[float],
        callback_group: CallbackGroup,
        on_state: Callable[[ArmState, Time], None],
        controller: TrajectoryController | None = None,
    ) -> None:
        """Without `description_file` the URDF is taken from the topic. `on_state` gets each state and its stamp. `controller` takes goals,
        where the arm is to be moved by them.

        Raises InputError when the file cannot be used.
        """
        self._node, self._tip_frame, self._neutral, self._on_state = node, tip_frame, neutral, on_state
        self._controller = controller
        self._kinematics: ArmKinematics | None = None
        self._planner: ArmKinematics | None = None
        self._intake: StateIntake | None = None
        self._clock = ArmClock()
        self._reported: set[str] = set()
        self._unread = (-math.inf, "")
        self._is_standing = True
        self._n_users = 0
        self._offered = ""
        self.description_fault = ""
        """Why the latest description cannot be used; empty when it is used or kept for later."""
        self.n_received = 0
        self.n_dropped = 0
        self._publisher = node.create_publisher(JointTrajectoryMsg, "joint_trajectory", 10)
        if description_file:
            self._use(description_in(description_file))
        else:
            node.create_subscription(String, "robot_description", self._on_description, LATCHED, callback_group=callback_group)
        node.create_subscription(JointState, "joint_states", self._on_joint_states, qos_profile_sensor_data, callback_group=callback_group)

    @property
    def state(self) -> ArmState | None:
        """Latest state; None before the first."""
        return None if self._intake is None else self._intake.latest

    @property
    def planner(self) -> ArmKinematics:
        """Kinematics for planning, not those of the joint state callback. Raises PlanningError ARM_SILENT before there are any."""
        if self._planner is None:
            raise self._no_description()
        return self._planner

    def _no_description(self) -> PlanningError:
        topic = self._node.resolve_topic_name("robot_description")
        return PlanningError(PushCode.ARM_SILENT, f"no robot description received on {topic}; is the arm's driver running?")

    @property
    def silence(self) -> float:
        """Wall time since the last joint state [s]."""
        return math.inf if self.state is None else time.monotonic() - self.state.received

    @property
    def why_silent(self) -> str:
        """Why states that come since the latest one cannot be read; empty where none come."""
        received, why = self._unread
        return why if self.state is None or received > self.state.received else ""

    def fresh_state(self, timeout: float, *, is_late: bool = False) -> ArmState:
        """Latest state; raises PlanningError ARM_SILENT early enough for the arm to be held `timeout` [s] of wall time after the last one.

        `is_late`: this process did not get to run for a while, so it is not the arm that is to blame: states that wait to be taken in
        get a moment.
        """
        limit = timeout - EXECUTOR.hold_margin
        deadline = time.monotonic() + (EXECUTOR.intake_grace if is_late else 0.0)
        while self.silence > limit and time.monotonic() < deadline:
            time.sleep(0.002)
        state, silence = self.state, self.silence
        if state is None and self._planner is None:
            raise self._no_description()  # states cannot be read without one
        if state is None or silence > limit:
            since = "yet" if state is None else f"for {1e3 * silence:.0f} ms, and the arm must be held after {1e3 * timeout:.0f} ms"
            refused = self.impossible_state(time.monotonic() - EXECUTOR.rest_silence)
            why = f"; those that come cannot be true: {refused}" if refused else f"; {self.why_silent}." if self.why_silent else "."
            raise PlanningError(PushCode.ARM_SILENT, f"no joint states on {self._node.resolve_topic_name('joint_states')} {since}{why}")
        return state

    def next_state(self, timeout: float) -> ArmState:
        """The first state that comes in after this call, for an arm at rest; raises PlanningError ARM_SILENT as `fresh_state`.

        Planning keeps the interpreter busy, so states may be taken in late for a moment: that is waited out here.
        """
        asked = time.monotonic()
        patience = EXECUTOR.discovery if self.state is None else EXECUTOR.rest_silence
        while self.state is None or self.state.received <= asked:
            if time.monotonic() - asked > patience:
                return self.fresh_state(timeout)
            time.sleep(0.002)
        return self.state

    def rivals(self) -> tuple[str, ...]:
        """Other nodes that command the same arm, by full name: the lease of this machine does not cover other machines."""
        infos = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name("joint_trajectory"))
        names = [f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos]
        name = self._node.get_fully_qualified_name()
        if name in names:
            names.remove(name)
        return tuple(sorted(names))

    def stamp_now(self) -> tuple[float, bool]:
        """As `pushing.ports.Arm`. There is a state once `next_state` has returned."""
        return self._clock.at(time.monotonic())

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Plans and motions speak of one arm: its description stays as it is in this context, and until the arm stands after it."""
        self._n_users += 1
        try:
            yield
        finally:
            self._n_users -= 1

    def take_states(self) -> list[ArmState]:
        """As `pushing.ports.Arm`."""
        return [] if self._intake is None else self._intake.take_waiting()

    def impossible_state(self, since: float) -> str:
        """As `pushing.ports.Arm`."""
        return "" if self._intake is None else self._intake.impossible(since)

    def send(self, joint_names: tuple[str, ...], piece: JointTrajectory, start: float | None) -> None:
        """As `pushing.ports.Arm`. The joints have the names of the motion, whatever is described later."""
        self._publisher.publish(_message(joint_names, piece, start))

    def check_goals(self) -> None:
        """As `pushing.ports.Arm`."""
        self._goals().check()

    def send_goal(self, joint_names: tuple[str, ...], piece: JointTrajectory, start: float | None) -> ControllerGoal:
        """As `pushing.ports.Arm`."""
        return self._goals().send(_message(joint_names, piece, start))

    def _goals(self) -> TrajectoryController:
        if self._controller is None:
            raise PlanningError(PushCode.ARM_SILENT, "the executor was started without goals of the controller; set free_motions.")
        return self._controller

    # ---- description of the arm

    def _on_description(self, msg: String) -> None:
        self._offered, self.description_fault = msg.data, ""
        self._use_offered()

    def _use_offered(self) -> None:
        """Use the latest description, unless the arm moves or may be moved with the one before; refuse one that does not fit the arm."""
        is_waiting = self._planner is None  # a push may be requested before the first description, which it needs
        is_free = is_waiting or (self._is_standing and not self._n_users)
        if not self._offered or self.description_fault or not is_free:
            return
        try:
            self._use(self._offered)
        except InputError as error:
            self.description_fault = f"robot_description refused: {error}"
            self._node.get_logger().error(self.description_fault)
        else:
            self._offered = ""

    def _use(self, urdf_xml: str) -> None:
        """Raises InputError when it is no description of this arm."""
        planner, kinematics = (ArmKinematics(urdf_xml, self._tip_frame, self._neutral) for _ in range(2))
        if self._reported and (unknown := [name for name in kinematics.joint_names if name not in self._reported]):
            raise InputError(f"its joints {', '.join(unknown)} are not among those of joint_states: {', '.join(sorted(self._reported))}.")
        self._planner, self._kinematics = planner, kinematics
        speed = np.minimum(kinematics.velocity_limit, EXECUTOR.max_joint_speed)
        self._intake = StateIntake(StateCheck(kinematics.position_lower, kinematics.position_upper, speed), kinematics.forward)

    # ---- states of the arm

    def _on_joint_states(self, msg: JointState) -> None:
        received = time.monotonic()
        if not self._reported.issuperset(msg.name) and len(self._reported) < EXECUTOR.n_joint_names:
            self._reported.update(msg.name[: EXECUTOR.n_joint_names])
            self.description_fault = ""  # a description that came before the states of its arm gets another chance
        self._use_offered()
        if self._kinematics is None or self._intake is None:
            return
        before = self._intake.latest
        position = dict(zip(msg.name, msg.position, strict=False))
        if len(set(msg.name)) < len(msg.name):
            self.n_dropped += 1
            raise InputError(f"a joint is named twice: {', '.join(sorted(msg.name))}; which of its positions counts?")
        names = self._kinematics.joint_names
        if without := [name for name in names if name in msg.name and not math.isfinite(position.get(name, math.nan))]:
            self.n_dropped += 1
            self._unread = (received, no_positions(without))
            raise InputError(f"{self._unread[1]}.")
        if missing := [name for name in names if name not in position]:
            self.n_dropped += 1
            self._node.get_logger().warning(
                f"joint_states dropped: no position of {', '.join(missing)}; it has {', '.join(msg.name) or 'no joints'}.",
                throttle_duration_sec=5.0,
            )
            return
        q = np.array([position[name] for name in names])
        stamp = stamp_from_msg(msg.header.stamp)
        try:
            state = self._intake.take(received, stamp, q)
        except InputError:
            self.n_dropped += 1
            raise
        if state is None:
            self.n_dropped += 1
            return
        if before is not None:
            step = max(stamp - before.stamp, 1e-3)
            self._is_standing = float(np.max(np.abs(q - before.q))) <= EXECUTOR.standing_speed * step
        self.n_received += 1
        self._clock.observe(received, stamp)
        self._on_state(state, msg.header.stamp)


class ForcePort:
    """Subscribes to `pusher/wrench`, where there is one."""

    def __init__(self, node: Node, callback_group: CallbackGroup) -> None:
        self._node, self._lock = node, threading.Lock()
        self._peak = 0.0
        self._received = -math.inf
        self._stamp = Time()
        self._is_there = False
        self.fault = ""
        """Why the latest measurement cannot be trusted; empty where it can."""
        node.create_subscription(WrenchStamped, "pusher/wrench", self._on_wrench, qos_profile_sensor_data, callback_group=callback_group)

    @property
    def is_there(self) -> bool:
        """As `pushing.ports.ForceSensor`: from the first message on, and while the topic has a publisher."""
        return self._is_there or self._node.count_publishers(self._node.resolve_topic_name("pusher/wrench")) > 0

    @property
    def silence(self) -> float:
        """Wall time since the last measurement that can be trusted [s]; infinite before the first."""
        return time.monotonic() - self._received

    def take_peak(self) -> float:
        """Largest horizontal force since the last call [N]; infinite where a measurement could not be trusted."""
        with self._lock:
            peak, self._peak = self._peak, 0.0
        return peak

    def _on_wrench(self, msg: WrenchStamped) -> None:
        self._is_there = True
        if msg.header.stamp == self._stamp != Time():
            raise InputError("its stamp is that of the message before: a driver that repeats itself has lost its sensor.")
        self._stamp = msg.header.stamp
        try:
            size = float(np.linalg.norm(force_from_msg(msg)[1]))
        except InputError as error:
            self._note(math.inf, str(error))
            raise
        self._received = time.monotonic()
        self._note(size, "")

    def _note(self, size: float, fault: str) -> None:
        with self._lock:
            self._peak, self.fault = max(self._peak, size), fault


class ArmLease:
    """The right to command the arm that listens on a topic of a ROS domain.

    It is the name of an abstract Unix socket: binding it is atomic, so of two processes that start at once one wins, and the name is
    free again as soon as its holder is gone, even by SIGKILL. Such names are shared by all processes of one network namespace, where
    ROS nodes of one machine find each other. An executor on another machine is found in the ROS graph instead (`ArmPort.rivals`).
    """

    def __init__(self, domain_id: int, topic: str) -> None:
        """Take the lease; raises InputError, naming the process that holds it, when it is taken.

        `topic` is the resolved name of the topic that commands the arm.
        """
        name = "\0push_ident_arm_" + hashlib.sha256(f"{domain_id} {topic}".encode()).hexdigest()[:32]
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(name)
        except OSError as error:
            self._socket.close()
            if error.errno != errno.EADDRINUSE:
                raise InputError(f"The lease of the arm on {topic} cannot be taken: {error.strerror}.") from None
            raise InputError(
                f"Another executor ({_holder(name)}) commands the arm on {topic} in ROS domain {domain_id}; stop it first."
            ) from None
        self._socket.listen()

    def release(self) -> None:
        """Give the arm free; the end of the process does so, too."""
        self._socket.close()


def _holder(name: str) -> str:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.2)
        try:
            probe.connect(name)
        except OSError:
            return "process unknown"
        pid, _, _ = struct.unpack("3i", probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
    return f"process {pid}"
