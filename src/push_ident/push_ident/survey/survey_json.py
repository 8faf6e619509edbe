"""The JSON of a survey."""

from __future__ import annotations

from typing import Any

from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.survey.scale_check import ScaleCheck
from push_ident.survey.survey import Survey

__all__ = ["survey_json"]


def survey_json(survey: Survey, check: ScaleCheck | None) -> dict[str, Any]:
    """As `push-ident look --json` writes it; lengths in metres, angles in radians."""
    camera = survey.camera_in_table
    return {
        "n_frames": survey.n_frames,
        "camera": {
            "position_m": camera[:3, 3].tolist(),
            "quaternion": list(quaternion_of_pose(camera)),
            "tilt": survey.tilt,
            "is_given": survey.is_pose_given,
        },
        "workspace": {"low_m": list(survey.settings.workspace_low), "high_m": list(survey.settings.workspace_high)},
        "min_object_height_m": survey.settings.min_object_height,
        "least_height_m": survey.least_height,
        "noise_m": survey.noise,
        "share_measured": survey.share_measured,
        "share_on_table": survey.share_on_table,
        "bands": [
            {
                "near_m": band.near,
                "far_m": band.far,
                "n_points": band.n_points,
                "deviation_m": band.deviation,
                "over_time_m": band.over_time,
                "median_m": band.median,
            }
            for band in survey.bands
        ],
        "objects": [
            {
                "object_id": surveyed.object_id,
                "size_m": list(surveyed.size),
                "height_m": surveyed.height,
                "top_m": surveyed.top,
                "distance_m": surveyed.distance,
                "outline_m": surveyed.outline.tolist(),
            }
            for surveyed in survey.objects
        ],
        "refused": [
            {"reason": refusal.reason.name.lower(), "why": refusal.why, "height_m": refusal.height, "outline_m": refusal.outline.tolist()}
            for refusal in survey.refused
        ],
        "failure": survey.failure,
        "why_no_object": survey.why_no_object,
        "scale_check": None if check is None else _check_json(check),
        "notes": list(survey.notes),
    }


def _check_json(check: ScaleCheck) -> dict[str, Any]:
    return {
        "object_id": check.object_id,
        "known_m": [check.known.width, check.known.depth, check.known.height],
        "measured_m": list(check.measured),
        "outcome": check.error.value,
        "focal": check.focal,
        "focal_std": check.focal_std,
        "depth_scale": check.depth_scale,
        "depth_scale_std": check.depth_scale_std,
        "within": check.within,
        "sentence": check.sentence,
    }
