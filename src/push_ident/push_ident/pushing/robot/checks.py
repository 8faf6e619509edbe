"""Whether a robot file fits its URDF, the table and the camera: everything that can be found without the arm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.arm_shape import ArmShape
from push_ident.geometry.frames import TABLE_FRAME
from push_ident.geometry.kinematics import TOOL_DOWN, ArmKinematics
from push_ident.geometry.rod import Rod
from push_ident.limits import plain_text
from push_ident.pushing.motion import MotionSettings
from push_ident.pushing.robot.description import TIP_LINK, Urdf, cell_description, read_urdf
from push_ident.pushing.robot.node_parameters import node_parameters
from push_ident.pushing.robot.reach import AXES, Outcome, Reach
from push_ident.pushing.robot.robot_file import Robot, motion_settings
from push_ident.types import Float64Array


class Level(StrEnum):
    """How bad it is."""

    OK = "ok"
    NOT_CHECKED = "not checked"
    WARNING = "warning"
    """It works, but worse than it could, or another push would be refused."""
    WRONG = "wrong"
    """The robot cannot push like this."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    about: str
    """Part of the robot file: `joints`, `reach`, ..."""
    level: Level
    what: str
    """What was found, with its numbers."""
    expected: str = ""
    remedy: str = ""

    @property
    def text(self) -> str:
        """All of it in one line."""
        return "; ".join(part for part in (self.what, self.expected and f"expected {self.expected}", self.remedy) if part)


def _wrong(about: str, what: str, expected: str = "", remedy: str = "") -> Finding:
    return Finding(about, Level.WRONG, what, expected, remedy)


_MOVABLE: Final = ("revolute", "continuous")


def check_robot(robot: Robot) -> tuple[list[Finding], ArmKinematics | None]:
    """Findings about description, joints, limits, frames, postures and camera; and the kinematics, where the file gives one.

    Checks that an earlier fault prevents are left out.
    """
    try:
        urdf = read_urdf(robot)
    except InputError as error:
        return [_wrong("description", str(error))], None
    n_links, n_joints = len(urdf.links), len(urdf.joints)
    findings = [Finding("description", Level.OK, f"{urdf.path}: {n_links} links, {n_joints} joints")]
    if missing := urdf.missing_meshes:
        what = f"{len(missing)} meshes are no files, the first {plain_text(missing[0])}"
        remedy = "source the workspace or install the package that has them; without them `up sim` does not start"
        findings.append(Finding("description", Level.WARNING, what, "files", remedy))
    findings += [*_frames(robot, urdf), *_joints(robot, urdf)]
    try:
        node_parameters(robot)
    except InputError as error:
        findings.append(_wrong("parameters", str(error)))
    if any(finding.level is Level.WRONG for finding in findings):
        return findings, None
    findings += _limits(robot, urdf)
    try:
        description = cell_description(robot, urdf)
        kinematics = ArmKinematics(description, TIP_LINK, robot.file.joints.neutral)
        shape = ArmShape(description)
    except InputError as error:
        return [*findings, _wrong("description", str(error))], None
    settings = motion_settings(robot)
    for name in ("neutral", "home"):
        findings += check_posture(kinematics, name, np.array(getattr(robot.file.joints, name)), settings)
    findings += _camera(robot, shape)
    usable = not any(finding.level is Level.WRONG and finding.about in ("limits", "joints") for finding in findings)
    return findings, kinematics if usable else None


def _frames(robot: Robot, urdf: Urdf) -> Iterator[Finding]:
    file, topic = robot.file, "frames"
    root = file.description.root
    if urdf.roots != [root]:
        names = plain_text(", ".join(urdf.roots[:5])) or "none"
        yield _wrong(topic, f"description.root is {plain_text(root)}", f"the root link of the URDF, {names}", "correct it")
    if root != TABLE_FRAME and TABLE_FRAME in urdf.links:
        yield _wrong(topic, "the URDF has a link `table` that is not its root", "no such link", "rename it in the URDF")
    if (root == TABLE_FRAME) != (file.base is None):
        what = "base is given" if file.base is not None else "base is missing"
        yield _wrong(topic, what, f"a base, unless description.root is `table`; it is {plain_text(root)}")
    if file.tool.link not in urdf.links:
        near = plain_text(", ".join(urdf.links[-6:]))
        yield _wrong(topic, f"the URDF has no link {plain_text(file.tool.link)}", f"a link for tool.link, such as {near}", "correct it")
    else:
        yield Finding(topic, Level.OK, f"table, {plain_text(root)}, {plain_text(file.tool.link)}, {TIP_LINK}")


