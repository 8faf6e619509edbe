"""The arm on ROS: joint states in, joint trajectories out."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Duration, Time
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg
from trajectory_msgs.msg import JointTrajectoryPoint

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.nodes.convert import stamp_from_msg
from push_ident.pushing.motion import ArmMotion
from push_ident.pushing.ports import ArmState
from push_ident.pushing.push import PushCode
from push_ident.types import Float64Array

__all__ = ["ArmPort"]

_HOLD_WITHIN = 0.1
"""Time the arm is given to come to a halt [s]."""
_MARGIN = 0.03
"""[s] by which a silent arm is given up early, so that it is held within the timeout: three looks of the watch."""
_GRACE = 0.03
"""[s] for states that have arrived but were not taken in yet."""
_PATIENCE = 1.0
"""How long an arm at rest may stay silent before a push is refused [s]."""


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
    ) -> None:
        """Without `description_file` the URDF is taken from the topic. `on_state` gets each state and its stamp.

        Raises InputError when the file cannot be used.
        """
        self._node, self._tip_frame, self._neutral, self._on_state = node, tip_frame, neutral, on_state
        self._kinematics: ArmKinematics | None = None
        self._planner: ArmKinematics | None = None
        self._state: ArmState | None = None
        self._stamp = Time()
        self.n_received = 0
        self.n_dropped = 0
        self._publisher = node.create_publisher(JointTrajectoryMsg, "joint_trajectory", 10)
        if description_file:
            try:
                with open(description_file, encoding="utf-8") as file:
                    self._use_description(file.read())
            except OSError as error:
                raise InputError(f"Parameter robot_description_file: {error}.") from None
        else:
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            node.create_subscription(String, "robot_description", self._on_description, latched, callback_group=callback_group)
        node.create_subscription(JointState, "joint_states", self._on_joint_states, qos_profile_sensor_data, callback_group=callback_group)

    @property
    def state(self) -> ArmState | None:
        """Latest state; None before the first."""
        return self._state

    @property
    def planner(self) -> ArmKinematics:
        """Kinematics for planning, not those of the joint state callback. Raises PlanningError ARM_SILENT before there are any."""
        if self._planner is None:
            topic = self._node.resolve_topic_name("robot_description")
            raise PlanningError(PushCode.ARM_SILENT, f"no robot description received on {topic}; is the arm's driver running?")
        return self._planner

    @property
    def silence(self) -> float:
        """Wall time since the last joint state [s]."""
        return math.inf if self.state is None else time.monotonic() - self.state.received

    def fresh_state(self, timeout: float, *, is_late: bool = False) -> ArmState:
        """Latest state; raises PlanningError ARM_SILENT early enough for the arm to be held `timeout` [s] of wall time after the last one.

        `is_late`: this process did not get to run for a while, so it is not the arm that is to blame: states that wait to be taken in
        get a moment.
        """
        limit = timeout - _MARGIN
        deadline = time.monotonic() + (_GRACE if is_late else 0.0)
        while self.silence > limit and time.monotonic() < deadline:
            time.sleep(0.002)
        state, silence = self.state, self.silence
        if state is None or silence > limit:
            since = "yet" if state is None else f"for {1e3 * silence:.0f} ms, and the arm must be held after {1e3 * timeout:.0f} ms"
            raise PlanningError(PushCode.ARM_SILENT, f"no joint states on {self._node.resolve_topic_name('joint_states')} {since}.")
        return state

    def next_state(self, timeout: float) -> ArmState:
        """The first state that comes in after this call, for an arm at rest; raises PlanningError ARM_SILENT as `fresh_state`.

        Planning keeps the interpreter busy, so states may be taken in late for a moment: that is waited out here.
        """
        asked = time.monotonic()
        while self.state is None or self.state.received <= asked:
            if time.monotonic() - asked > _PATIENCE:
                return self.fresh_state(timeout)
            time.sleep(0.002)
        return self.state

    def rivals(self) -> tuple[str, ...]:
        """Other nodes that command the same arm, by full name: the lease of this machine does not cover other machines."""
        infos = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name("joint_trajectory"))
        names = [f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos]
        own = self._node.get_fully_qualified_name()
        if own in names:
            names.remove(own)
        return tuple(sorted(names))

    def prepare(self, motion: ArmMotion) -> JointTrajectoryMsg:
        """Message that starts a planned motion; filling it takes tens of milliseconds, so it is not left to the last moment."""
        return self._message(motion.trajectory.time, motion.trajectory.position, motion.trajectory.velocity)

    def send(self, command: JointTrajectoryMsg) -> ArmState:
        """Start a prepared motion; the arm's latest state just before. There is one once `next_state` has returned."""
        state = self.state
        assert state is not None
        self._publisher.publish(command)
        return state

    def hold(self, q: Float64Array) -> None:
        """Replace whatever is being executed by standing still at `q` [rad].

        One point rather than an empty trajectory, which some controllers refuse and carry on.
        """
        self._publisher.publish(self._message(np.array([_HOLD_WITHIN]), q[None, :], np.zeros((1, len(q)))))

    def _message(self, times: Float64Array, position: Float64Array, velocity: Float64Array) -> JointTrajectoryMsg:
        # The stamp stays zero: start on receipt, whatever the controller's clock.
        msg = JointTrajectoryMsg(joint_names=list(self.planner.joint_names))
        for t, q, v in zip(times, position, velocity, strict=True):
            nanoseconds = round(1e9 * float(t))
            msg.points.append(
                JointTrajectoryPoint(
                    positions=array("d", q),
                    velocities=array("d", v),
                    time_from_start=Duration(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9),
                )
            )
        return msg

    def _on_description(self, msg: String) -> None:
        try:
            self._use_description(msg.data)
        except InputError as error:
            self._node.get_logger().error(f"robot_description refused: {error}")

    def _use_description(self, urdf_xml: str) -> None:
        self._planner, self._kinematics = (ArmKinematics(urdf_xml, self._tip_frame, self._neutral) for _ in range(2))

    def _on_joint_states(self, msg: JointState) -> None:
        received = time.monotonic()
        if self._kinematics is None:
            return
        if self._state is not None and msg.header.stamp == self._stamp != Time():
            # A driver that repeats itself has lost its arm: it counts as silent.
            self.n_dropped += 1
            return
        position = dict(zip(msg.name, msg.position, strict=False))
        missing = [name for name in self._kinematics.joint_names if not math.isfinite(position.get(name, math.nan))]
        if missing:
            self.n_dropped += 1
            self._node.get_logger().warning(
                f"joint_states dropped: no finite position of {', '.join(missing)}; it has {', '.join(msg.name) or 'no joints'}.",
                throttle_duration_sec=5.0,
            )
            return
        q = np.array([position[name] for name in self._kinematics.joint_names])
        self.n_received += 1
        self._stamp = msg.header.stamp
        self._state = ArmState(stamp_from_msg(msg.header.stamp), q, self._kinematics.forward(q), received)
        self._on_state(self._state, msg.header.stamp)
