"""Motion of the arm for one push, and its retreat from an aborted push; the whole motion is checked before the arm moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.kinematics import TOOL_DOWN, ArmKinematics
from push_ident.geometry.se2 import transform_points
from push_ident.pushing.arm_motion import ArmMotion, JointLimits, gentler
from push_ident.pushing.posture_map import PostureMap
from push_ident.pushing.push import PUSH_ACCELERATION, PushCode, PushPlan2D, PushSettings
from push_ident.pushing.tool_path import Corridor, ToolMotion, ToolPath, rounded
from push_ident.pushing.trajectory import JointTrajectory, join, joint_move, path_at_speed, path_move, stand_still
from push_ident.types import BoolArray, Float64Array

T = TypeVar("T")
_N_SLOWED: Final = 5
"""Times that a motion which asks too much of a joint is slowed down; then it is refused."""


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """Heights, speeds and pauses of the arm around a push."""

    home: tuple[float, ...]
    """Posture between pushes, high and outside the camera's view [rad], one value per joint."""
    clearance: float = 0.03
    """Travel of the pusher before contact [m]."""
    push_height: float = 0.012
    """Height of the tip above the table during the push [m]."""
    min_height: float = 0.006
    """Least commanded height of the tip [m]."""
    safe_height: float = 0.12
    """Height of the tip at start and end of free moves [m]."""
    free_height: float = 0.09
    """Least height of the tip during a free move [m]: above every object."""
    free_speed: float = 0.25
    """Tool speed up and down [m/s]."""
    acceleration: float = PUSH_ACCELERATION
    """Largest tool acceleration at both ends of the push and on other straight moves [m/s^2]; less where a joint needs it."""
    settle: float = 0.3
    """Pause with the tool lowered, before the push [s]."""
    rest: float = 0.6
    """Pause after the push, during which the camera observes the object at rest [s]."""
    back_off: float = 0.015
    """Travel away from the object before the tool rises [m]."""
    velocity_scale: float = 0.9
    """Fraction of a joint's velocity limit that may be used."""
    link_height: float = 0.10
    """Least height of the axis of any moving joint, such as the elbow [m]; the tip has its own limit."""
    max_joint_velocity: float = 1.3
    """Limit of every joint's velocity [rad/s], beside that of the robot description."""
    joint_acceleration_limits: tuple[float, ...] = (10.0,)
    """Limit of each joint on the whole motion [rad/s^2], one per joint or one for all. A URDF has none and KUKA states none for the iiwa;
    MoveIt configurations of arms of its size (Universal Robots) set 5 to 10 (`max_acceleration` in their joint_limits.yaml)."""
    max_joint_acceleration: float = 5.0
    """Limit of every joint's acceleration on all moves except the push [rad/s^2]."""
    line_spacing: float = 0.004
    """Distance between the points of a straight line at which the inverse kinematics is solved [m]."""
    posture_rate: float = 3.0
    """Drift towards the neutral posture per metre of tool travel, as a fraction of the difference [1/m]: slow compared with the push."""
    home_tolerance: float = 1e-3
    """The arm is at home when every joint is within this [rad]."""
    height_tolerance: float = 5e-4
    """Tolerance of the height of a level path [m]."""
    line_tolerance: float = 5e-4
    """Largest distance of the tool from its straight line between two solved points [m]."""
    least_tool_acceleration: float = 0.5
    """Least acceleration of a tool whose path may be corrected [m/s^2]: at 0.1 m/s it turns aside within 0.2 s and a centimetre."""

    def __post_init__(self) -> None:
        if not 0 < self.min_height <= self.push_height < self.free_height <= self.safe_height:
            raise InputError(
                "heights must rise as 0 < min_height <= push_height < free_height <= safe_height, got "
                f"{self.min_height}, {self.push_height}, {self.free_height}, {self.safe_height} m."
            )
        if not self.joint_acceleration_limits or min(self.joint_acceleration_limits) <= 0:
            raise InputError(f"joint_acceleration_limits are {self.joint_acceleration_limits}, expected numbers over 0 rad/s^2.")