def _joints(robot: Robot, urdf: Urdf) -> Iterator[Finding]:
    """Every joint of the file is in the URDF, movable, and on the way to the tool; and every one on that way is in the file."""
    names, known = robot.file.joints.names, urdf.joints
    for name in names:
        kind = known[name].get("type", "") if name in known else ""
        if not kind:
            has = plain_text(", ".join(j for j, e in known.items() if e.get("type") in _MOVABLE)) or "none"
            yield _wrong("joints", f"the URDF has no joint {plain_text(name)}", f"one of {has}", "correct joints.names")
        elif kind not in _MOVABLE:
            yield _wrong("joints", f"{plain_text(name)} is a {plain_text(kind)} joint", "revolute or continuous", "take it out")
    if robot.file.tool.link not in urdf.links:
        return
    chain = [e.get("name", "") for e in urdf.chain(robot.file.tool.link) if e.get("type") != "fixed"]
    if sorted(chain) == sorted(names) and chain != names:
        yield _wrong("joints", "joints.names has another order than the arm", ", ".join(chain), "give all lists in this order")
    for name in chain:
        if name not in names:
            what = f"{plain_text(name)} moves between {plain_text(robot.file.description.root)} and the tool, and is not in joints.names"
            yield _wrong("joints", what, ", ".join(chain), "add it, or fix it in the URDF")
    for name in names:
        if name in known and name not in chain and known[name].get("type") in _MOVABLE:
            what = f"{plain_text(name)} does not move {plain_text(robot.file.tool.link)}"
            yield _wrong("joints", what, ", ".join(chain), "take it out, or correct tool.link")
    if chain == names:
        yield Finding("joints", Level.OK, f"{len(names)} movable joints from {plain_text(robot.file.description.root)} to the tool")


def _limits(robot: Robot, urdf: Urdf) -> Iterator[Finding]:
    """Limits of the file are numbers that the URDF allows, and postures are within them."""
    joints, faults = robot.file.joints, 0
    for index, name in enumerate(joints.names):
        limit = urdf.joints[name].find("limit")
        given = {key: _number(limit.get(key, "")) for key in ("lower", "upper", "velocity")} if limit is not None else {}
        if urdf.joints[name].get("type") == "continuous":
            given |= {"lower": -np.inf, "upper": np.inf}
        if given.get("velocity") == 0.0:  # as exporters write it that know none
            given["velocity"] = np.nan
        of_urdf = [given.get(key, np.nan) for key in ("lower", "upper", "velocity")]
        of_file = [values[index] if values else None for values in (joints.lower, joints.upper, joints.velocity)]
        for finding in _limits_of(name, of_urdf, of_file):
            faults += 1
            yield finding
        lower, upper = (of_file[k] if of_file[k] is not None else of_urdf[k] for k in (0, 1))
        for posture in ("neutral", "home"):
            value = getattr(joints, posture)[index]
            if lower is not None and upper is not None and not lower <= value <= upper:
                faults += 1
                expected = f"{lower:.3f} to {upper:.3f} rad"
                yield _wrong("limits", f"joints.{posture} has {name} at {value:.3f} rad", expected, "change the posture")
    if not faults:
        yield Finding("limits", Level.OK, "within those of the URDF; neutral and home within them")


