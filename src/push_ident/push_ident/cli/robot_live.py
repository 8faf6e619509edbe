"""What a running arm and a running camera show of a robot file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

import numpy as np

from push_ident.errors import PushIdentError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.limits import plain_text
from push_ident.pushing.robot.finding import Finding, Level
from push_ident.pushing.robot.robot_file import Camera, Robot
from push_ident.types import DepthFrame

if TYPE_CHECKING:
    from push_ident.nodes.client.listen import CellNames, Heard

__all__ = ["find_live"]

_ROLES: Final = ("joint_states", "joint_trajectory", "depth/image_rect")
_TRAJECTORY: Final = "trajectory_msgs/msg/JointTrajectory"
_VIEW_TOLERANCE: Final = 0.06
"""Largest difference between the field of view of the file and that of the images [rad]: data sheets give 3 degrees of tolerance
(RealSense D435: 87 +- 3 degrees), 0.052 rad."""
_LIMIT_TOLERANCE: Final = 1e-3
"""By how much a joint that stands at its limit may be reported beyond it [rad]."""


def find_live(robot: Robot, kinematics: ArmKinematics | None, seconds: float) -> list[Finding]:
    """Compare the file with an arm and a camera that run, under the names of the file or of the bag contract; say so where none does.

    `kinematics` is None where the file gives none; `seconds` is how long to listen [s].
    """
    try:
        from push_ident.nodes.client.listen import CellNames, listen_to_arms
    except ImportError as error:
        return [Finding("cell", Level.NOT_CHECKED, f"ROS cannot be imported ({error})", remedy="run `make setup`, or source ROS 2")]
    # A simulated cell has the names of the contract, whatever the driver of the real arm has.
    cells = dict.fromkeys([CellNames(*(robot.file.topics.get(role, role) for role in _ROLES)), CellNames(*_ROLES)])
    try:
        heard = listen_to_arms(list(cells), seconds)
    except PushIdentError as error:
        return [Finding("cell", Level.WRONG, str(error))]
    # A driver and the simulated cell may have one name for joint states: then the one that is commanded counts.
    arms = sorted((one for one in heard if one.n_arms), key=lambda one: not one.controllers)
    cameras = [one for one in heard if one.n_cameras]
    found = list(_arm(robot, kinematics, arms[0])) if arms else [_silent("arm", heard[0].names.states)]
    return found + (_camera(robot, cameras[0].names, seconds) if cameras else [_silent("camera", heard[0].names.images)])


def _silent(about: str, topic: str) -> Finding:
    remedy = f"start the driver of the {about}, or `push-ident up sim --robot FILE`, and check ROS_DOMAIN_ID"
    return Finding(about, Level.NOT_CHECKED, f"nothing publishes on {plain_text(topic)}", remedy=remedy)


def _arm(robot: Robot, kinematics: ArmKinematics | None, heard: Heard) -> Iterator[Finding]:
    """Joints, their positions, and the controller."""
    states, commands = plain_text(heard.names.states), plain_text(heard.names.commands)
    joints = robot.file.joints.names
    missing = [name for name in joints if name not in heard.positions]
    if not heard.n_states:
        yield Finding("arm", Level.WRONG, f"{states} has a publisher, and no message came", remedy="see the log of the driver")
    elif missing:
        has = plain_text(", ".join(heard.positions)) or "none"
        yield Finding("arm", Level.WRONG, f"{states} has no joint {', '.join(missing)}; it has {has}", "joints.names", "correct the names")
    else:
        yield Finding("arm", Level.OK, f"{states}: {len(joints)} joints, {heard.n_states} messages")
        if kinematics is not None:
            yield from _position(kinematics, np.array([heard.positions[name] for name in joints]))
    if not heard.controllers:
        yield Finding("arm", Level.WRONG, f"nobody listens to {commands}", "a trajectory controller", "start it, or correct topics")
    elif _TRAJECTORY not in heard.controllers:
        yield Finding("arm", Level.WRONG, f"{commands} takes {plain_text(', '.join(heard.controllers))}", _TRAJECTORY, "correct topics")
    else:
        yield Finding("arm", Level.OK, f"{commands} is listened to")


def _position(kinematics: ArmKinematics, q: np.ndarray) -> Iterator[Finding]:
    """Where the arm stands now, to be compared with the real one by eye."""
    for name, value, low, high in zip(kinematics.joint_names, q, kinematics.position_lower, kinematics.position_upper, strict=True):
        if not low - _LIMIT_TOLERANCE <= value <= high + _LIMIT_TOLERANCE:
            expected = f"{low:.3f} to {high:.3f} rad"
            yield Finding("arm", Level.WRONG, f"{name} stands at {value:.3f} rad", expected, "move it, or widen joints.lower and upper")
    x, y, z = kinematics.forward(q)[:3, 3]
    yield Finding("arm", Level.OK, f"by the joints its tip is at ({x:.3f}, {y:.3f}, {z:.3f}) m in `table`: compare with the real one")


def _camera(robot: Robot, names: CellNames, seconds: float) -> list[Finding]:
    from push_ident.nodes.client.depth_capture import DepthCapture

    try:
        with DepthCapture(names.images, seconds=seconds) as capture:
            frame = next(iter(capture.frames()))
    except PushIdentError as error:
        return [Finding("camera", Level.WRONG, str(error))]
    return list(_images(robot.file.camera, frame, names.images))


def _images(camera: Camera, frame: DepthFrame, topic: str) -> Iterator[Finding]:
    """Frame and field of view of the images."""
    size, intrinsics = (frame.intrinsics.width, frame.intrinsics.height), frame.intrinsics
    share = float(np.mean(np.isfinite(frame.depth)))
    yield Finding("camera", Level.OK, f"{topic}: {size[0]} x {size[1]} pixels, {100 * share:.0f} % of them with a depth")
    if frame.frame_id and frame.frame_id != camera.frame:
        expected = f"camera.frame, {plain_text(camera.frame)}"
        yield Finding("camera", Level.WRONG, f"its images are in the frame {plain_text(frame.frame_id)}", expected, "correct one of them")
    view = [2.0 * np.arctan(0.5 * pixels / focal) for pixels, focal in zip(size, (intrinsics.fx, intrinsics.fy), strict=True)]
    if max(abs(a - b) for a, b in zip(view, camera.field_of_view, strict=True)) > _VIEW_TOLERANCE:
        what = f"its images have a field of view of [{view[0]:.3f}, {view[1]:.3f}] rad"
        yield Finding("camera", Level.WARNING, what, f"camera.field_of_view, {camera.field_of_view}", "correct camera.field_of_view")