@dataclass(frozen=True, slots=True)
class ArmPlan(ArmMotion):
    """Motion of the arm for one push."""

    push: PushPlan2D
    lowered: float
    """The tool is lowered, object and tool are at rest [s]."""
    departure: float
    """The push begins [s]."""
    contact: float
    """Planned first contact [s]."""
    stop: float
    """The tool stands still after the push [s]."""
    rested: float
    """The rest ends, the tool leaves [s]."""
    yaw: Float64Array | None = field(default=None, kw_only=True)
    """Of the tip's x axis at every sample [rad], shape (n,), not wrapped; None of a cylinder."""

    @property
    def tool_path(self) -> tuple[Float64Array, Float64Array]:
        """Time from 0 [s], shape (n,), and tip [m], shape (n, 3), of the push itself."""
        pushing = self._pushing
        return self.trajectory.time[pushing] - self.departure, self.tip[pushing]

    @property
    def tool_yaw(self) -> Float64Array | None:
        """Yaw at the times of `tool_path` [rad], shape (n,); None of a cylinder."""
        return None if self.yaw is None else self.yaw[self._pushing]

    @property
    def _pushing(self) -> BoolArray:
        time = self.trajectory.time
        return np.asarray((time >= self.departure - 1e-9) & (time <= self.stop + 1e-9))

    def away_from(self, elapsed: float) -> Float64Array:
        """Unit vector against which the tool backs off at a time of the plan [s], shape (2,)."""
        return self.push.heading


def plan_push(kinematics: ArmKinematics, q_now: ArrayLike, push: PushPlan2D, settings: MotionSettings, span: float = 0.0) -> ArmPlan:
    """Plan up, home, above the start of the push, down, push, rest, back off, up, home.

    `q_now` [rad] is the measured posture, at rest; `span`: distance of both ends of a tool with two contacts [m], of which one is in front,
    whichever the arm can bring there. Raises PlanningError: UNREACHABLE when the arm has no posture for a point of the path, LIMIT for a
    joint, velocity, acceleration or height limit; the text names joint, value and limit.
    """
    if not span:
        return _plan_push(kinematics, q_now, push, settings, None)
    of_frame = push.of_frame(span)
    return _either(lambda turn: _plan_push(kinematics, q_now, of_frame, settings, push.direction + 0.5 * np.pi + turn))


def _either(plan_with: Callable[[float], T]) -> T:
    """The plan with the frame of a tool as it is, or turned by half a turn: both ends are alike. Raises what was raised for the first."""
    try:
        return plan_with(0.0)
    except PlanningError as error:
        try:
            return plan_with(np.pi)
        except PlanningError:
            raise error from None


def _plan_push(kinematics: ArmKinematics, q_now: ArrayLike, push: PushPlan2D, settings: MotionSettings, yaw: float | None) -> ArmPlan:
    q_now = kinematics.check_configuration(q_now)
    limits = joint_limits(kinematics, settings)
    limits.check_positions(q_now[None, :])
    start, end = push.tool_start(settings.clearance), push.tool_end
    approach = _approach(kinematics, q_now, start, settings, None if yaw is None else _x_axis(yaw))
    settle = stand_still(approach[-1].position[-1], settings.settle)

    # A spinning tool would drag the object along its face, so the spin is held during the push.
    x_axis = kinematics.forward(settle.position[-1])[:3, 0]
    postures, length = _line(kinematics, settle.position[-1], _point(end, settings.push_height), settings, TOOL_DOWN, x_axis)
    pushing, acceleration = _eased(kinematics, postures, length, push.speed, settings)
    ramp = push.speed / acceleration
    if 0.5 * push.speed * ramp > settings.clearance:
        raise PlanningError(
            PushCode.LIMIT, f"{push.speed:.3f} m/s is not reached within the clearance of {settings.clearance:.3f} m; push slower."
        )
    rest = stand_still(pushing.position[-1], settings.rest)
    retreat = _away(kinematics, rest.position[-1], push.heading, settings, keeps_yaw=yaw is not None)

    lowered = sum(part.duration for part in approach)
    departure = lowered + settle.duration
    stop = departure + pushing.duration
    trajectory = join([*approach, settle, pushing, rest, *retreat])
    plan = ArmPlan(
        limits,
        trajectory,
        _checked_tip(kinematics, trajectory, settings, "push slower"),
        push,
        lowered,
        departure,
        departure + settings.clearance / push.speed + 0.5 * ramp,
        stop,
        stop + rest.duration,
        yaw=None if yaw is None else _yaw(kinematics, trajectory),
    )
    # Rising from a start below the limit is allowed: heights are checked from the lowered tool on.
    _check_height(plan.tip[trajectory.time > lowered - 1e-9], settings)
    _check_line(plan, settings)
    return plan


