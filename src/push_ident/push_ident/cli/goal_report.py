"""Goals of `push-ident push-to` and `demo --goal` as those of the action, and what comes of one: a line for each push, and JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from push_ident.cli.output import say
from push_ident.geometry.se2 import quaternion_of_yaw, wrap_angle, yaw_of_quaternion
from push_ident.limits import printable
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from geometry_msgs.msg import Pose

    from push_ident_msgs.action import PushToGoal


def goal_message(
    pose: Float64Array, *, object_id: str = "", tolerance_mm: float = 20.0, tolerance_deg: float = 5.73, **limits: Any
) -> PushToGoal.Goal:
    """The goal of the action at a pose, shape (3,); `limits` are further fields of it."""
    from push_ident_msgs.action import PushToGoal

    goal = PushToGoal.Goal(
        object_id=object_id, position_tolerance=1e-3 * tolerance_mm, yaw_tolerance=float(np.radians(tolerance_deg)), **limits
    )
    goal.goal.header.frame_id = "table"
    goal.goal.pose = pose_message(pose)
    return goal


def path_message(poses: Float64Array, speed: float, **fields: Any) -> PushToGoal.Goal:
    """The goal of the action along a path of poses, shape (n, 3), at a speed [m/s], 0 for that of the node; fields as of `goal_message`."""
    from geometry_msgs.msg import PoseStamped

    goal = goal_message(poses[-1], **fields)
    goal.kind, goal.speed = goal.KIND_PATH, float(speed)
    goal.path.header.frame_id = "table"
    goal.path.poses = [PoseStamped(pose=pose_message(pose)) for pose in poses]
    return goal


def edge_message(yaw: float | None, line: Float64Array | None, *, overhang_mm: float, held_mm: float, **fields: Any) -> PushToGoal.Goal:
    """The goal of the action at an edge; fields as of `goal_message`.

    `yaw`: heading there [rad], None for the nearest in which the object is held. `line`: two points of the edge, shape (2, 2) [m], None for
    the nearest that the node knows. `overhang_mm`: of the object beyond the edge [mm]; `held_mm`: least distance of the centre of mass from
    the border of its support [mm].
    """
    from geometry_msgs.msg import Point

    goal = goal_message(np.array([0.0, 0.0, yaw or 0.0]), **fields)
    goal.kind, goal.use_heading = goal.KIND_EDGE, yaw is not None
    goal.overhang, goal.held = 1e-3 * overhang_mm, 1e-3 * held_mm
    goal.edge = [] if line is None else [Point(x=float(x), y=float(y), z=0.0) for x, y in line]
    return goal


def pose_message(pose: Float64Array) -> Pose:
    """A pose (x, y, yaw) [m, m, rad], shape (3,)."""
    from geometry_msgs.msg import Pose

    msg = Pose()
    msg.position.x, msg.position.y = float(pose[0]), float(pose[1])
    turn = msg.orientation
    turn.x, turn.y, turn.z, turn.w = (float(value) for value in quaternion_of_yaw(pose[2]))
    return msg


def planar(pose: Pose) -> Float64Array:
    """(x, y, yaw) [m, m, rad] of a pose, shape (3,)."""
    turn = pose.orientation
    yaw = float(yaw_of_quaternion([turn.x, turn.y, turn.z, turn.w]))
    return np.array([pose.position.x, pose.position.y, yaw])


class PushLine:
    """One push on the way: predicted and observed.

    `seen` and `expected` are poses after it, table frame, shape (3,) [m, m, rad], the latter None for an exploring push; `chance` and
    `risk` the predicted probabilities of being at the goal then and, at an edge, of being held by less than it must [1]; `done` the share
    of a path that is behind [1], NaN without one.
    """

    def __init__(self, feedback: PushToGoal.Feedback, *, follows: bool = False) -> None:
        """`follows`: the goal is a path."""
        self.number = int(feedback.pushes)
        self.seen = planar(feedback.pose)
        self.expected: Float64Array | None = planar(feedback.expected_pose) if feedback.is_predicted else None
        self.chance, self.risk = float(feedback.expected_chance), float(feedback.risk)
        self._is_at_edge = len(feedback.edge) == 2
        self.done = float(feedback.done) if follows else float("nan")
        self.position_error, self.yaw_error = float(feedback.position_error), float(feedback.yaw_error)

    def __str__(self) -> str:
        if not np.isfinite(self.seen).all():
            return f"push {self.number}: its end was not reported, such as that of a push back to the middle"
        if np.isfinite(self.done):
            errors = f"{1e3 * self.position_error:.1f} mm and {np.degrees(self.yaw_error):.1f}° from the path"
            return f"push {self.number}: {errors}, {100 * self.done:.0f} % of it behind"
        now = "no pre-grasp pose is chosen yet"
        if np.isfinite(self.position_error):
            now = f"{1e3 * self.position_error:.1f} mm and {np.degrees(self.yaw_error):.1f}° from the goal"
        if self.expected is None:
            return f"push {self.number}: explores; {now}"
        off = self.seen - self.expected
        risk = f", {100 * self.risk:.1f} % of not being held" if self._is_at_edge else ""
        return (
            f"push {self.number}: {now}; predicted to {1e3 * float(np.hypot(off[0], off[1])):.1f} mm and "
            f"{np.degrees(abs(float(wrap_angle(off[2])))):.1f}°, {100 * self.chance:.0f} % chance of the goal{risk}"
        )

    def content(self) -> dict[str, Any]:
        """For JSON: lengths in metres, angles in radians."""
        return {
            "number": self.number,
            "seen": self.seen.tolist() if np.isfinite(self.seen).all() else None,
            "expected": None if self.expected is None else self.expected.tolist(),
            "chance": None if self.expected is None else self.chance,
            "risk": self.risk if self.expected is not None and self._is_at_edge else None,
            "position_error_m": self.position_error,
            "yaw_error_rad": self.yaw_error,
        }


class GoalReport:
    """What came of a goal, so far: it can be written at any time, also where something broke it off.

    `result`: of the action; until it ends, that of a goal that is broken off now. `start`, `target`: poses, table frame, shape (3,) [m, m,
    rad]; NaN where none was seen, or the node has not chosen it. `outline`: object frame, shape (n_vertices, 2) [m]; None where it was not
    received. `edge`: first and last point of the edge that it shall overhang, shape (2, 2) [m]; None away from edges. `overhang`, `margin`:
    beyond it, and expected distance of the centre of mass from the border of its support, as last observed [m]; NaN where not known.
    `effects`: diagnosed ones in the model of the object, with their values.
    """

    def __init__(self, goal: PushToGoal.Goal) -> None:
        self.goal, self.result = goal, broken_off()
        self.lines: list[PushLine] = []
        self.start = np.full(3, np.nan)
        self.outline: Float64Array | None = None
        self.target = planar(goal.goal.pose) if goal.kind == goal.KIND_POSE else np.full(3, np.nan)
        self.edge: Float64Array | None = None
        self.overhang = self.margin = float("nan")
        self.effects = ""

    def take(self, feedback: PushToGoal.Feedback) -> None:
        """Note what a feedback says, and print a push that is new in it."""
        if self.goal.kind == self.goal.KIND_EDGE and len(feedback.edge) == 2:
            self.target = planar(feedback.target)
            self.edge = np.array([[point.x, point.y] for point in feedback.edge])
            self.overhang, self.margin = float(feedback.overhang), float(feedback.margin)
        if self.goal.kind == self.goal.KIND_PATH:
            self.target = planar(feedback.target)
        if feedback.pushes > len(self.lines):
            self.count_up_to(int(feedback.pushes) - 1)
            self.lines.append(PushLine(feedback, follows=self.goal.kind == self.goal.KIND_PATH))
            say(str(self.lines[-1]))

    def count_up_to(self, n_pushes: int) -> None:
        """List every push up to this one, also those of which nothing was reported."""
        for number in range(len(self.lines) + 1, n_pushes + 1):
            self.lines.append(PushLine(unreported(number)))
            say(str(self.lines[-1]))

    @property
    def is_reached(self) -> bool:
        """Whether the object is at the goal."""
        return int(self.result.error_code) == 0

    def content(self) -> dict[str, Any]:
        """For JSON."""
        from push_ident.planning.goal import GoalCode

        result = self.result
        names = {code.value: code.name for code in GoalCode}
        return {
            "reached": self.is_reached,
            "code": names.get(int(result.error_code), str(result.error_code)),
            "text": printable(result.error_text),
            "object_id": printable(self.goal.object_id),
            **self._by_kind(),
            "goal": self.target.tolist() if np.isfinite(self.target).all() else None,
            "tolerance_m": float(self.goal.position_tolerance),
            "tolerance_rad": float(self.goal.yaw_tolerance),
            "start": self.start.tolist() if np.isfinite(self.start).all() else None,
            "outline": None if self.outline is None else self.outline.tolist(),
            "position_error_m": float(result.position_error),
            "yaw_error_rad": float(result.yaw_error),
            "chance": float(result.chance),
            "n_pushes": int(result.pushes),
            "time_s": float(result.elapsed),
            "effects": self.effects,
            "pushes": [line.content() for line in self.lines],
        }

    def _by_kind(self) -> dict[str, Any]:
        if self.goal.kind == self.goal.KIND_PATH:
            path, result = [planar(pose.pose).tolist() for pose in self.goal.path.poses], self.result
            errors = {"rms_position_m": float(result.rms_position), "rms_yaw_rad": float(result.rms_yaw)}
            known = {name: value if np.isfinite(value) else None for name, value in errors.items()}
            done = {"done": float(result.done) if np.isfinite(result.done) else 0.0, "n_corrections": int(result.corrections)}
            return {"kind": "path", "path": path, "speed_mps": float(self.goal.speed), **done, **known}
        if self.goal.kind != self.goal.KIND_EDGE:
            return {"kind": "pose"}
        return {
            "kind": "edge",
            "edge": None if self.edge is None else self.edge.tolist(),
            "wanted_overhang_m": float(self.goal.overhang),
            "wanted_margin_m": float(self.goal.held),
            "overhang_m": self.overhang,
            "margin_m": self.margin,
        }


class PathReport:
    """What came of goals in a row along a path: a report for each that was begun, of `n_goals`."""

    def __init__(self, reports: list[GoalReport], n_goals: int) -> None:
        self.reports, self.n_goals = reports, n_goals

    @property
    def is_reached(self) -> bool:
        """Whether the object was at each of them."""
        return len(self.reports) == self.n_goals and all(report.is_reached for report in self.reports)

    def content(self) -> dict[str, Any]:
        """For JSON: lengths in metres, angles in radians; root mean squares over the goals that were reached."""
        reached = [report.result for report in self.reports if report.is_reached]
        rms = np.sqrt(np.mean([(r.position_error**2, r.yaw_error**2) for r in reached], axis=0)) if reached else np.full(2, np.nan)
        return {
            "reached": self.is_reached,
            "n_goals": self.n_goals,
            "n_reached": len(reached),
            "n_pushes": sum(int(report.result.pushes) for report in self.reports),
            "rms_position_m": float(rms[0]) if reached else None,
            "rms_yaw_rad": float(rms[1]) if reached else None,
            "goals": [report.content() for report in self.reports],
        }


def last_feedback(result: PushToGoal.Result, latest: PushToGoal.Feedback, pose: Float64Array) -> PushToGoal.Feedback:
    """The feedback that belongs to a result: ROS drops feedback that arrives after the result, as that of the last push may do.

    `latest` was received last; its prediction is that of the push made last, or then under way. `pose`: of the object as it was seen last,
    shape (3,), table frame [m, m, rad].
    """
    from push_ident_msgs.action import PushToGoal

    is_lost = result.error_code in (PushToGoal.Result.OBJECT_LOST, PushToGoal.Result.FELL)
    is_seen = bool(np.isfinite(result.position_error)) and not is_lost
    last = PushToGoal.Feedback(
        pushes=result.pushes if is_seen else latest.pushes, position_error=result.position_error, yaw_error=result.yaw_error
    )
    last.done = result.done
    last.is_predicted, last.expected_chance, last.expected_pose = latest.is_predicted, latest.expected_chance, latest.expected_pose
    last.pose, last.target, last.edge = pose_message(pose), result.target, latest.edge
    last.overhang, last.margin, last.risk = result.overhang, result.margin, latest.risk
    return last


def unreported(number: int) -> PushToGoal.Feedback:
    """A feedback of a push of which none came."""
    from push_ident_msgs.action import PushToGoal

    nothing = PushToGoal.Feedback(pushes=number, position_error=float("nan"), yaw_error=float("nan"))
    nothing.pose.position.x = float("nan")
    return nothing


def broken_off(latest: PushToGoal.Feedback | None = None) -> PushToGoal.Result:
    """The result of a goal whose own result does not come any more, as of the latest feedback."""
    from push_ident_msgs.action import PushToGoal

    text = "broken off before it ended: the arm holds, and what was learned is kept. A push under way then is not listed."
    result = PushToGoal.Result(error_code=PushToGoal.Result.CANCELED, error_text=text, position_error=float("nan"), yaw_error=float("nan"))
    if latest is not None:
        result.position_error, result.yaw_error = latest.position_error, latest.yaw_error
        result.pushes, result.elapsed = latest.pushes, latest.elapsed
        result.done = latest.done
    return result
