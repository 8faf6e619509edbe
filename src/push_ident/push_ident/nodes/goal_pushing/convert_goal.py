"""Between goals and their messages."""

from __future__ import annotations

import math
from typing import Any

from geometry_msgs.msg import Pose

from push_ident.errors import InputError
from push_ident.geometry.se2 import quaternion_of_yaw
from push_ident.limits import LIMITS, plain_text
from push_ident.nodes.convert import TABLE_FRAME, planar_pose_of
from push_ident.planning.goal import Goal
from push_ident.planning.goal_ports import GoalOutcome, GoalProgress, GoalRequest
from push_ident.types import Float64Array
from push_ident_msgs.action import PushToGoal

__all__ = ["feedback_to_msg", "planar_pose_msg", "request_from_msg", "result_to_msg"]


def request_from_msg(msg: PushToGoal.Goal, defaults: dict[str, Any]) -> GoalRequest:
    """The goal of a request; `defaults` are the parameters that a zero stands for.

    Raises:
        InputError: another frame, a pose tilted against the table, or numbers out of range.
    """
    frame = msg.goal.header.frame_id
    if frame not in ("", TABLE_FRAME):
        raise InputError(f"The goal is in frame {plain_text(frame)!r}, expected {TABLE_FRAME!r}; transform it first.")
    LIMITS.STRING.check(len(msg.object_id), "object_id")
    position, turn = msg.goal.pose.position, msg.goal.pose.orientation
    if not all(map(math.isfinite, (position.x, position.y, turn.x, turn.y, turn.z, turn.w))):
        raise InputError("The goal has coordinates that are not finite; give x and y in metres and a quaternion about z.")
    goal = Goal(
        planar_pose_of(msg.goal.pose),
        float(msg.position_tolerance) or defaults["position_tolerance"],
        float(msg.yaw_tolerance) or defaults["yaw_tolerance"],
    )
    return GoalRequest(
        object_id=msg.object_id,
        goal=goal,
        time_limit=float(msg.time_limit) or defaults["time_limit"],
        max_pushes=int(msg.max_pushes) or defaults["max_pushes"],
        explore=int(msg.explore),
    )


def planar_pose_msg(pose: Float64Array) -> Pose:
    """A pose (x, y, yaw) [m, m, rad]; NaN throughout where it is not known."""
    msg = Pose()
    msg.position.x, msg.position.y = float(pose[0]), float(pose[1])
    turn = [math.nan] * 4 if math.isnan(pose[2]) else quaternion_of_yaw(pose[2])
    msg.orientation.x, msg.orientation.y, msg.orientation.z, msg.orientation.w = (float(value) for value in turn)
    return msg


def feedback_to_msg(progress: GoalProgress) -> PushToGoal.Feedback:
    """What the client sees of the progress."""
    msg = PushToGoal.Feedback(state=int(progress.state), pushes=int(progress.observed), elapsed=float(progress.elapsed))
    msg.position_error, msg.yaw_error = (float(value) for value in progress.error)
    msg.pose = planar_pose_msg(progress.pose)
    plan = progress.plan
    if plan is not None:
        msg.is_predicted, msg.expected_chance, msg.expected_pose = True, float(plan.chance), planar_pose_msg(plan.end)
    return msg


def result_to_msg(outcome: GoalOutcome) -> PushToGoal.Result:
    """How a goal ended."""
    progress = outcome.progress
    msg = PushToGoal.Result(error_code=int(outcome.code), error_text=plain_text(outcome.text))
    msg.position_error, msg.yaw_error = (float(value) for value in progress.error)
    msg.chance, msg.pushes, msg.elapsed = float(progress.chance), int(progress.pushes), float(progress.elapsed)
    return msg