def _eased(
    kinematics: ArmKinematics, postures: Float64Array, length: float, speed: float, settings: MotionSettings
) -> tuple[JointTrajectory, float]:
    """Motion of a push along its line, and the acceleration of the tool [m/s^2].

    That is less than requested where a joint needs longer ramps, as long as the tool reaches its speed before the contact.
    """
    acceleration, limit = settings.acceleration, joint_limits(kinematics, settings).planned.acceleration
    least = speed**2 / min(2.0 * settings.clearance, length)
    for _ in range(5):
        pushing = path_at_speed(postures, length, speed, acceleration)
        share = float(np.max(np.abs(pushing.acceleration) / limit))
        if share <= 1.0 or acceleration <= least:
            break
        # Aim at 98 % of the limit: the part of the joint acceleration that the bend of the line causes at speed stays.
        acceleration = max(0.98 * acceleration / share, least)
    return path_at_speed(postures, length, speed, acceleration), acceleration


@dataclass(frozen=True, slots=True)
class PathPlan(ArmPlan):
    """Motion of the arm for a push along a path that may be corrected, up to the rest after it; the retreat begins where that ends."""

    postures: PostureMap
    """Postures over the corridor."""
    tool: ToolMotion
    """Motion of the tool during the push itself; times from the departure on."""
    rest: float
    """Pause after the push [s]."""
    speed: float
    """Largest speed of the tool in the corridor [m/s]."""
    acceleration: float
    """Largest acceleration of the tool in the corridor [m/s^2]."""

    def away_from(self, elapsed: float) -> Float64Array:
        """As `ArmPlan`: a path that was interrupted may have another heading than at its end."""
        return self.tool.heading(elapsed - self.departure)

    def corrected(self, path: ToolPath, begin: float) -> PathPlan:
        """The plan with another path of the tool from a time on.

        Args:
            begin: when the motion begins to change, from the departure on [s].

        Raises PlanningError: LIMIT where a joint would have to accelerate too much.
        """
        k = min(int(np.searchsorted(self.tool.time, begin)), len(self.tool.time) - 1)
        now = float(self.tool.time[k]), self.tool.position[k], self.tool.velocity[k]
        later = rounded(path, *now, self.acceleration, self.speed)
        tool = ToolMotion(*(np.concatenate([getattr(self.tool, n)[:k], getattr(later, n)]) for n in ("time", "position", "velocity")))
        first = int(np.searchsorted(self.trajectory.time, self.departure + self.tool.time[k] - 1e-6))
        changed = JointTrajectory(later.time - later.time[0], *self.postures.joints(later))
        tail = join([changed, stand_still(changed.position[-1], self.rest)])
        self.limits.planned.check_accelerations(changed, gentler(self.acceleration))
        before, at = self.trajectory, float(self.trajectory.time[first])
        parts = zip((before.time, before.position, before.velocity), (tail.time + at, tail.position, tail.velocity), strict=True)
        tool_xy = np.vstack([later.position, np.tile(later.position[-1], (len(tail.time) - len(later.time), 1))])
        tip = np.column_stack([tool_xy, np.full(len(tool_xy), self.tip[first, 2])])
        stop = self.departure + float(tool.time[-1])
        return replace(
            self,
            trajectory=JointTrajectory(*(np.concatenate([old[:first], new]) for old, new in parts)),
            tip=np.vstack([self.tip[:first], tip]),
            push=replace(self.push, distance=_travel(tool, self.push)),
            tool=tool,
            stop=stop,
            rested=stop + self.rest,
        )


