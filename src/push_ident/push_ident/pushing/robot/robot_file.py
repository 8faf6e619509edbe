"""A robot as one file (YAML): where its description is, how it stands, its joints, tool, camera and topics."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from push_ident.errors import InputError
from push_ident.files import read_regular
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.limits import plain_text
from push_ident.pushing.motion import MotionSettings
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
"""x, y, z [m], or roll, pitch, yaw [rad] as a URDF has them."""
Angles = Annotated[list[float], Field(min_length=1, max_length=100)]
"""One number for each joint."""
_EXECUTOR: Final = "push_executor_node"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Description(_Part):
    """The URDF of the arm."""

    file: str
    """Path: absolute, relative to the robot file, or relative to `package`."""
    package: str = ""
    """Package that has the file: of Python, or of ROS 2 in its share folder."""
    root: str
    """Root link of the URDF, which `base` places; `table` where the description places the arm itself."""


class Base(_Part):
    """Pose of the root link in `table`."""

    position: Vector
    """[m]"""
    rpy: Vector = [0.0, 0.0, 0.0]
    """[rad]"""


class Joints(_Part):
    """The joints between base and tool, in the order of their chain."""

    names: Annotated[list[str], Field(min_length=1, max_length=100)]
    neutral: Angles
    """Posture over the workspace with the tool down, from which others are found [rad]."""
    home: Angles
    """Posture between pushes, out of the view of the camera [rad]."""
    lower: Angles | None = None
    """Limits within those of the URDF [rad]; default: those of the URDF."""
    upper: Angles | None = None
    velocity: Angles | None = None
    """Limits within those of the URDF [rad/s]; default: those of the URDF."""
    acceleration: Angles
    """Limits, one per joint or one for all [rad/s^2]. A URDF has none."""


class Tool(_Part):
    """What pushes: an upright cylinder, two round fingers or a plate, and the hand or adapter that holds it."""

    link: str
    """Link of the URDF that carries the tool, such as the flange."""
    tip_position: Vector
    """Bottom centre of the cylinder in that link, or the middle between both fingers or ends of the plate [m]."""
    tip_rpy: Vector = [0.0, 0.0, 0.0]
    """Turn of the tip: its z axis points down the tool, and both fingers, or ends of the plate, are on its y axis [rad]."""
    pusher_radius: Annotated[float, Field(gt=0.0)]
    """Of the cylinder or of each finger, or half the thickness of the plate [m]."""
    finger_distance: Annotated[float, Field(ge=0.0)] = 0.0
    """Between the axes of two fingers, of an opened gripper for instance [m]; 0: a tool in one piece."""
    plate_length: Annotated[float, Field(ge=0.0)] = 0.0
    """Between the middles of the round ends of a plate [m]; 0: no plate."""
    pusher_height: Annotated[float, Field(gt=0.0)]
    """[m]"""
    hand: Literal["none", "robotiq_3f", "gripper_action"] = "none"
    """A hand that must be closed, or at the position at which its fingers are `finger_distance` apart; `none`: a fixed tool."""
    hand_radius: Annotated[float, Field(gt=0.0)]
    """Of all that is above what pushes, up to the arm [m]."""
    hand_length: Annotated[float, Field(ge=0.0)] = 0.0
    """Of the cylinder that stands for the hand; 0 where the URDF has the hand [m]."""


class Camera(_Part):
    """A depth camera that stands still."""

    frame: str = "camera_depth_optical_frame"
    """`frame_id` of its images: z forward, x right, y down."""
    position: Vector
    """Of that frame in `table` [m]."""
    quaternion: Annotated[list[float], Field(min_length=4, max_length=4)]
    """Its orientation in `table`, x y z w."""
    field_of_view: Annotated[list[Annotated[float, Field(gt=0.0, lt=3.1)]], Field(min_length=2, max_length=2)]
    """Of the depth image, horizontal and vertical [rad]."""
    sensor: str = "plain"
    """Model of it in the simulated cell."""


class RobotFile(_Part):
    """Content of a robot file. Lengths in metres, angles in radians, times in seconds."""

    name: str
    description: Description
    base: Base | None = None
    joints: Joints
    tool: Tool
    camera: Camera
    topics: dict[str, str] = {}
    """Names of the topics of the arm's driver and of the camera, by their names in the bag contract."""
    workspace: Annotated[list[Annotated[float, Field(ge=-2.0, le=2.0)]], Field(min_length=4, max_length=4)]
    """x_min, x_max, y_min, y_max of the lowered tool in `table` [m]."""
    push_height: Annotated[float, Field(gt=0.0)]
    """Of the tip above the table while it pushes [m]."""
    parameters: dict[str, dict[str, Any]] = {}
    """Further parameters, by node."""


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot file that was read."""

    path: Path
    file: RobotFile

    @property
    def camera_in_table(self) -> Float64Array:
        """Pose of the optical frame, shape (4, 4)."""
        return pose_of_quaternion(self.file.camera.position, self.file.camera.quaternion)


def read_robot(path: Path) -> Robot:
    """Read a robot file.

    Raises InputError: it cannot be read, a key is missing, unknown or of a wrong kind, lists of the joints differ in length, or heights and
    workspace contradict each other. Whether it fits its URDF is found by `check_robot`.
    """
    try:
        content: Any = yaml.safe_load(read_regular(path))
    except (OSError, yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        reason = plain_text(" ".join(str(error).split()))[:150]
        raise InputError(f"{path}: cannot be read ({reason}); expected a robot file (YAML).") from None
    try:
        file = RobotFile.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path}: {_first(error)}") from None
    robot = Robot(path, file)
    try:
        _check_lengths(file.joints)
        _check_hand(file.tool)
        motion_settings(robot)
        push_settings(robot)
        _ = robot.camera_in_table
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return robot


def motion_settings(robot: Robot) -> MotionSettings:
    """Heights, speeds and limits of the arm's motions, as push_executor_node has them."""
    file = robot.file
    values = dict(home=file.joints.home, push_height=file.push_height, joint_acceleration_limits=file.joints.acceleration)
    return MotionSettings(**_chosen(MotionSettings, file, values))


