"""The pose of a camera: from parameters, from tf2, or from depth frames of the calibration mark."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.time import Time

from push_ident.errors import InputError, PerceptionError
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.convert.messages import TABLE_FRAME
from push_ident.perception.calibration import Calibration, Mark, calibrate
from push_ident.survey.parameter_file import POSITION, QUATERNION
from push_ident.types import DepthFrame, Float64Array


def pose_rows(name: str) -> tuple[Parameter, Parameter]:
    """Parameters for the pose of the further camera `name`; their defaults are no pose."""
    position = "optical frame of this further camera in the table frame, x y z [m]"
    orientation = "its orientation, x y z w; zeros: not known, needed with extrinsics parameters"
    return (
        Parameter(f"{name}.{POSITION}", [0.0] * 3, position, -10.0, 10.0, read_only=True),
        Parameter(f"{name}.{QUATERNION}", [0.0] * 4, orientation, -1.0, 1.0, read_only=True),
    )


def mark_of(values: dict[str, Any]) -> Mark:
    """The calibration mark of the parameters. Raises InputError: the outline is not a list of corners, or has a symmetry."""
    try:
        corners = [[float(number) for number in corner.split(",")] for corner in values["mark_outline"].split()]
        outline = np.array(corners, dtype=np.float64)
    except ValueError:
        raise InputError(f"mark_outline is {values['mark_outline']!r}, expected corners such as '0,0 0.15,0 0,0.1' in metres.") from None
    x, y, yaw = values["mark_pose"]
    return Mark(outline, values["mark_height"], (x, y, yaw))


class Extrinsics(ABC):
    """A source of the pose of one camera."""

    refusal = "without_extrinsics"
    """Key in diagnostics of frames without a pose."""
    progress = ""
    """Of the search, for diagnostics."""

    @abstractmethod
    def find(self, frame: DepthFrame) -> Float64Array | None:
        """Optical frame in the table frame, shape (4, 4), or None: call again with the next frame. Never waits.

        Raises PerceptionError: not to be found with this frame; the text says why.
        """


class FromParameters(Extrinsics):
    """The pose that the parameters give."""

    def __init__(self, values: dict[str, Any], prefix: str = "") -> None:
        """`prefix`: of the parameters of a further camera, such as `side.`. Raises InputError: they give none."""
        try:
            self._pose = pose_of_quaternion(values[prefix + POSITION], values[prefix + QUATERNION])
        except InputError as error:
            raise InputError(f"{error} Give {prefix}{POSITION} and {prefix}{QUATERNION}, or choose other extrinsics.") from None

    def find(self, frame: DepthFrame) -> Float64Array | None:
        """At once."""
        return self._pose


class FromMark(Extrinsics):
    """Calibrated from frames at rest that show the mark."""

    refusal = "calibrations_failed"

    def __init__(self, mark: Mark, n_frames: int) -> None:
        self._mark, self._needed = mark, n_frames
        self._frames: list[DepthFrame] = []
        self.calibration: Calibration | None = None

    def find(self, frame: DepthFrame) -> Float64Array | None:
        """Collect frames; when there are enough, calibrate from them, or start over and say why it failed."""
        self._frames.append(frame)
        n = len(self._frames)
        self.progress = f"{n} of {self._needed} frames" if n < self._needed else ""
        if n < self._needed:
            return None
        frames, self._frames = self._frames, []
        try:
            self.calibration = calibrate(frames, self._mark)
        except PerceptionError as error:
            raise PerceptionError(f"no extrinsics from the mark: {error}") from None
        return self.calibration.camera_in_table


class FromTf(Extrinsics):
    """The pose of the frame that the images are in, as soon as tf2 has it, where that is installed; one for all cameras."""

    def __init__(self, node: Node) -> None:
        """Listen. Raises InputError: tf2_ros is not installed."""
        try:
            import tf2_ros  # Not among the Python wheels of ROS: optional.
        except ImportError:
            raise InputError(
                "Parameter extrinsics is tf, but tf2_ros is not installed; give camera_position and camera_quaternion."
            ) from None
        self._error = tf2_ros.TransformException
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def find(self, frame: DepthFrame) -> Float64Array | None:
        """As `Extrinsics`."""
        if not frame.frame_id:
            raise PerceptionError(
                "the images have no frame_id, expected that of the camera; set it in the driver, or take other extrinsics."
            )
        try:
            transform = self._buffer.lookup_transform(TABLE_FRAME, frame.frame_id, Time()).transform
        except self._error as error:
            raise PerceptionError(f"no transform from {frame.frame_id} to {TABLE_FRAME}: {error}") from None
        at, turn = transform.translation, transform.rotation
        return pose_of_quaternion([at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w])