def plan_path_push(
    kinematics: ArmKinematics,
    q_now: ArrayLike,
    push: PushPlan2D,
    path: ToolPath,
    corridor: Corridor,
    settings: MotionSettings,
    limits: PushSettings,
) -> PathPlan:
    """Plan up, home, above the start of the path, down, the push along it, with postures for all of its corridor, and the rest after it.

    `push` is its straight beginning; for the rest see `plan_push`, whose exceptions it raises. LIMIT and UNREACHABLE are raised for any
    position in the corridor and workspace that the tool cannot reach, or not cross at the largest speed of a push.
    """
    q_now = kinematics.check_configuration(q_now)
    joints = joint_limits(kinematics, settings)
    joints.check_positions(q_now[None, :])
    approach = _approach(kinematics, q_now, path.position[0], settings)
    settle = stand_still(approach[-1].position[-1], settings.settle)
    postures = PostureMap(kinematics, settle.position[-1], corridor, limits.workspace)
    speed, acceleration = postures.allowed(limits.max_speed, settings.acceleration, joints.planned, settings.link_height)
    if path.speed > speed or acceleration < settings.least_tool_acceleration:
        raise PlanningError(
            PushCode.LIMIT,
            f"in this corridor the joints allow the tool {speed:.3f} m/s and {acceleration:.2f} m/s^2, needed are {path.speed:.3f} and "
            f"{settings.least_tool_acceleration:.2f}; go slower, or give a narrower corridor.",
        )
    tool = rounded(path, 0.0, path.position[0], np.zeros(2), acceleration, speed)
    pushing = JointTrajectory(tool.time, *postures.joints(tool))
    rest = stand_still(pushing.position[-1], settings.rest)
    lowered = sum(part.duration for part in approach)
    departure = lowered + settle.duration
    stop = departure + pushing.duration
    trajectory = join([*approach, settle, pushing, rest])
    plan = PathPlan(
        joints,
        trajectory,
        _checked_tip(kinematics, trajectory, settings),
        replace(push, distance=_travel(tool, push)),
        lowered,
        departure,
        departure + float(path.time[1]),
        stop,
        stop + rest.duration,
        postures,
        tool,
        settings.rest,
        speed,
        acceleration,
    )
    _check_height(plan.tip[trajectory.time > lowered - 1e-9], settings)
    return plan


@dataclass(frozen=True, slots=True)
class TurningPlan(ArmPlan):
    """Motion of the arm for a push with both ends of a tool that turns on the way."""

    turn: float
    """Of the tip's x axis from that of the frame of the path [rad]: 0, or half a turn."""

    def away_from(self, elapsed: float) -> Float64Array:
        """As `ArmPlan`: off the face on which both ends are."""
        assert self.yaw is not None, "it turns"
        return _x_axis(float(np.interp(elapsed, self.trajectory.time, self.yaw)) - self.turn)[:2]


def plan_turning_push(
    kinematics: ArmKinematics, q_now: ArrayLike, push: PushPlan2D, path: ToolPath, settings: MotionSettings, span: float
) -> TurningPlan:
    """Plan up, home, above the start of the path, down, the push along it with the yaws that it has, rest, back off, up, home.

    `push` is its straight beginning, `span` the distance of both ends of the tool [m]; for the rest see `plan_push`, whose exceptions it
    raises. The tool is slower than the path says where the joints need it.
    """
    return _either(lambda turn: _plan_turning_push(kinematics, q_now, push, path, settings, span, turn))


