"""A process that stands in for joint_trajectory_controller and its arm, as both look from outside.

What it does was read from the documentation and the source of joint_trajectory_controller (ros2_controllers, branch jazzy) and is written
anew here, with `interpolate_from_desired_state` and position commands:

- A trajectory, from the topic or the action, takes the place of the one under way, from the state that was commanded last. One of the topic
  leaves the goal active: that ends by its tolerances at the end of the new trajectory. A new goal aborts the old one (INVALID_GOAL).
- While a trajectory is under way, each joint keeps within its trajectory tolerance of where it is to be, else the goal is aborted
  (PATH_TOLERANCE_VIOLATED) and the present position is held at once. At its end each comes within its goal tolerance and the velocity
  tolerance of standing, within `goal_time` where that is not 0, else GOAL_TOLERANCE_VIOLATED.
- Nothing holds the arm in the middle of a trajectory when its client is gone; `cmd_timeout` counts from the end of one.
- Refused: other joints, no points, a last velocity that is not 0, an end in the past, times that do not increase, positions that are
  missing. The action rejects such a goal, the topic is silent about it.
- The result of a goal comes with `action_monitor_rate`; texts name neither joint nor tolerance, those are in its log.

The arm is where it was commanded, but for what `~/fault` (std_msgs/String) asks: `block JOINT` (that joint stands), `reject` (every goal is
rejected); anything else ends it.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import rclpy
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from push_ident.errors import InputError
from push_ident.nodes.base.settings import NODE
from push_ident.nodes.convert.messages import stamp_from_msg, stamp_to_msg
from push_ident_sim.cell.trajectory import JointTrajectory as Followed

Result = FollowJointTrajectory.Result
NAME = "trajectory_controller"


class Active:
    """The goal under way, and how it ends."""

    def __init__(self, handle: ServerGoalHandle, path: np.ndarray, goal: np.ndarray) -> None:
        self.handle, self.path_tolerance, self.goal_tolerance = handle, path, goal
        self.result: Result | None = None
        self.status = GoalStatus.STATUS_EXECUTING
        self.ended = threading.Event()

    def end(self, status: int, code: int, text: str) -> None:
        self.status, self.result = status, Result(error_code=code, error_string=text)
        self.ended.set()


class TrajectoryController(Node):
    """See above."""

    def __init__(self) -> None:
        super().__init__(NAME)
        self._joints = list(self._parameter("joints", [""]))
        self._actual = np.array(self._parameter("position", [0.0]))
        n = len(self._joints)
        self._path_tolerance = np.full(n, self._parameter("constraints.trajectory", 0.0))
        self._goal_tolerance = np.full(n, self._parameter("constraints.goal", 0.0))
        self._stopped_velocity = self._parameter("constraints.stopped_velocity_tolerance", 0.01)
        self._goal_time = self._parameter("constraints.goal_time", 0.0)
        self._cmd_timeout = self._parameter("cmd_timeout", 0.0)
        self._monitor_period = 1.0 / self._parameter("action_monitor_rate", 20.0)
        self._followed, self._is_holding = Followed.hold(self._actual), True
        self._last = self._now()
        self._lock = threading.RLock()
        self._active: Active | None = None
        self._blocked: set[int] = set()
        self._rejects = False
        self._n_ticks = 0
        many = ReentrantCallbackGroup()
        self._states = self.create_publisher(JointState, "joint_states", 10)
        self.create_subscription(JointTrajectory, "joint_trajectory", self._on_topic, 10, callback_group=MutuallyExclusiveCallbackGroup())
        self.create_subscription(String, "~/fault", self._on_fault, 10, callback_group=many)
        self.create_timer(1.0 / self._parameter("update_rate", 100.0), self._update, callback_group=MutuallyExclusiveCallbackGroup())
        self._server = ActionServer(
            self,
            FollowJointTrajectory,
            "follow_joint_trajectory",
            self._execute,
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
            callback_group=many,
        )

    def _parameter(self, name: str, default: object) -> object:
        return self.declare_parameter(name, default).value

    def _now(self) -> float:
        return 1e-9 * self.get_clock().now().nanoseconds

    def _on_fault(self, msg: String) -> None:
        what, _, joint = msg.data.partition(" ")
        with self._lock:
            self._rejects = what == "reject"
            self._blocked = {self._joints.index(joint)} if what == "block" else set()

    # ---- what it takes

    def _why_refused(self, msg: JointTrajectory) -> str:
        if sorted(msg.joint_names) != sorted(self._joints):
            return f"joints {msg.joint_names}, expected {self._joints}"
        if not msg.points:
            return "no points"
        if any(abs(v) > np.finfo(np.float32).eps for v in msg.points[-1].velocities):
            return "the last velocity is not zero"
        times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in msg.points]
        if msg.header.stamp != Time() and stamp_from_msg(msg.header.stamp) + times[-1] < self._now():
            return "its end is in the past"
        if any(later <= before for before, later in pairwise(times)):
            return "times do not increase"
        n = len(msg.joint_names)
        if any(len(p.positions) != n or len(p.velocities) not in (0, n) for p in msg.points):
            return "a point lacks positions"
        return "" if all(math.isfinite(x) for p in msg.points for x in p.positions) else "a position is no number"

    def _on_goal(self, goal: FollowJointTrajectory.Goal) -> GoalResponse:
        why = "as asked" if self._rejects else self._why_refused(goal.trajectory)
        if why:
            self.get_logger().error(f"goal rejected: {why}")
        return GoalResponse.REJECT if why else GoalResponse.ACCEPT

    def _follow(self, msg: JointTrajectory) -> None:
        order = [list(msg.joint_names).index(name) for name in self._joints]
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in msg.points])
        position = np.array([p.positions for p in msg.points])[:, order]
        moves = len(msg.points[0].velocities) > 0
        velocity = np.array([p.velocities for p in msg.points])[:, order] if moves else None
        start = None if msg.header.stamp == Time() else stamp_from_msg(msg.header.stamp)
        now = self._now()
        with suppress(InputError):  # its end has passed since it was looked at
            self._followed = Followed(times, position, velocity).from_state(now, *self._followed.sample(now), start)
            self._is_holding = False

    def _hold(self) -> None:
        self._followed, self._is_holding = Followed.hold(self._actual), True

    def _on_topic(self, msg: JointTrajectory) -> None:
        with self._lock:
            if why := self._why_refused(msg):
                self.get_logger().error(f"trajectory refused: {why}")
            else:
                self._follow(msg)

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        goal: FollowJointTrajectory.Goal = handle.request
        with self._lock:
            if self._active is not None:
                self._active.end(GoalStatus.STATUS_ABORTED, Result.INVALID_GOAL, "another goal has taken its place.")
            path, end = self._path_tolerance.copy(), self._goal_tolerance.copy()
            for own, asked in ((path, goal.path_tolerance), (end, goal.goal_tolerance)):
                self._merge(own, asked)
            self._active = Active(handle, path, end)
            self._follow(goal.trajectory)
        handle.execute()

    def _merge(self, own: np.ndarray, asked: list[JointTolerance]) -> None:
        """A tolerance of 0 leaves that of the controller, -1 takes it away."""
        for each in asked:
            if each.position:
                own[self._joints.index(each.name)] = max(each.position, 0.0)

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        with self._lock:
            if self._active is not None and self._active.handle.goal_id == handle.goal_id:
                self._active.end(GoalStatus.STATUS_CANCELED, 0, "")
                self._active = None
                self._hold()
        return CancelResponse.ACCEPT

    def _execute(self, handle: ServerGoalHandle) -> Result:
        """Waits for the end of a goal, and says it at the rate of the monitor."""
        with self._lock:
            active = self._active
        if active is None or active.handle.goal_id != handle.goal_id:  # ended between acceptance and here
            handle.abort()
            return Result(error_code=Result.INVALID_GOAL)
        while not active.ended.wait(self._monitor_period):
            pass
        {GoalStatus.STATUS_SUCCEEDED: handle.succeed, GoalStatus.STATUS_CANCELED: handle.canceled}.get(active.status, handle.abort)()
        assert active.result is not None
        return active.result

    # ---- the arm

    def _update(self) -> None:
        with self._lock:
            now = self._now()
            desired, velocity = self._followed.sample(now)
            before, self._actual = self._actual, desired.copy()
            for joint in self._blocked:
                self._actual[joint] = before[joint]
            error = self._actual - desired
            speed = (self._actual - before) / max(now - self._last, 1e-3)
            self._last = now
            self._judge(now, error, velocity - speed)
            self._publish(now, desired, error)

    def _judge(self, now: float, error: np.ndarray, speed_error: np.ndarray) -> None:
        active = self._active
        path = self._path_tolerance if active is None else active.path_tolerance
        end = self._goal_tolerance if active is None else active.goal_tolerance
        late = now - self._followed.time[-1]
        if self._is_holding:
            return
        if late < 0.0:
            if np.any((path > 0.0) & (np.abs(error) > path)):
                self._give_up(Result.PATH_TOLERANCE_VIOLATED, "tolerance of the path violated", error, path)
            return
        if self._cmd_timeout > self._goal_time and late > self._cmd_timeout:
            self._hold()
        is_outside = np.any((end > 0.0) & (np.abs(error) > end)) or np.any(np.abs(speed_error) > self._stopped_velocity)
        if not is_outside and active is not None:
            active.end(GoalStatus.STATUS_SUCCEEDED, Result.SUCCESSFUL, "reached")
            self._active = None
            self._is_holding = True
        elif is_outside and 0.0 < self._goal_time < late:
            self._give_up(Result.GOAL_TOLERANCE_VIOLATED, f"not there {late:.2f} s after the end", error, end)

    def _give_up(self, code: int, text: str, error: np.ndarray, tolerance: np.ndarray) -> None:
        joint = int(np.argmax(np.abs(error)))
        self.get_logger().error(f"{text}: {self._joints[joint]} {error[joint]:.4f} rad, tolerance {tolerance[joint]:.4f} rad")
        if self._active is not None:
            self._active.end(GoalStatus.STATUS_ABORTED, code, text)
            self._active = None
        self._hold()

    def _publish(self, now: float, desired: np.ndarray, error: np.ndarray) -> None:
        state = JointState(name=self._joints, position=self._actual.tolist())
        state.header.stamp = stamp_to_msg(now)  # a later one would make the next state look like a jump, where this thread waits here
        self._states.publish(state)
        self._n_ticks += 1
        if self._active is not None and self._n_ticks % 5 == 0 and self._active.handle.is_active:
            feedback = FollowJointTrajectory.Feedback(joint_names=self._joints)
            feedback.desired, feedback.error = (JointTrajectoryPoint(positions=p.tolist()) for p in (desired, error))
            self._active.handle.publish_feedback(feedback)


class ControllerProcess:
    """The stand-in as a process of its own."""

    def __init__(self, joints: tuple[str, ...], position: np.ndarray, domain: int, folder: Path, **parameters: object) -> None:
        given = {"joints": list(joints), "position": [float(q) for q in position], **parameters}
        arguments = [part for name, value in given.items() for part in ("-p", f"{name}:={value}")]
        self._log = folder / f"{NAME}.log"
        with self._log.open("a") as log:
            self._process = subprocess.Popen(
                [sys.executable, __file__, "--ros-args", *arguments],
                env=os.environ | {"ROS_DOMAIN_ID": str(domain)},
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    @property
    def output(self) -> str:
        return self._log.read_text(errors="replace")

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def stop(self) -> None:
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(20.0)
        finally:
            self.kill()


def main() -> None:
    rclpy.init()
    node = TrajectoryController()
    executor = MultiThreadedExecutor(6)
    executor.add_node(node)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        while rclpy.ok():
            executor.spin_once(timeout_sec=NODE.spin_wait)
            time.sleep(NODE.worker_start)  # as `run_node`: else it takes a whole core, and the arm stands still for want of it


if __name__ == "__main__":
    main()
