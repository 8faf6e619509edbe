"""A survey as a parameter file of perception_node."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.limits import plain_text
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from push_ident.survey.survey import Survey

POSITION: Final = "camera_position"
"""Name of the parameter: optical frame in the table frame, x y z [m]."""
QUATERNION: Final = "camera_quaternion"
"""Name of the parameter: its orientation, x y z w."""
POSITION_STD: Final = "camera_position_std"
"""Name of the parameter: standard deviation of the position along x and y of the table frame [m]."""
HEADING_STD: Final = "camera_heading_std"
"""Name of the parameter: standard deviation of the rotation about z of the table frame [rad]."""


def pose_lines(pose: Float64Array, prefix: str = "") -> tuple[str, str]:
    """The two lines of a parameter file that give a camera pose, shape (4, 4).

    `prefix`: of the parameters of a further camera, such as `side.`.
    """
    return (
        f"{prefix}{POSITION}: {[round(float(value), 6) for value in pose[:3, 3]]}",
        f"{prefix}{QUATERNION}: {[round(value, 8) for value in quaternion_of_pose(pose)]}",
    )


def parameter_text(survey: Survey, source: str) -> str:
    """A parameter file of perception_node from a survey; comments say where each number comes from.

    `source`: what was looked at, for the first comment.
    """
    frames = "1 frame" if survey.n_frames == 1 else f"the median of {survey.n_frames} frames"
    if survey.is_pose_given:
        pose = ["The given pose of the camera, turned and moved by the plane of the table."]
    else:
        pose = [
            "Height and tilt come from the plane of the table. No image says where an arm has its origin: here `table` has its origin in",
            "the middle of what is visible of the table and x along the rows of the image. For an arm, calibrate with a mark.",
        ]
    defaults = PerceptionSettings()
    lines = [
        *(f"# {line}" for line in pose),
        *pose_lines(survey.camera_in_table),
        "# Standard deviations of that pose along x and y [m] and about z [rad]. No image shows them: state those of your calibration.",
        f"{POSITION_STD}: {defaults.camera_accuracy.position}",
        f"{HEADING_STD}: {defaults.camera_accuracy.heading}",
        "# The box around 99 % of the points of the table.",
        *(f"{name}: {[round(value, 3) for value in getattr(survey.settings, name)]}" for name in ("workspace_low", "workspace_high")),
    ]
    for name, why in (
        ("min_object_height", "The table itself bulges by more than its noise: that, and four deviations of a height."),
        ("max_object_height", "Anything higher is robot."),
    ):
        if (value := getattr(survey.settings, name)) != getattr(defaults, name):
            lines += [f"# {why}", f"{name}: {round(value, 4)}"]
    head = (
        f"# Made by `push-ident look` from {frames} of {plain_text(source)}. Lengths in metres.\n/**/perception_node:\n  ros__parameters:\n"
    )
    return head + "".join(f"    {line}\n" for line in ["extrinsics: parameters", *lines])