def _plan_turning_push(
    kinematics: ArmKinematics, q_now: ArrayLike, push: PushPlan2D, path: ToolPath, settings: MotionSettings, span: float, turn: float
) -> TurningPlan:
    q_now = kinematics.check_configuration(q_now)
    joints = joint_limits(kinematics, settings)
    joints.check_positions(q_now[None, :])
    poses = path.dense_poses(settings.line_spacing, 0.5 * span)[1]
    approach = _approach(kinematics, q_now, poses[0, :2], settings, _x_axis(poses[0, 2] + turn))
    settle = stand_still(approach[-1].position[-1], settings.settle)
    postures = [settle.position[-1]]
    for before, pose in pairwise(poses):
        # As on a straight line, the drift to the neutral posture keeps only its part that does not move the tool.
        drift = settings.posture_rate * float(np.linalg.norm((pose - before)[:2])) * (kinematics.neutral - postures[-1])
        point, x_axis = _point(pose[:2], settings.push_height), _x_axis(pose[2] + turn)
        postures.append(_reach(kinematics, point, postures[-1] + drift, TOOL_DOWN, x_axis, posture_gain=0.0))
    pushing, speed, acceleration = _slowed(np.array(postures), path, joints.planned, settings)
    rest = stand_still(pushing.position[-1], settings.rest)
    retreat = _away(kinematics, rest.position[-1], _x_axis(poses[-1, 2])[:2], settings, keeps_yaw=True)
    lowered = sum(part.duration for part in approach)
    departure = lowered + settle.duration
    stop = departure + pushing.duration
    trajectory = join([*approach, settle, pushing, rest, *retreat])
    plan = TurningPlan(
        joints,
        trajectory,
        _checked_tip(kinematics, trajectory, settings, "push slower"),
        replace(push, speed=speed),
        lowered,
        departure,
        departure + float(path.time[1]) * path.speed / speed + 0.5 * speed / acceleration,
        stop,
        stop + rest.duration,
        turn,
        yaw=_yaw(kinematics, trajectory),
    )
    _check_height(plan.tip[trajectory.time > lowered - 1e-9], settings)
    _check_ends(plan, poses, span, settings)
    return plan


def _slowed(postures: Float64Array, path: ToolPath, limits: JointLimits, settings: MotionSettings) -> tuple[JointTrajectory, float, float]:
    """Motion through postures that are even in the time of a path, its speed [m/s] and the acceleration at both ends [m/s^2], by the speed
    of the path: less where the joints need it, as long as the tool reaches its speed before the contact."""
    speed, acceleration = path.speed, settings.acceleration
    length = speed * float(path.time[-1])
    for _ in range(_N_SLOWED):
        ramp = min(speed / acceleration, length / speed)
        pushing = path_at_speed(postures, length, speed, acceleration)
        share = np.max(np.abs(pushing.acceleration) / limits.acceleration, axis=1)
        on_ramp = np.minimum(pushing.time[:-1], pushing.duration - pushing.time[1:]) < ramp
        at_speed = max(float(np.max(np.abs(pushing.velocity) / limits.velocity)), float(np.sqrt(np.max(share[~on_ramp], initial=0.0))))
        at_ends = float(np.max(share[on_ramp], initial=0.0))
        if max(at_speed, at_ends) <= 1.0:
            break
        # Aim at 98 % of the limits, as of a straight push.
        speed *= min(1.0, 0.98 / max(at_speed, 1e-9))
        acceleration *= min(1.0, 0.98 / max(at_ends, 1e-9))
    if 0.5 * speed**2 / acceleration > settings.clearance:
        raise PlanningError(
            PushCode.LIMIT, f"{speed:.3f} m/s is not reached within the clearance of {settings.clearance:.3f} m; push slower."
        )
    return path_at_speed(postures, length, speed, acceleration), speed, acceleration


