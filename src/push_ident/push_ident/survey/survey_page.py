"""The page of a survey: the picture, what is on the table, the noise, and the parameter file; and the same as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.pages.page import write_page
from push_ident.survey.scale_check import ScaleCheck
from push_ident.survey.survey import Survey
from push_ident.survey.survey_picture import draw_survey, is_small


def table_sentence(survey: Survey) -> str:
    """Table and camera in words."""
    low, high = survey.settings.workspace_low, survey.settings.workspace_high
    return (
        f"Table of {100 * (high[0] - low[0]):.0f} x {100 * (high[1] - low[1]):.0f} cm in view; the camera is "
        f"{100 * survey.camera_in_table[2, 3]:.0f} cm above it and tilted by {np.degrees(survey.tilt):.0f} degrees; noise of a height "
        f"{1e3 * survey.noise:.1f} mm, so an object is at least {1e3 * survey.least_height:.1f} mm high."
    )


def write_survey_page(path: Path, survey: Survey, source: str, parameters: str, check: ScaleCheck | str | None) -> None:
    """Write the page of a survey of `source` with its parameter file.

    `check`: outcome of the check of the scale, why there is none, or None where no size was given. Raises InputError where it cannot be
    written.
    """
    listed = [refusal for refusal in survey.refused if not is_small(refusal)]
    context = {
        "title": f"What the camera sees: {source}",
        "survey": survey,
        "sentence": table_sentence(survey),
        "picture": draw_survey(survey),
        "refused": listed,
        "n_small": len(survey.refused) - len(listed),
        "parameters": parameters,
        "check": check,
        "moved": any(band.over_time is not None for band in survey.bands),
    }
    write_page(path, __package__, "survey.html.j2", context)


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
