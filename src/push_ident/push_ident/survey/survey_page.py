"""The page of a survey: the picture, what is on the table, the noise, and the parameter file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from push_ident.pages.page import write_page
from push_ident.survey.scale_check import ScaleCheck
from push_ident.survey.survey import Survey
from push_ident.survey.survey_picture import draw_survey, is_small

__all__ = ["table_sentence", "write_survey_page"]


def table_sentence(survey: Survey) -> str:
    """Table and camera in words."""
    low, high = survey.settings.workspace_low, survey.settings.workspace_high
    return (
        f"Table of {100 * (high[0] - low[0]):.0f} x {100 * (high[1] - low[1]):.0f} cm in view; the camera is "
        f"{100 * survey.camera_in_table[2, 3]:.0f} cm above it and tilted by {np.degrees(survey.tilt):.0f} degrees; noise of a height "
        f"{1e3 * survey.noise:.1f} mm, so an object is at least {1e3 * survey.least_height:.1f} mm high."
    )


def write_survey_page(path: Path, survey: Survey, source: str, parameters: str, check: ScaleCheck | str | None) -> None:
    """Write the page.

    Args:
        path: HTML file.
        source: What was looked at.
        parameters: The parameter file.
        check: Outcome of the check of the scale, why there is none, or None where no size was given.

    Raises:
        InputError: It cannot be written.
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