def _x_axis(yaw: float) -> Float64Array:
    """Unit vector of a heading [rad] on the table, shape (3,)."""
    return np.array([np.cos(yaw), np.sin(yaw), 0.0])


def _yaw(kinematics: ArmKinematics, trajectory: JointTrajectory) -> Float64Array:
    """Yaw of the tip's x axis at every sample [rad], shape (n,), not wrapped."""
    axes = np.array([kinematics.forward(q)[:2, 0] for q in trajectory.position])
    return np.unwrap(np.arctan2(axes[:, 1], axes[:, 0]))


def _travel(tool: ToolMotion, push: PushPlan2D) -> float:
    """Length of the motion after the contact [m]."""
    behind = (tool.position - push.tool_at_contact) @ push.heading >= 0.0
    touched = int(np.argmax(behind)) if behind.any() else len(behind) - 1
    return float(np.sum(np.linalg.norm(np.diff(tool.position[touched:], axis=0), axis=1)))


def plan_retreat(
    kinematics: ArmKinematics, q_now: ArrayLike, heading: ArrayLike, settings: MotionSettings, *, keeps_yaw: bool = False
) -> ArmMotion:
    """Plan back off, up, home from an aborted push, at rest at `q_now` [rad].

    `heading`, shape (2,), is the unit vector of that push in the table frame; `keeps_yaw`: the lowered tool does not turn, as one with two
    contacts must not. Raises PlanningError as `plan_push`.
    """
    q_now = kinematics.check_configuration(q_now)
    limits = joint_limits(kinematics, settings)
    limits.check_positions(q_now[None, :])
    parts = _away(kinematics, q_now, np.asarray(heading, dtype=np.float64), settings, keeps_yaw=keeps_yaw)
    if not parts:
        parts = [stand_still(q_now, 0.0)]
    trajectory = join(parts)
    tip = _checked_tip(kinematics, trajectory, settings)
    _check_height(tip, settings, float(tip[0, 2]))
    return ArmMotion(limits, trajectory, tip)


def joint_limits(kinematics: ArmKinematics, settings: MotionSettings) -> JointLimits:
    """Limits of the joints of an arm. Raises InputError unless there is one acceleration for all, or one per joint."""
    acceleration = np.array(settings.joint_acceleration_limits)
    if len(acceleration) not in (1, kinematics.n_joints):
        raise InputError(
            f"joint_acceleration_limits has {len(acceleration)} numbers, expected 1 or {kinematics.n_joints}, one per joint: "
            f"{', '.join(kinematics.joint_names)}."
        )
    return JointLimits(
        kinematics.joint_names,
        kinematics.position_lower,
        kinematics.position_upper,
        np.minimum(settings.velocity_scale * kinematics.velocity_limit, settings.max_joint_velocity),
        np.broadcast_to(acceleration, (kinematics.n_joints,)),
    )


def _free_limits(kinematics: ArmKinematics, settings: MotionSettings) -> tuple[Float64Array, Float64Array]:
    """Velocity [rad/s] and acceleration [rad/s^2] of every joint on all moves except the push."""
    limits = joint_limits(kinematics, settings).planned
    return limits.velocity, np.minimum(limits.acceleration, settings.max_joint_acceleration)


def _point(xy: Float64Array, height: float) -> Float64Array:
    return np.array([xy[0], xy[1], height])


def _approach(
    kinematics: ArmKinematics, q_now: Float64Array, start: Float64Array, settings: MotionSettings, x_axis: Float64Array | None = None
) -> list[JointTrajectory]:
    """Up, home, above `start` (2,), and down to the height of the push; `x_axis` (3,): of the tip there, None for any."""
    parts, home = _up(kinematics, q_now, settings, keeps_yaw=x_axis is not None), kinematics.check_configuration(settings.home)
    q = parts[-1].position[-1] if parts else q_now
    if np.max(np.abs(q - home)) > settings.home_tolerance:
        parts.append(_free_move(kinematics, q, home, settings))
        q = home
    above = _reach(kinematics, _point(start, settings.safe_height), kinematics.neutral, x_axis=x_axis)
    parts.append(_free_move(kinematics, q, above, settings))
    parts.append(_straight(kinematics, above, _point(start, settings.push_height), settings, TOOL_DOWN, x_axis))
    return parts


