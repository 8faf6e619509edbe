"""Between goals and their messages, and what is drawn of a goal."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose

from push_ident.errors import InputError
from push_ident.geometry.se2 import quaternion_of_yaw, transform_points
from push_ident.limits import LIMITS, check_coordinates, plain_text
from push_ident.nodes.convert.markers import MARKERS, GoalDrawing
from push_ident.nodes.convert.messages import TABLE_FRAME, planar_pose_of
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal import Goal, Target
from push_ident.planning.goal_ports import GoalOutcome, GoalProgress, GoalRequest, GoalState
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_steps import PathStep
from push_ident.planning.planner import GoalPush
from push_ident.pushing.push import PushPlan2D
from push_ident.types import Float64Array
from push_ident_msgs.action import PushToGoal


def request_from_msg(msg: PushToGoal.Goal, defaults: dict[str, Any]) -> GoalRequest:
    """The goal of a request; `defaults` are the parameters that a zero stands for.

    Raises InputError: another frame, another kind, a pose tilted against the table, an edge that is none, or numbers out of range.
    """
    frame = msg.goal.header.frame_id
    if frame not in ("", TABLE_FRAME):
        raise InputError(f"The goal is in frame {plain_text(frame)!r}, expected {TABLE_FRAME!r}; transform it first.")
    LIMITS.STRING.check(len(msg.object_id), "object_id")
    position, turn = msg.goal.pose.position, msg.goal.pose.orientation
    if not all(map(math.isfinite, (position.x, position.y, turn.x, turn.y, turn.z, turn.w))):
        raise InputError("The goal has coordinates that are not finite; give x and y in metres and a quaternion about z.")
    makers: dict[int, Callable[[PushToGoal.Goal, dict[str, Any]], Goal | EdgeGoal | PathGoal]] = {
        PushToGoal.Goal.KIND_POSE: _pose_goal,
        PushToGoal.Goal.KIND_EDGE: _edge_goal,
        PushToGoal.Goal.KIND_PATH: _path_goal,
    }
    if msg.kind not in makers:
        raise InputError(f"The kind of the goal is {msg.kind}, expected KIND_POSE (0), KIND_EDGE (1) or KIND_PATH (2).")
    goal = makers[msg.kind](msg, defaults)
    return GoalRequest(
        object_id=msg.object_id,
        goal=goal,
        time_limit=float(msg.time_limit) or defaults["time_limit"],
        max_pushes=int(msg.max_pushes) or defaults["max_pushes"],
        explore=int(msg.explore),
    )


def _pose_goal(msg: PushToGoal.Goal, defaults: dict[str, Any]) -> Goal:
    return Goal(
        planar_pose_of(msg.goal.pose),
        float(msg.position_tolerance) or defaults["position_tolerance"],
        float(msg.yaw_tolerance) or defaults["yaw_tolerance"],
    )


def _edge_goal(msg: PushToGoal.Goal, defaults: dict[str, Any]) -> EdgeGoal:
    return EdgeGoal(
        _edge_of(msg.edge),
        float(msg.overhang) or defaults["edge_overhang"],
        float(msg.held) or defaults["edge_held"],
        float(planar_pose_of(msg.goal.pose)[2]) if msg.use_heading else None,
        float(msg.position_tolerance) or defaults["position_tolerance"],
        float(msg.yaw_tolerance) or defaults["edge_yaw_tolerance"],
        defaults["edge_risk"],
    )


def _path_goal(msg: PushToGoal.Goal, defaults: dict[str, Any]) -> PathGoal:
    frame = msg.path.header.frame_id
    if frame not in ("", TABLE_FRAME):
        raise InputError(f"The path is in frame {plain_text(frame)!r}, expected {TABLE_FRAME!r}; transform it first.")
    LIMITS.POINTS.check(len(msg.path.poses), "path")
    poses = [planar_pose_of(pose.pose) for pose in msg.path.poses]
    return PathGoal(
        np.array(poses).reshape(-1, 3),
        float(msg.speed) or defaults["path_speed"],
        float(msg.position_tolerance) or defaults["path_position_tolerance"],
        float(msg.yaw_tolerance) or defaults["path_yaw_tolerance"],
    )


def _edge_of(points: Sequence[Point]) -> TableEdge | None:
    if not points:
        return None
    if len(points) != 2:
        raise InputError(f"The edge has {len(points)} point, expected two in `table`, or none for the nearest edge that is known.")
    first, second = (np.array([point.x, point.y]) for point in points)
    check_coordinates([first, second], "Edge of the table")
    return TableEdge.between(first, second)


def edge_points(target: Target | None) -> list[Point]:
    """The edge that an object overhangs at its target, as in the goal of the action; empty where there is none."""
    if target is None or target.hold is None:
        return []
    return [Point(x=float(x), y=float(y), z=0.0) for x, y in target.hold.edge.ends]


def planar_pose_msg(pose: Float64Array) -> Pose:
    """A pose (x, y, yaw) [m, m, rad]; NaN throughout where it is not known."""
    msg = Pose()
    msg.position.x, msg.position.y = float(pose[0]), float(pose[1])
    turn = [math.nan] * 4 if math.isnan(pose[2]) else quaternion_of_yaw(pose[2])
    msg.orientation.x, msg.orientation.y, msg.orientation.z, msg.orientation.w = map(float, turn)
    return msg


def feedback_to_msg(progress: GoalProgress) -> PushToGoal.Feedback:
    """What the client sees of the progress."""
    msg = PushToGoal.Feedback(state=int(progress.state), pushes=int(progress.observed), elapsed=float(progress.elapsed))
    msg.position_error, msg.yaw_error = (float(value) for value in progress.error)
    msg.pose, msg.target, msg.edge = planar_pose_msg(progress.pose), _target_msg(progress), edge_points(progress.target)
    msg.done = float(progress.done)
    msg.overhang, msg.margin = float(progress.overhang), float(progress.margin)
    plan = progress.plan
    if plan is not None:
        msg.is_predicted, msg.expected_chance, msg.expected_pose = True, float(plan.chance), planar_pose_msg(plan.end)
        msg.risk = float(plan.risk)
    return msg


def result_to_msg(outcome: GoalOutcome) -> PushToGoal.Result:
    """How a goal ended."""
    progress = outcome.progress
    msg = PushToGoal.Result(error_code=int(outcome.code), error_text=plain_text(outcome.text))
    msg.position_error, msg.yaw_error = (float(value) for value in progress.error)
    msg.done, msg.corrections = float(progress.done), int(progress.corrections)
    msg.rms_position, msg.rms_yaw = (float(value) for value in progress.rms)
    msg.target, msg.overhang, msg.margin = _target_msg(progress), float(progress.overhang), float(progress.margin)
    msg.chance, msg.pushes, msg.elapsed = float(progress.chance), int(progress.pushes), float(progress.elapsed)
    return msg


def _target_msg(progress: GoalProgress) -> Pose:
    return planar_pose_msg(np.full(3, np.nan) if progress.target is None else progress.target.goal.pose)


def draw_goal(progress: GoalProgress, outline: Float64Array) -> GoalDrawing | None:
    """What is shown of a goal; None before it is known where the object shall be.

    Args:
        outline: of the object in its frame [m], shape (n_vertices, 2).
    """
    target, path = progress.target, progress.path
    if target is None:
        return None
    at_goal, number = transform_points(target.goal.pose, outline), progress.pushes + 1
    is_pushing = progress.state is GoalState.PUSH
    if path is not None:
        done = np.linspace(0.0, path.length, min(len(path.poses), MARKERS.n_path_points))
        drawing = GoalDrawing(progress.object_id, at_goal, _path_text(path), path=path.at(done)[:, :2])
        step = progress.step
        return drawing if step is None or not is_pushing else _with_step(drawing, outline, path, step, progress.tool, number)
    edge = None if target.hold is None else target.hold.edge.ends
    drawing = GoalDrawing(progress.object_id, at_goal, _goal_text(target, at_goal), edge=edge)
    plan = progress.plan
    return drawing if plan is None or not is_pushing else _with_push(drawing, outline, target, plan, number)


def _goal_text(target: Target, at_goal: Float64Array) -> str:
    goal = target.goal
    words = f"goal: within {1e3 * goal.position:.0f} mm and {np.degrees(goal.yaw):.1f}°"
    if target.hold is None:
        return words
    return f"{words}, {1e3 * target.overhang(at_goal):.0f} mm over the edge, held by {1e3 * target.margin(goal.pose):.0f} mm"


def _path_text(path: PathGoal) -> str:
    tolerance = f"one tolerance is {1e3 * path.position:.0f} mm and {np.degrees(path.yaw):.1f}°"
    return f"path: {1e3 * path.length:.0f} mm at {1e3 * path.speed:.0f} mm/s, {tolerance}"


def _with_push(drawing: GoalDrawing, outline: Float64Array, target: Target, plan: GoalPush, number: int) -> GoalDrawing:
    """Also push `number` to a pose, counted from 1."""
    if plan.plan is None:
        return drawing
    chance = f"push {number}: {100 * plan.chance:.0f} % chance of the goal"
    if target.hold is not None:
        chance += f", {100 * plan.risk:.1f} % of being held by less than {1e3 * target.hold.margin:.0f} mm"
    tool = _straight(plan.plan) if plan.path is None else plan.path.position
    return replace(drawing, tool=tool, end=transform_points(plan.end, outline), chance=chance)


def _with_step(
    drawing: GoalDrawing, outline: Float64Array, path: PathGoal, step: PathStep, corrected: Float64Array | None, number: int
) -> GoalDrawing:
    """Also push `number` along a path, with the tool as it was corrected last."""
    if step.contact is None:
        return drawing
    end = transform_points(path.at(step.expected_done), outline)
    chance = f"push {number}: expected to {100 * step.expected_done / path.length:.0f} % of the path"
    steered = step.steered
    if steered is None or steered.tool is None or steered.corridor is None:
        return replace(drawing, tool=_straight(step.contact), end=end, chance=chance)
    tool = steered.tool if corrected is None else corrected
    return replace(drawing, tool=tool, end=end, chance=chance, corridor=steered.corridor.outline())


def _straight(push: PushPlan2D) -> Float64Array:
    return np.array([push.tool_at_contact, push.tool_end])
