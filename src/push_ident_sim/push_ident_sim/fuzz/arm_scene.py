"""The executor while it is fuzzed: an arm that follows its commands, an object on the table, and every command checked."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Any, ClassVar, Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from push_ident.geometry.outline import cells_in_outline
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.convert.messages import force_to_msg, planar_pose_to_msg, shape_to_msgs, stamp_from_msg, stamp_to_msg
from push_ident.nodes.convert.tool_path import correction_to_msg, path_goal
from push_ident.pushing.corridor import Corridor
from push_ident.pushing.steering import PathRequest, ToolCorrection
from push_ident.pushing.tool_path import ToolPath
from push_ident.types import Float64Array, ObjectShape
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import HandStatus, PushCorrection
from push_ident_sim.cell.robot import HOME, robot_description
from push_ident_sim.fuzz.bench import NodeFailure, granted
from push_ident_sim.fuzz.scenes import Scene
from push_ident_sim.fuzz.traffic import Arm

__all__ = ["Executor"]

_BOX: Final = np.array([0.0, 0.02, 0.3])
"""Pose of the box before each push."""
_TOOL_SPEED: Final = 0.1
"""Of a steered push [m/s]."""


def _path() -> PathRequest:
    """Against the middle of the short side of the box, for 6 cm; corrections may stay away for as long as this process may stall."""
    reach = float(Arm.BOX[:, 0].max()) + Arm.RADIUS
    line = transform_points(_BOX, np.array([[reach + 0.03, 0.0], [reach, 0.0], [reach - 0.06, 0.0]]))
    return PathRequest(ToolPath(np.array([0.0, 0.03, 0.09]) / _TOOL_SPEED, line), Corridor(line, 0.03), 4.0)


_PATH: Final = _path()

_PARKED: Final = (0.5, *HOME[1:])
_SPEED: Final = 2.0
"""Limit of every joint that the node is given [rad/s]."""
_MORE: Final = 1.3
"""Commanded speeds may be above the limit by this factor: between two points a cubic is faster than the straight line."""
_JUMP: Final = 0.5
"""Largest distance of a command from where the arm is, beside what it could move in the time given and while this process did not run
[rad]."""
_PERIOD: Final = 0.02
_PATIENCE: Final = 90.0
"""For a valid push to be made [s], as granted: pushes of mutated goals end first, and an arm that gets its motion late stops by itself."""
_FIST: Final = HandStatus(g_act=1, g_mod=0, g_gto=1, g_imc=3, g_sta=2, g_flt=0, g_pra=255)


class Executor(Scene):
    """Pushes a box again and again while it is fuzzed."""

    own_parameters: ClassVar[dict[str, object]] = {
        "max_joint_velocity": _SPEED,
        "max_joint_acceleration": 10.0,
        "free_speed": 0.5,
        "settle": 0.2,
        "rest": 0.4,
        "home_posture": list(_PARKED),
        "workspace": [-0.1, 0.2, -0.25, 0.25],
        # The arm is played by the process that makes the mutations, on a machine that may be busy: none of these is what is tried here.
        "arm_timeout": 2.0,
        "tracking_lag": 1.0,
        "tracking_tolerance": 0.1,
        "motion_horizon": 0.1,
        "lost_timeout": 8.0,
        "hand": "simulated",
        "hand_timeout": 5.0,
    }

    def prepare(self) -> None:
        """Arm, hand, force sensor and the object, on timers."""
        self.arm = Arm(_PARKED)
        self._checked = self._ticks = 0
        self._ticked, self._stalls = time.monotonic(), deque([0.0], maxlen=200)
        self._goal: Any = None
        self._began = 0.0
        self._push_id = self._n_begun = 0
        self.bench.node.create_subscription(
            self.bench.kind_of("push_ident_msgs/action/ExecutePush_FeedbackMessage"),
            "/execute_push/_action/feedback",
            self._on_feedback,
            50,
        )
        shape = ObjectShape(cells_in_outline(Arm.BOX, 0.01), Arm.BOX)
        cells, outline = shape_to_msgs(shape, "box", stamp_to_msg(1.0))
        self.keep("/robot_description", String(data=robot_description()))
        self.keep("/objects/box/cells", cells)
        self.keep("/objects/box/outline", outline)
        for topic, kind in (
            ("/joint_states", JointState),
            ("/objects/box/pose", PoseWithCovarianceStamped),
            ("/pusher/wrench", WrenchStamped),
            ("/Robotiq3FGripper/InputRegisters", HandStatus),
            ("/push_correction", PushCorrection),
        ):
            self.bench.offer(topic, kind)
        self.bench.node.create_subscription(JointTrajectory, "/joint_trajectory", self.arm.on_command, 50)
        self.bench.node.create_timer(_PERIOD, self._tick)

    def _tick(self) -> None:
        now, before = time.monotonic(), self._ticked
        self._ticked = now
        self._stalls.append(now - before)
        self.arm.step()
        self._ticks += 1
        stamp = self.bench.node.get_clock().now().to_msg()
        self.send("/joint_states", self.arm.states(stamp))
        self.send("/pusher/wrench", force_to_msg(stamp, np.array([0.6, -0.8])))
        if self._ticks % 2 == 0:
            self._correct(stamp)
            self.send("/objects/box/pose", planar_pose_to_msg(stamp, self.arm.box, 1e-6 * np.eye(3)))
        if self._ticks % 5 == 0:
            self.send("/Robotiq3FGripper/InputRegisters", _FIST)

    def step(self) -> None:
        """Start a push when none is under way, a straight one or one along a path."""
        if self._goal is not None and not self._goal.done() and time.monotonic() < self._began + 20.0:
            return
        self.arm.box[:] = _BOX
        self._began = time.monotonic()
        self._n_begun += 1
        self._goal = self._send_goal(self._push() if self._n_begun % 2 else self._steered())

    def _on_feedback(self, msg: Any) -> None:
        self._push_id = int(msg.feedback.push_id)

    def _correct(self, stamp: Time) -> None:
        """Straight on from where the tool is, to the end of the path; of a push that is not steered it is refused."""
        if not self._push_id:
            return
        tip, line = self.arm.kinematics.forward(self.arm.q)[:2, 3], _PATH.path.position
        along = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
        time_ = np.array([0.0, 0.4])
        left = float(along @ (line[-1] - tip))
        position = tip + np.outer(np.clip(_TOOL_SPEED * time_, 0.0, max(left, 0.0)), along)
        correction = ToolCorrection(self._push_id, stamp_from_msg(stamp), left < _TOOL_SPEED * time_[-1], time_, position)
        self.send("/push_correction", correction_to_msg(correction))

    @staticmethod
    def _steered() -> ExecutePush.Goal:
        return path_goal("box", _PATH)

    def _push(self) -> ExecutePush.Goal:
        return ExecutePush.Goal(
            object_id="box", contact_point=Point(x=0.05, y=0.0), frame_id="object_box", direction=math.pi, distance=0.06, speed=0.2
        )

    def requests(self, service: str) -> list[Any]:
        """A push of either kind."""
        if service != "/execute_push/_action/send_goal":
            return []
        return [self._request(goal) for goal in (self._push(), self._steered())]

    def _request(self, goal: ExecutePush.Goal) -> Any:
        request = self.bench.kind_of("push_ident_msgs/action/ExecutePush_SendGoal").Request(goal=goal)
        request.goal_id.uuid = list(np.random.default_rng().integers(0, 256, 16).tolist())
        return request

    def _send_goal(self, goal: ExecutePush.Goal) -> Any:
        """Future of the result; None when the goal was refused, or a mutated request has cleaned up the node."""
        service = self.bench.kind_of("push_ident_msgs/action/ExecutePush_SendGoal")
        request = self._request(goal)
        answer = self.bench.attempt("/execute_push/_action/send_goal", service, request)
        if answer is None or not answer.accepted:
            return None
        kind = self.bench.kind_of("push_ident_msgs/action/ExecutePush_GetResult")
        return self.bench.ask("/execute_push/_action/get_result", kind, kind.Request(goal_id=request.goal_id))

    def work(self) -> None:
        """Pushes are made as planned; another push that a mutated goal started may have to end first."""
        self._made(self._push())
        corrections = self._made(self._steered()).corrections
        self.require(corrections > 0, "a push along a path took no correction")

    def _made(self, goal: ExecutePush.Goal) -> ExecutePush.Result:
        """The result of a push that succeeds."""
        deadline = time.monotonic() + granted(_PATIENCE)
        while True:
            self.bench.wait(lambda: self._goal is None or self._goal.done(), 20.0)
            self.arm.box[:] = _BOX
            self.bench.spin(0.5)
            self._goal = self._send_goal(goal)
            done = self._goal is not None and self.bench.wait(self._goal.done, 30.0)
            self.require(done, "a valid push did not end within 30 s")
            result = self._goal.result().result
            self.check()
            if result.error_code == 0:
                return result
            self.require(time.monotonic() < deadline, f"no valid push is made, the last: {result.error_code}: {result.error_text}")
            self.bench.spin(1.0)

    def check(self) -> None:
        """No command beyond the limits of the arm, none that jumps."""
        new, self._checked = self.arm.commands[self._checked :], len(self.arm.commands)
        for _, q, msg in new:
            if fault := command_fault(q, msg, self.arm, stall=max(self._stalls)):
                raise NodeFailure("motion", fault)
        if len(self.arm.commands) > 1000:
            del self.arm.commands[:-100]
            self._checked = len(self.arm.commands)


def command_fault(q: Float64Array, msg: JointTrajectory, arm: Arm, *, stall: float) -> str:
    """What is wrong with a command to an arm that stands at `q` [rad]; empty when nothing is.

    `stall`: longest time for which the arm was not moved, because this process did not run [s].
    """
    if sorted(msg.joint_names) != sorted(arm.names):
        return f"command for joints {list(msg.joint_names)}"
    order = [list(msg.joint_names).index(name) for name in arm.names]
    if any(len(point.positions) != len(order) for point in msg.points) or not msg.points:
        return "command whose points do not have one position for each joint"
    times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in msg.points])
    positions = np.array([p.positions for p in msg.points])[:, order]
    if not np.isfinite(positions).all():
        return "command that is not finite"
    low, high = arm.kinematics.position_lower, arm.kinematics.position_upper
    if np.any(positions < low - 1e-6) or np.any(positions > high + 1e-6):
        return f"command beyond the joint limits: {positions.min(axis=0)} to {positions.max(axis=0)}"
    steps = np.diff(times)
    if np.any(steps <= 0.0):
        return "command whose times do not increase"
    jump = float(np.abs(positions[0] - q).max())
    if jump > _JUMP + _SPEED * _MORE * (float(times[0]) + stall):
        return f"command that starts {jump:.3f} rad from the arm, at {times[0]:.3f} s"
    if len(steps) and (speed := float((np.abs(np.diff(positions, axis=0)) / steps[:, None]).max())) > _SPEED * _MORE:
        return f"command with {speed:.2f} rad/s, allowed {_SPEED} rad/s"
    return ""