def _up(kinematics: ArmKinematics, q: Float64Array, settings: MotionSettings, *, keeps_yaw: bool = False) -> list[JointTrajectory]:
    """Straight up to the height of free moves, with the tool's axis held; empty if the tip is that high."""
    pose = kinematics.forward(q)
    if pose[2, 3] >= settings.safe_height - 1e-3:
        return []
    target, x_axis = _point(pose[:2, 3], settings.safe_height), pose[:3, 0] if keeps_yaw else None
    return [_straight(kinematics, q, target, settings, pose[:3, 2], x_axis)]


def _away(
    kinematics: ArmKinematics, q: Float64Array, heading: Float64Array, settings: MotionSettings, *, keeps_yaw: bool = False
) -> list[JointTrajectory]:
    """Back off against `heading` and up if the tip is low; then home unless the arm is there."""
    parts: list[JointTrajectory] = []
    pose = kinematics.forward(q)
    if pose[2, 3] < settings.free_height:
        target = _point(pose[:2, 3] - settings.back_off * heading, float(pose[2, 3]))
        parts.append(_straight(kinematics, q, target, settings, pose[:3, 2], pose[:3, 0] if keeps_yaw else None))
        q = parts[-1].position[-1]
    parts += _up(kinematics, q, settings, keeps_yaw=keeps_yaw)
    q = parts[-1].position[-1] if parts else q
    home = kinematics.check_configuration(settings.home)
    if np.max(np.abs(q - home)) > settings.home_tolerance:
        parts.append(_free_move(kinematics, q, home, settings))
    return parts


def _straight(
    kinematics: ArmKinematics,
    q: Float64Array,
    target: Float64Array,
    settings: MotionSettings,
    axis: Float64Array = TOOL_DOWN,
    x_axis: Float64Array | None = None,
) -> JointTrajectory:
    postures, length = _line(kinematics, q, target, settings, axis, x_axis)
    return path_move(postures, length, settings.free_speed, settings.acceleration, *_free_limits(kinematics, settings))


def _line(
    kinematics: ArmKinematics,
    q: Float64Array,
    target: Float64Array,
    settings: MotionSettings,
    axis: Float64Array,
    x_axis: Float64Array | None = None,
) -> tuple[Float64Array, float]:
    """Postures at even steps along the straight line of the tip from `q` to `target`, shape (n, n_joints), and its length [m]."""
    start = kinematics.forward(q)[:3, 3]
    length = float(np.linalg.norm(target - start))
    n_steps = max(int(np.ceil(length / settings.line_spacing)), 2)
    postures = [q]
    for share in np.linspace(0.0, 1.0, n_steps + 1)[1:]:
        # The drift towards the neutral posture precedes the correction of minimum norm, which keeps only the part of it that does
        # not move the tool; it is proportional to the travel and thus smooth in time.
        drift = settings.posture_rate * length / n_steps * (kinematics.neutral - postures[-1])
        postures.append(_reach(kinematics, start + share * (target - start), postures[-1] + drift, axis, x_axis, posture_gain=0.0))
    return np.array(postures), length


def _reach(
    kinematics: ArmKinematics,
    position: Float64Array,
    q_start: Float64Array,
    axis: Float64Array = TOOL_DOWN,
    x_axis: Float64Array | None = None,
    posture_gain: float = 0.05,
) -> Float64Array:
    q, converged = kinematics.inverse(position, q_start, axis=axis, x_axis=x_axis, posture_gain=posture_gain)
    if not converged:
        miss = float(np.linalg.norm(kinematics.forward(q)[:3, 3] - position))
        at_limit = [
            f"{name} at its limit {value:.3f} rad"
            for name, value, low, high in zip(kinematics.joint_names, q, kinematics.position_lower, kinematics.position_upper, strict=True)
            if min(value - low, high - value) < 1e-6
        ]
        where = "(" + ", ".join(f"{v:.3f}" for v in position) + ")"
        raise PlanningError(
            PushCode.UNREACHABLE,
            f"the tool cannot reach {where} m: the nearest posture is {1e3 * miss:.1f} mm away, {', '.join(at_limit) or 'arm stretched'}.",
        )
    return q


