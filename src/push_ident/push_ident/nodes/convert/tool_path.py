"""Between paths of the tool, pushes along them and their corrections, and the messages."""

from __future__ import annotations

from array import array

import numpy as np
from geometry_msgs.msg import Point

from push_ident.errors import InputError
from push_ident.limits import check_coordinates, plain_text
from push_ident.nodes.convert.messages import TABLE_FRAME, stamp_from_msg, stamp_to_msg
from push_ident.pushing.steering import PathRequest, ToolCorrection, path_from_start
from push_ident.pushing.tool_path import Corridor, ToolPath
from push_ident.types import Float64Array
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushCorrection
from push_ident_msgs.msg import ToolPath as ToolPathMsg


def path_goal(object_id: str, request: PathRequest) -> ExecutePush.Goal:
    """The goal of the action for a push along a path."""
    goal = turning_goal(object_id, request.path)
    goal.corridor = [Point(x=float(x), y=float(y), z=0.0) for x, y in request.corridor.line]
    goal.corridor_half_width, goal.correction_timeout = float(request.corridor.half_width), float(request.correction_timeout)
    return goal


def turning_goal(object_id: str, path: ToolPath) -> ExecutePush.Goal:
    """The goal of the action for a push along a path that is not corrected, as that of a tool that turns."""
    goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_PATH, object_id=object_id, frame_id=TABLE_FRAME)
    goal.tool_path = _path_to_msg(path.time, path.position)
    if path.yaw is not None:
        goal.tool_path.yaw = array("d", path.yaw)
    return goal


def path_request_from_goal(goal: ExecutePush.Goal) -> PathRequest | ToolPath:
    """The push along a path that a goal requests; of a tool that turns, which is not corrected, the path alone.

    Raises InputError: another frame, no path, no corridor around it, corrections of a tool that turns, or numbers out of range.
    """
    if goal.frame_id not in ("", TABLE_FRAME):
        raise InputError(f"frame_id is {plain_text(goal.frame_id)!r}, expected {TABLE_FRAME!r} for a push along a path.")
    time, position = _path_from_msg(goal.tool_path, "tool_path")
    if len(goal.tool_path.yaw):
        if goal.correction_timeout != 0.0:
            raise InputError(
                f"correction_timeout is {goal.correction_timeout} s, expected 0 for a tool that turns: a path with yaws is not corrected."
            )
        return path_from_start(ToolPath(time, position, np.array(goal.tool_path.yaw, dtype=np.float64)))
    line = np.array([[point.x, point.y] for point in goal.corridor]).reshape(-1, 2)
    check_coordinates(line.ravel(), "corridor")
    corridor = Corridor(line, float(goal.corridor_half_width))
    return PathRequest(ToolPath(time, position), corridor, float(goal.correction_timeout))


def correction_to_msg(correction: ToolCorrection) -> PushCorrection:
    """The message of a correction."""
    msg = PushCorrection(push_id=int(correction.push_id), stop=bool(correction.stop))
    msg.header.frame_id, msg.header.stamp = TABLE_FRAME, stamp_to_msg(max(correction.stamp, 0.0))
    msg.tool_path = _path_to_msg(correction.time, correction.position)
    return msg


def correction_from_msg(msg: PushCorrection) -> ToolCorrection:
    """A correction, whose numbers are still to be checked.

    Raises InputError: another frame, a stamp that cannot be, or times without places.
    """
    if msg.header.frame_id not in ("", TABLE_FRAME):
        raise InputError(f"The correction is in frame {plain_text(msg.header.frame_id)!r}, expected {TABLE_FRAME!r}.")
    time, position = _path_from_msg(msg.tool_path, "tool_path")
    return ToolCorrection(int(msg.push_id), stamp_from_msg(msg.header.stamp), bool(msg.stop), time, position)


def _path_to_msg(time: Float64Array, position: Float64Array) -> ToolPathMsg:
    x, y = position.T
    return ToolPathMsg(time=array("d", time), x=array("d", x), y=array("d", y))


def _path_from_msg(msg: ToolPathMsg, what: str) -> tuple[Float64Array, Float64Array]:
    n = {len(msg.time), len(msg.x), len(msg.y)}
    if len(n) > 1:
        raise InputError(f"{what} has {len(msg.time)} times, {len(msg.x)} x and {len(msg.y)} y, expected as many of each.")
    return np.array(msg.time, dtype=np.float64), np.column_stack([msg.x, msg.y]).astype(np.float64).reshape(-1, 2)
