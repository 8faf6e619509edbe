"""The arm in the view of the camera while it pushes: its links for the renderer, and as perception gets them."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pinocchio as pin

from push_ident.errors import PlanningError
from push_ident.geometry.arm_shape import ArmShape
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.perception.perception_node import PARAMETERS
from push_ident.perception.frame.robot import Cylinder, RobotPart
from push_ident.perception.settings import PerceptionSettings
from push_ident.pushing.motion import MotionSettings
from push_ident.pushing.push import PushCode
from push_ident.types import Float64Array
from push_ident_sim.cell.robot import HOME, JOINT_NAMES, PUSHER_LENGTH, PUSHER_RADIUS, robot_description

__all__ = ["ArmInView", "first_touch"]

_MOTION: Final = MotionSettings(home=(1.4, *HOME[1:]))
"""Turned aside between pushes, as the live cell parks it."""
_DEFAULT: Final[dict[str, Any]] = {row.name: row.default for row in PARAMETERS}
_SETTINGS: Final = PerceptionSettings()
_STEP: Final = 5e-4
"""Step in which the pusher approaches the outline [m]."""


class ArmInView:
    """Postures of the arm, and what follows from them. Not safe to share between threads."""

    def __init__(self) -> None:
        description = robot_description()
        self.home = np.array(_MOTION.home)
        self._kinematics = ArmKinematics(description, neutral=HOME)
        self._shape = ArmShape(description, _DEFAULT["link_radius"])
        self._model = pin.buildModelFromXML(description)
        self._data = self._model.createData()

    def lowered(self, tip: Float64Array) -> Float64Array:
        """Posture [rad], shape (7,), with the tip lowered at `tip` [m], shape (2,). Raises PlanningError where there is none."""
        above = self._reach(np.array([*tip, _MOTION.safe_height]), np.array(HOME), None, 0.05)
        return self._reach(np.array([*tip, _MOTION.push_height]), above, None, 0.0)

    def moved(self, posture: Float64Array, tip: Float64Array) -> Float64Array:
        """Posture [rad] near `posture` with the lowered tip at `tip` [m], shape (2,), not spun. Raises PlanningError as `lowered`."""
        x_axis = self._kinematics.forward(posture)[:3, 0]
        return self._reach(np.array([*tip, _MOTION.push_height]), posture, x_axis, 0.0)

    def link_poses(self, posture: Float64Array) -> dict[str, Float64Array]:
        """Pose of each link in `table`, homogeneous (4, 4), by its name."""
        pin.forwardKinematics(self._model, self._data, posture)
        pin.updateFramePlacements(self._model, self._data)
        bodies = ((i, frame) for i, frame in enumerate(self._model.frames) if frame.type == pin.FrameType.BODY)
        return {frame.name: np.array(self._data.oMf[i].homogeneous) for i, frame in bodies}

    def parts(self, posture: Float64Array) -> tuple[RobotPart, ...]:
        """Tool, hand and links as perception_node makes them of tool pose, joint states, description and its default parameters."""
        x, y, z = (float(v) for v in self._kinematics.forward(posture)[:3, 3])
        tool = Cylinder(x, y, PUSHER_RADIUS, z), Cylinder(x, y, _DEFAULT["hand_radius"], z + PUSHER_LENGTH)
        reach = _SETTINGS.max_object_height + _SETTINGS.mask_margin
        rods = self._shape.at(dict(zip(JOINT_NAMES, posture.tolist(), strict=True)))
        return (*tool, *(rod for rod in rods if rod.lowest < reach))

    def _reach(self, point: Float64Array, start: Float64Array, x_axis: Float64Array | None, posture_gain: float) -> Float64Array:
        q, converged = self._kinematics.inverse(point, start, x_axis=x_axis, posture_gain=posture_gain)
        if not converged:
            where = ", ".join(f"{v:.3f}" for v in point)
            raise PlanningError(PushCode.UNREACHABLE, f"the arm in the picture cannot reach ({where}) m.")
        return q


def first_touch(outline: Float64Array, pose: Float64Array, change: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Where a pusher that makes an object move by `change` (x, y, yaw) touches it first.

    It moves parallel to the path of the object's middle, on the side of it that gives the turn.

    Returns:
        Its axis at that moment and its heading as a unit vector, each of shape (2,), `table` frame.
    """
    heading = change[:2] / np.linalg.norm(change[:2])
    left = np.array([-heading[1], heading[0]])
    corners = transform_points(pose, outline)
    aside = (corners - pose[:2]) @ left
    # Halfway to the edge: a push at the edge would slip off.
    beside = pose[:2] + 0.5 * (aside.min() if change[2] > 0 else aside.max()) * left
    far = float(np.max(np.linalg.norm(corners - pose[:2], axis=1))) + PUSHER_RADIUS
    path = beside - np.arange(far, -far, -_STEP)[:, None] * heading
    touching = signed_distance(path, corners) <= PUSHER_RADIUS
    return path[int(np.argmax(touching))], heading
