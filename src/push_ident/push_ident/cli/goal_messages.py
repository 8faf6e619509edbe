"""Goals of the command line as those of the action PushToGoal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from push_ident.geometry.se2 import quaternion_of_yaw, yaw_of_quaternion
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
