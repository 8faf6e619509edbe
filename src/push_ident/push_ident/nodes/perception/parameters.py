"""Parameters of perception_node, and the settings made of them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Final

from push_ident.errors import InputError
from push_ident.nodes.base.frames import PUBLISH_TF
from push_ident.nodes.base.parameters import Parameter
from push_ident.perception.settings import PerceptionSettings
from push_ident.survey.parameter_file import HEADING_STD, POSITION_STD
from push_ident.types import CameraAccuracy

_DEFAULTS: Final = PerceptionSettings()


@dataclass(frozen=True, slots=True)
class ImageTimes:
    """What counts as late, that is no parameter."""

    stale: float = 0.5
    """Tool poses and joint states that much older than the image are reported [s]."""
    silence: float = 2.0
    """Without a depth image for so long the node reports it [s], receive time."""
    queued: float = 1.0
    """How long an image of a driver that was stopped may still wait for this node [s]: the queue of a sensor has five images."""


IMAGE_TIMES: Final = ImageTimes()

_SETTINGS: Final = (
    Parameter("workspace_low", list(_DEFAULTS.workspace_low), "smallest x and y of the workspace [m]", -5.0, 5.0),
    Parameter("workspace_high", list(_DEFAULTS.workspace_high), "largest x and y of the workspace [m]", -5.0, 5.0),
    Parameter("min_object_height", _DEFAULTS.min_object_height, "lower points belong to the table [m]", 0.002, 0.5),
    Parameter("max_object_height", _DEFAULTS.max_object_height, "higher points belong to the robot [m]", 0.01, 1.0),
    Parameter("min_object_area", _DEFAULTS.min_object_area, "smaller objects are ignored [m^2]", 1e-5, 1.0),
    Parameter("min_step", _DEFAULTS.min_step, "surfaces that meet at a higher step are two objects [m]", 0.002, 1.0),
    Parameter("tool_reach", list(_DEFAULTS.tool_reach), "tip and upper end of the tool above the table while it pushes [m]", 0.0, 1.0),
    Parameter("mask_margin", _DEFAULTS.mask_margin, "added to tool and arm when they are masked [m]", 0.0, 0.1),
    Parameter("rest_frames", _DEFAULTS.rest_frames, "frames at rest before an object is accepted", 1, 300),
    Parameter("rest_distance", _DEFAULTS.rest_distance, "an object that stays this near, or within a pixel, is at rest [m]", 1e-4, 0.05),
    Parameter("cell_count", _DEFAULTS.cell_count, "cells aimed at per object", 1, 2000),
    Parameter("grid_resolution", _DEFAULTS.grid_resolution, "edge of a cell of the workspace occupancy [m]", 5e-4, 0.1),
    Parameter("occupancy_period", _DEFAULTS.occupancy_period, "between two workspace occupancies [s]", 0.05, 60.0),
    Parameter("search_period", _DEFAULTS.search_period, "between two searches for new or lost objects once one is known [s]", 0.0, 60.0),
)

_ACCURACY: Final = (
    Parameter(
        POSITION_STD,
        _DEFAULTS.camera_accuracy.position,
        "standard deviation of the place of the main camera along x and y of `table`, from its calibration [m]",
        0.0,
        0.1,
    ),
    Parameter(
        HEADING_STD,
        _DEFAULTS.camera_accuracy.heading,
        "standard deviation of the rotation of the main camera about z of `table`, from its calibration [rad]",
        0.0,
        0.2,
    ),
)

_DEFAULT_OF: Final = {row.name: row.default for row in _SETTINGS}

PARAMETERS: Final = (
    *_SETTINGS,
    *_ACCURACY,
    Parameter(
        "robot_description_file", "", "URDF of the arm, root link `table`; empty: taken from the topic robot_description", read_only=True
    ),
    Parameter(
        "extrinsics", "parameters", "where the poses of all cameras come from", choices=("parameters", "tf", "calibrate"), read_only=True
    ),
    Parameter("camera_position", [0.55, 0.0, 0.85], "optical frame in the table frame, x y z [m]", -10.0, 10.0, read_only=True),
    Parameter(
        "camera_quaternion",
        [0.67815377, 0.67815377, -0.20026847, -0.20026847],
        "orientation of the optical frame in the table frame, x y z w",
        -1.0,
        1.0,
        read_only=True,
    ),
    Parameter(
        "extra_cameras",
        [""],
        "names of further cameras, which add to the shape of an object: each has topics `<name>/depth/image_rect`, "
        "`<name>/depth/camera_info` and parameters `<name>.camera_position`, `<name>.camera_quaternion`",
        read_only=True,
    ),
    Parameter("tool_radius", 0.02, "radius of the tool that is masked until pusher/shape gives another [m]", 0.0, 0.3),
    Parameter("tool_length", 0.08, "from the tip of the tool to the hand that holds it, until pusher/shape gives another [m]", 0.0, 1.0),
    Parameter("hand_radius", 0.09, "radius of the hand above the tool that is masked [m]", 0.0, 0.5),
    Parameter("link_radius", 0.1, "thickness of the arm's links that its description gives as meshes [m]", 0.01, 0.5, read_only=True),
    Parameter("state_directory", "", "where the shapes and poses of objects are kept through restarts; empty: nowhere", read_only=True),
    Parameter("extrinsics_timeout", 10.0, "without extrinsics for so long the node reports an error [s]", 0.1, 3600.0),
    Parameter(
        "mark_outline", "0,0 0.15,0 0,0.1", "corners x,y x,y ... of the calibration mark in its own frame, no symmetry [m]", read_only=True
    ),
    Parameter("mark_height", 0.03, "of the calibration mark [m]", 0.02, 0.3, read_only=True),
    Parameter("mark_pose", [0.0, 0.0, 0.0], "x [m], y [m], yaw [rad] of the calibration mark in `table`", -10.0, 10.0, read_only=True),
    Parameter("calibration_frames", 30, "frames at rest that give the extrinsics", 1, 1000, read_only=True),
    Parameter("calibration_file", "", "where calibrated extrinsics are written as a parameter file; empty: nowhere", read_only=True),
    Parameter(
        "every_image",
        False,
        "lose no image and no pose, and report each image that is done: for a source that waits for this node, not for a camera",
        read_only=True,
    ),
    Parameter(
        "max_skew",
        0.0,
        "a depth image and a camera info further apart do not belong together [s]; 0: 1.5 periods of the camera info, as measured",
        0.0,
        10.0,
    ),
    PUBLISH_TF,
)


def perception_settings(values: dict[str, Any]) -> PerceptionSettings:
    """The settings that parameters give; raises InputError when the values contradict each other."""
    names = [row.name for row in _SETTINGS]
    chosen: dict[str, Any] = {name: tuple(values[name]) if isinstance(_DEFAULT_OF[name], list) else values[name] for name in names}
    return PerceptionSettings(**chosen, camera_accuracy=CameraAccuracy(values[POSITION_STD], values[HEADING_STD]))


def names_of_further_cameras(values: dict[str, Any]) -> list[str]:
    """Names of the further cameras. Raises InputError: one is no ROS name, or given twice."""
    names = [name for name in values["extra_cameras"] if name]
    for name in names:
        if not re.fullmatch(r"[a-zA-Z][a-zA-Z0-9_]*", name) or names.count(name) > 1:
            raise InputError(f"extra_cameras has {name!r}, expected different names of letters, digits and _ that begin with a letter.")
    return names