def _free_move(kinematics: ArmKinematics, q_from: Float64Array, q_to: Float64Array, settings: MotionSettings) -> JointTrajectory:
    move = joint_move(q_from, q_to, *_free_limits(kinematics, settings))
    lowest = min((kinematics.forward(q)[2, 3] for q in move.position[::5]), default=np.inf)
    if lowest < settings.free_height:
        raise PlanningError(
            PushCode.LIMIT,
            f"a free move would lower the tip to {lowest:.3f} m, limit {settings.free_height:.3f} m; move the arm closer to home.",
        )
    return move


def _checked_tip(kinematics: ArmKinematics, trajectory: JointTrajectory, settings: MotionSettings, remedy: str = "") -> Float64Array:
    """Tip at every sample [m], shape (n, 3), of a trajectory within the limits of the joints and above the table with every link."""
    limits = joint_limits(kinematics, settings).planned
    limits.check_positions(trajectory.position)
    limits.check_velocities(trajectory)
    limits.check_accelerations(trajectory, remedy or gentler(settings.acceleration))
    tip = np.empty((len(trajectory.time), 3))
    for i, q in enumerate(trajectory.position):
        tip[i] = kinematics.forward(q)[:3, 3]
        name, height = kinematics.lowest_joint()
        if height < settings.link_height:
            raise PlanningError(
                PushCode.LIMIT,
                f"{name} would be {height:.3f} m above the table, limit {settings.link_height:.3f} m; move the arm closer to home.",
            )
    return tip


def _check_height(tip: Float64Array, settings: MotionSettings, start: float = np.inf) -> None:
    """Check the lowest of `tip` (n, 3) against the limit, or against the height [m] of a lower start."""
    lowest, limit = float(np.min(tip[:, 2])), min(settings.min_height, start - settings.height_tolerance)
    if lowest < limit:
        raise PlanningError(PushCode.LIMIT, f"the tip would be {lowest:.4f} m above the table, limit {limit:.4f} m.")


def _check_line(plan: ArmPlan, settings: MotionSettings) -> None:
    _, path = plan.tool_path
    across = np.array([-plan.push.heading[1], plan.push.heading[0]])
    deviation = np.hypot((path[:, :2] - plan.push.tool_at_contact) @ across, path[:, 2] - settings.push_height)
    if float(np.max(deviation)) > settings.line_tolerance:
        raise PlanningError(
            PushCode.UNREACHABLE, f"the tool would leave the push line by {1e3 * float(np.max(deviation)):.2f} mm; choose another push."
        )


def _check_ends(plan: TurningPlan, poses: Float64Array, span: float, settings: MotionSettings) -> None:
    """Check that both ends of the tool keep to their lines, with its frame at poses, shape (n, 3)."""
    (_, tip), yaw = plan.tool_path, plan.tool_yaw
    assert yaw is not None, "it turns"
    made = np.column_stack([tip[:, :2], yaw - plan.turn])
    for end in (0.5 * span, -0.5 * span):
        at = np.array([[0.0, end]])
        line = Corridor(transform_points(poses, at)[:, 0], settings.line_tolerance)
        if (excess := float(np.max(line.excess(transform_points(made, at)[:, 0])))) > 0.0:
            raise PlanningError(
                PushCode.UNREACHABLE,
                f"an end of the tool would leave its path by {1e3 * (excess + settings.line_tolerance):.2f} mm; choose a path without "
                "sharp corners.",
            )