def push_settings(robot: Robot) -> PushSettings:
    """Limits of pushes, as push_executor_node has them."""
    file = robot.file
    tool = {name: getattr(file.tool, name) for name in ("pusher_radius", "finger_distance", "plate_length")}
    return PushSettings(**_chosen(PushSettings, file, {"workspace": file.workspace, **tool}))


def _chosen(kind: type[Any], file: RobotFile, stated: dict[str, Any]) -> dict[str, Any]:
    """Values of the fields of a dataclass: those of the file, and those among its further parameters of the executor."""
    names = {field.name for field in fields(kind)}
    values = {name: value for name, value in file.parameters.get(_EXECUTOR, {}).items() if name in names} | stated
    for name, value in values.items():
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, bool) or not isinstance(number, int | float):
                raise InputError(f"parameters.{_EXECUTOR}.{name} is {plain_text(repr(value))}, expected numbers.")
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def _check_hand(tool: Tool) -> None:
    if tool.hand == "robotiq_3f" and (tool.finger_distance or tool.plate_length):
        raise InputError(
            "tool.hand is robotiq_3f, which pushes with its fist only, and tool has two contacts, expected a hand with two fingers; give "
            "gripper_action with the hand_position at which they are apart, or take finger_distance and plate_length out."
        )


def _check_lengths(joints: Joints) -> None:
    n = len(joints.names)
    for name in ("neutral", "home", "lower", "upper", "velocity", "acceleration"):
        values = getattr(joints, name)
        if values is not None and len(values) != n and not (name == "acceleration" and len(values) == 1):
            raise InputError(f"joints.{name} has {len(values)} numbers, expected {n}, one for each of joints.names.")
    if len(set(joints.names)) < n:
        raise InputError("joints.names has a name twice, expected each joint once.")


def _first(error: ValidationError) -> str:
    fault = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in fault["loc"]) or "the file"
    if fault["type"] == "extra_forbidden":
        return f"{plain_text(where)} is no key of a robot file; correct its name or take it out."
    if fault["type"] == "missing":
        return f"{where} is missing; add it."
    return f"{plain_text(where)} is {plain_text(repr(fault['input']))[:80]}: {fault['msg'][:1].lower()}{fault['msg'][1:]}; correct it."
