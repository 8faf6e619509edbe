"""Parameters of push_executor_node, and the settings made of them."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Final, TypeVar

from push_ident.errors import InputError
from push_ident.nodes.base.frames import PUBLISH_TF
from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.push_executor.hand_port import HAND_KINDS
from push_ident.pushing.motion import MotionSettings
from push_ident.pushing.push import PushSettings
from push_ident.pushing.push_request import FOLLOW, PIECES, ExecutionSettings, WatchLimits

T = TypeVar("T")

_OTHER_NAMES: Final = {
    "distance_range": "random_distance",
    "speed_range": "random_speed",
    "cone": "random_cone",
    "max_distance": "max_push_distance",
    "max_speed": "max_push_speed",
}
"""Fields of PushSettings whose parameter has another name."""
_NEUTRAL: Final = [0.0, 1.0, 0.0, -1.92, 0.0, 0.22, 0.0]
_HOME: Final = [1.4, *_NEUTRAL[1:]]

PARAMETERS: Final = (
    Parameter(
        "robot_description_file", "", "URDF of the arm, root link `table`; empty: taken from the topic robot_description", read_only=True
    ),
    Parameter("tip_frame", "tool_tip", "link at the bottom centre of the pusher, z down the tool", read_only=True),
    Parameter(
        "neutral_posture",
        _NEUTRAL,
        "posture that the arm's free axes drift to [rad], one per joint",
        -6.3,
        6.3,
        read_only=True,
        any_length=True,
    ),
    Parameter("home_posture", _HOME, "posture between pushes, out of the camera's view [rad], one per joint", -6.3, 6.3, any_length=True),
    Parameter(
        "pusher_radius",
        0.018,
        "radius of the cylinder that pushes, or of each finger, or half the thickness of a plate [m]",
        0.001,
        0.1,
        read_only=True,
    ),
    Parameter(
        "finger_distance",
        0.0,
        "between the axes of two round fingers that push, along the y axis of tip_frame [m]; 0: a tool in one piece",
        0.0,
        0.3,
        read_only=True,
    ),
    Parameter(
        "plate_length",
        0.0,
        "between the middles of the round ends of a plate that pushes, along that axis [m]; 0: none",
        0.0,
        0.3,
        read_only=True,
    ),
    Parameter("pusher_height", 0.080, "height of the cylinder that pushes [m]", 0.001, 0.5, read_only=True),
    Parameter("workspace", [-0.20, 0.20, -0.25, 0.25], "x_min, x_max, y_min, y_max of the lowered tool in `table` [m]", -2.0, 2.0),
    Parameter("push_distance", 0.06, "travel after contact where a goal gives 0 [m]", 0.001, 0.5),
    Parameter("push_speed", 0.15, "speed where a goal gives 0 [m/s]", 0.001, 1.0),
    Parameter("max_push_distance", 0.25, "longest travel after contact that a goal may ask for [m]", 0.001, 1.0),
    Parameter("max_push_speed", 0.25, "highest speed that a goal may ask for [m/s]", 0.001, 1.0),
    Parameter("random_distance", [0.04, 0.10], "range of the travel of random pushes [m]", 0.001, 1.0),
    Parameter("random_speed", [0.1, 0.2], "range of the speed of random pushes [m/s]", 0.001, 1.0),
    Parameter("random_cone", 0.785, "largest angle between a random push and the inward normal [rad]", 0.0, 1.3),
    Parameter("clearance", 0.03, "travel of the pusher before it touches [m]", 0.005, 0.2),
    Parameter("lowering_gap", 0.005, "least gap to any object where the tool comes down [m]", 0.001, 0.1),
    Parameter("recentre", True, "before a random push, or one given in the object frame, push an object near the edge to the middle"),
    Parameter("edge_margin", 0.03, "an outline nearer to the edge of the workspace than this is near the edge [m]", 0.0, 0.5),
    Parameter("push_height", 0.012, "tip above the table while pushing [m]", 0.002, 0.3),
    Parameter("min_height", 0.006, "lowest the tip is ever commanded [m]", 0.001, 0.3),
    Parameter("safe_height", 0.12, "tip height where free moves start and end [m]", 0.02, 1.0),
    Parameter("free_height", 0.09, "lowest the tip may dip in a free move, above every object [m]", 0.02, 1.0),
    Parameter("link_height", 0.10, "lowest that any moving joint of the arm may come, as the elbow [m]", 0.0, 1.0),
    Parameter("free_speed", 0.25, "tool speed going up and down [m/s]", 0.01, 1.0),
    Parameter("acceleration", 2.0, "tool acceleration on straight lines [m/s^2]", 0.1, 10.0),
    Parameter("max_joint_velocity", 1.3, "cap on every joint's velocity [rad/s]", 0.01, 5.0),
    Parameter(
        "joint_acceleration_limits",
        [10.0],
        "largest acceleration on the whole path, one per joint or one for all, as max_acceleration in joint_limits.yaml [rad/s^2]",
        0.1,
        200.0,
        any_length=True,
    ),
    Parameter("max_joint_acceleration", 5.0, "cap on every joint's acceleration on all moves but the push [rad/s^2]", 0.1, 50.0),
    Parameter("settle", 0.3, "pause with the tool lowered before the push [s]", 0.0, 10.0),
    Parameter("rest", 0.6, "pause after the push, for frames of the object at rest [s]", 0.0, 10.0),
    Parameter("back_off", 0.015, "distance back from the object before the tool rises [m]", 0.002, 0.1),
    Parameter("arm_timeout", 0.1, "the arm is held this long after the last joint state, by wall time, at the latest [s]", 0.05, 2.0),
    Parameter("motion_horizon", 0.08, "motion at speed that the arm is given ahead; without news it brakes then [s]", 0.04, 0.1),
    Parameter(
        "stamp_commands",
        False,
        "commands say when they start, for arms whose controller and joint_states have one clock, as in ros2_control; else on receipt",
    ),
    Parameter(
        "free_motions",
        PIECES,
        "motions above free_height. pieces: as the push; follow_joint_trajectory: each as one goal of the arm's controller, which goes on "
        "with it where this node ends",
        choices=(PIECES, FOLLOW),
        read_only=True,
    ),
    Parameter("path_tolerance", 0.0, "of such a goal, of each joint on its way [rad]; 0: the controller's own", 0.0, 1.0, read_only=True),
    Parameter("goal_tolerance", 0.0, "the same at its end [rad]; 0: the controller's own", 0.0, 0.1, read_only=True),
    Parameter("pose_timeout", 1.0, "oldest object pose, by time of receipt, that a push may start from [s]", 0.05, 60.0),
    Parameter("lost_timeout", 3.0, "longest time without a pose of the object during a push; the arm may hide it [s]", 0.05, 60.0),
    Parameter("force_limit", 60.0, "largest horizontal force on pusher/wrench; beyond, the arm is held [N]", 0.5, 1000.0),
    Parameter("client_timeout", 1.0, "longest silence of a client that says that it lives; then its push is canceled [s]", 0.3, 10.0),
    Parameter("wrench_timeout", 0.5, "longest silence of pusher/wrench during a motion, where it spoke at the start [s]", 0.02, 10.0),
    Parameter(
        "hand",
        "none",
        "none: fixed tool; robotiq_3f: pushes only with its fist closed; simulated: the same with messages of push_ident_msgs; "
        "gripper_action: pushes only with a gripper closed that has an action of control_msgs",
        choices=HAND_KINDS,
        read_only=True,
    ),
    Parameter(
        "hand_action",
        "/robotiq_gripper_controller/gripper_cmd",
        "of gripper_action: action of the gripper, GripperCommand or ParallelGripperCommand",
        read_only=True,
    ),
    Parameter(
        "hand_position",
        0.8,
        "of gripper_action: position that closes it, of its joint [rad], or [m] of a sliding one; 0.8 rad: a Robotiq 2F-85",
        -10.0,
        10.0,
        read_only=True,
    ),
    Parameter(
        "hand_effort",
        50.0,
        "of gripper_action: largest effort of closing [N], or [N m] as its controller has it; 50: that of the URDF of a Robotiq 2F-85",
        0.0,
        1000.0,
        read_only=True,
    ),
    Parameter(
        "hand_joint",
        "",
        "of gripper_action: joint in joint_states that must stay where it closed; empty: none",
        read_only=True,
    ),
    Parameter(
        "hand_drift",
        0.02,
        "of gripper_action: how far hand_joint may move from where it closed [rad] or [m]; 0.02 rad: 2 mm between the fingers of a 2F-85",
        0.0,
        1.0,
        read_only=True,
    ),
    Parameter("hand_timeout", 0.5, "longest silence of the hand's driver [s]", 0.05, 10.0, read_only=True),
    Parameter("hand_close_timeout", 15.0, "longest time the hand may take to activate and close [s]", 0.5, 60.0),
    Parameter("start_tolerance", 0.02, "largest joint distance between arm and start of the plan [rad]", 0.001, 0.2),
    Parameter("tracking_tolerance", 0.010, "largest distance of the tool from its planned path [m]", 0.001, 0.1),
    Parameter("tracking_lag", 0.2, "largest delay of the arm behind the plan [s]", 0.0, 1.0),
    Parameter("min_object_shift", 0.002, "smaller shifts of the object count as no contact [m]", 0.0, 0.1),
    Parameter("min_object_turn", 0.0175, "smaller turns of the object count as no contact [rad]", 0.0, 1.0),
    PUBLISH_TF,
)


def execution_settings(values: dict[str, Any]) -> ExecutionSettings:
    """The settings that parameters give: fields have the names of parameters; raises InputError when the values contradict each other."""
    home, neutral = values["home_posture"], values["neutral_posture"]
    if len(home) != len(neutral):
        raise InputError(f"home_posture has {len(home)} joints and neutral_posture {len(neutral)}; give one angle per joint in both.")
    push = _chosen(PushSettings, {**values, **{name: values[parameter] for name, parameter in _OTHER_NAMES.items()}})
    motion = _chosen(MotionSettings, {**values, "home": values["home_posture"]})
    return ExecutionSettings(push=push, motion=motion, limits=_chosen(WatchLimits, values), **_arguments(ExecutionSettings, values))


def _chosen(kind: type[T], values: dict[str, Any]) -> T:
    return kind(**_arguments(kind, values))


def _arguments(kind: type[Any], values: dict[str, Any]) -> dict[str, Any]:
    names = {field.name for field in fields(kind)} & values.keys()
    return {name: tuple(value) if isinstance(value := values[name], list) else value for name in names}