def _number(text: str) -> float:
    """A number of a URDF; not finite where there is none."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _limits_of(name: str, of_urdf: list[float], of_file: list[float | None]) -> Iterator[Finding]:
    (lower, upper, velocity), (file_lower, file_upper, file_velocity) = of_urdf, of_file
    low, high = (lower if file_lower is None else file_lower), (upper if file_upper is None else file_upper)
    if not np.isfinite([low, high]).all():
        yield _wrong("limits", f"{name} turns without end", "limits", "give joints.lower and joints.upper, all within one turn")
    elif not low < high:
        yield _wrong("limits", f"{name} has limits {low:.3f} to {high:.3f} rad", "lower < upper", "correct joints.lower and upper")
    rounding = 1e-6  # [rad], [rad/s]: URDFs have rounded numbers
    for key, given, limit in (("lower", file_lower, lower), ("upper", file_upper, upper), ("velocity", file_velocity, velocity)):
        if given is not None and ((limit - given) if key == "lower" else (given - limit)) > rounding:
            yield _wrong("limits", f"joints.{key} of {name} is {given}", f"a limit within that of the URDF, {limit:.4g}", "narrow it")
    speed = velocity if file_velocity is None else file_velocity
    if not speed > 0:
        remedy = "give joints.velocity from the data sheet"
        stated = "no velocity limit" if np.isnan(speed) else f"a velocity limit of {speed} rad/s"
        yield _wrong("limits", f"{name} has {stated}", "more than 0", remedy)


def check_posture(kinematics: ArmKinematics, name: str, posture: Float64Array, settings: MotionSettings) -> Iterator[Finding]:
    """Heights of a posture, and for the neutral one the direction of the tool."""
    pose = kinematics.forward(posture)
    x, y, z = pose[:3, 3]
    joint, height = kinematics.lowest_joint()
    where = f"{name}: tip at ({x:.3f}, {y:.3f}, {z:.3f}) m"
    faults = []
    if z < settings.free_height:
        faults.append(_wrong("posture", where, f"at least free_height, {settings.free_height:.3f} m", f"raise joints.{name}"))
    if height < settings.link_height:
        what = f"{name}: {joint} is {height:.3f} m above the table"
        remedy = f"raise the arm or the base, or lower link_height if the link is thinner than {2 * settings.link_height:.2f} m"
        faults.append(_wrong("posture", what, f"at least link_height, {settings.link_height:.3f} m", remedy))
    tilt = float(np.arccos(np.clip(pose[:3, 2] @ TOOL_DOWN, -1.0, 1.0)))
    # A posture given to two decimals is within 0.03 rad; beyond 0.1 the axes are probably not as the file means them.
    if name == "neutral" and tilt > 0.1:
        what = f"neutral: the z axis of {TIP_LINK} is {np.degrees(tilt):.0f} degrees from straight down"
        faults.append(_wrong("posture", what, "the tool upright", "correct joints.neutral, tool.tip_rpy or base.rpy"))
    yield from faults or [Finding("posture", Level.OK, where)]


def check_reach(reach: Reach, workspace: tuple[float, float, float, float]) -> Iterator[Finding]:
    """Findings about the reach, from plans of pushes over the workspace."""
    for axis, name in enumerate(AXES):
        impossible, limited = reach.share(axis, Outcome.UNREACHABLE), reach.share(axis, Outcome.LIMIT)
        possible = f"pushes along {name} are possible at {100 * reach.share(axis, Outcome.POSSIBLE):.0f} % of the workspace"
        if impossible == limited == 0:
            yield Finding("reach", Level.OK, possible)
            continue
        level = Level.WRONG if impossible else Level.WARNING
        what = f"{possible}; out of reach at {100 * impossible:.0f} %, beyond a limit at {100 * limited:.0f} %"
        yield Finding("reach", level, what, "all of it", _remedy(reach, workspace))
    for outcome, reason in reach.reasons:
        yield Finding("reach", Level.WRONG if outcome is Outcome.UNREACHABLE else Level.WARNING, reason)


def _remedy(reach: Reach, workspace: tuple[float, float, float, float]) -> str:
    if reach.largest is None:
        return "move the base, or see the reasons below"
    numbers = ", ".join(f"{value:.2f}" for value in reach.largest)
    return f"the largest workspace without a gap is [{numbers}] of {list(workspace)}; take it, move the base, or see the reasons below"


def _camera(robot: Robot, shape: ArmShape) -> Iterator[Finding]:
    """Whether the camera sees the workspace, and past the arm at home."""
    camera, pose = robot.file.camera, robot.camera_in_table
    x_min, x_max, y_min, y_max = robot.file.workspace
    x, y = np.meshgrid(np.linspace(x_min, x_max, 9), np.linspace(y_min, y_max, 9))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    if pose[2, 3] <= 0:
        yield _wrong("camera", f"camera.position is {pose[2, 3]:.3f} m above the table", "more than 0", "correct it")
        return
    in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
    angle = np.abs(np.arctan2(in_camera[:, :2], in_camera[:, 2:]))
    outside = float(np.mean(np.any(angle > 0.5 * np.array(camera.field_of_view), axis=1)))
    if outside > 0:
        remedy = "turn or raise the camera: its z axis looks forward, x right, y down; or make the workspace smaller"
        yield _wrong("camera", f"{100 * outside:.0f} % of the workspace are out of its view", "all in view", remedy)
    else:
        yield Finding(
            "camera", Level.OK, f"all of the workspace in view, {np.min(in_camera[:, 2]):.2f} to {np.max(in_camera[:, 2]):.2f} m away"
        )
    home = dict(zip(robot.file.joints.names, robot.file.joints.home, strict=True))
    rods = shape.at(home | dict.fromkeys(shape.joints_without(home), 0.0))  # a hand at zero
    hidden = float(np.mean(_hidden(pose[:3, 3], points, rods)))
    if hidden > 0:
        what = f"the arm at home hides {100 * hidden:.0f} % of the workspace from the camera"
        yield Finding("camera", Level.WARNING, what, "none of it", "turn joints.home further aside")


def _hidden(camera: Float64Array, targets: Float64Array, rods: list[Rod]) -> Float64Array:
    """Whether a rod stands between the camera [m], shape (3,), and each of the targets [m], shape (n, 3)."""
    # 60 points along each line of sight: over 1 m 17 mm apart, less than any link is thick.
    share = np.linspace(0.0, 1.0, 60)[1:-1]
    points = camera + share[None, :, None] * (targets - camera)[:, None, :]
    hidden = np.zeros(len(targets), dtype=bool)
    for rod in rods:
        axis = rod.end - rod.start
        along = np.clip((points - rod.start) @ axis / max(float(axis @ axis), 1e-12), 0.0, 1.0)
        distance = np.linalg.norm(points - rod.start - along[..., None] * axis, axis=-1)
        hidden |= (distance < rod.radius).any(axis=1)
    return hidden
