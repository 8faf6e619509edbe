"""The figure of a survey as SVG: the depth image, and on it the objects and what was refused, numbered as in the tables of the page.

Colours are those of Okabe and Ito; what a colour says a number, a name or a pattern says as well.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from push_ident.geometry.outline import points_in_polygon, signed_distance
from push_ident.pages.chart import WIDTH, svg_of, titled_polygon
from push_ident.perception.frame.view import ROBOT, TABLE, FrameView, points_in_table
from push_ident.perception.refusals import Reason, Refusal
from push_ident.survey.survey import Survey, SurveyedObject, hull_area
from push_ident.types import BoolArray, Float64Array

_TABLE_COLOUR: Final = "#0072b2"
_OBJECT_COLOUR: Final = "#009e73"
_REFUSED_COLOUR: Final = "#e69f00"
_UNMEASURED_COLOUR: Final = "#cc79a7"
_ROBOT_COLOUR: Final = "#f0e442"


@dataclass(frozen=True, slots=True)
class SurveyFigure:
    """A figure for a page, and its colours."""

    svg: str
    legend: tuple[tuple[str, str], ...]
    """Colours of CSS and what they mean."""


def draw_survey(survey: Survey) -> SurveyFigure:
    """The figure, with its legend."""
    image, share_on_robot = _image(survey)
    rows, columns = survey.frame.depth.shape
    height = WIDTH * rows / columns
    encoded = base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode("ascii")
    parts = [f'<image width="{WIDTH:g}" height="{height:.1f}" href="data:image/png;base64,{encoded}"/>']
    (x0, y0), (x1, y1) = survey.settings.workspace_low, survey.settings.workspace_high
    corners, along = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]), np.linspace(0.0, 4.0, 241)
    border = np.column_stack([np.interp(along, np.arange(5), corners[:, axis]) for axis in (0, 1)])
    parts += _line(survey, _project(survey, border, 0.0), "workspace", "workspace", closed=False)
    axes = _project(survey, np.array([(0.1, 0.0), (0.0, 0.0), (0.0, 0.1)]), 0.0)
    parts += _line(survey, axes, "axes", "x and y of the table frame, 10 cm", closed=False)
    parts += [_label(survey, end, name) for end, name in zip(axes[::2], "xy", strict=True)]
    labels, number = [], 0
    for refusal, mask in zip(survey.refused, _pixels_of(survey, survey.refused), strict=True):
        style = "small" if is_small(refusal) else "refused"
        for pixels in _borders(mask):
            parts += _line(survey, pixels, style, f"no object: {refusal.why}")
        if not is_small(refusal):
            number += 1
            labels.append(_label(survey, _widest(mask), str(number)))
    for one in survey.objects:
        pixels = _project(survey, one.outline, one.top)
        parts += _line(survey, pixels, "object", f"{one.object_id}: {size_text(one)}")
        labels.append(_label(survey, pixels.mean(axis=0), one.object_id))
    svg = svg_of("Depth, near is light, with the table, what is on it and what was refused", height, [*parts, *labels])
    return SurveyFigure(svg, _legend(survey, share_on_robot))


def is_small(refusal: Refusal) -> bool:
    """Whether it is one of the many small patches that are not listed one by one."""
    return refusal.reason in (Reason.TOO_SMALL, Reason.TOO_LOW)


def size_text(one: SurveyedObject) -> str:
    """Size and height of an object for people."""
    return f"{100 * one.size[0]:.1f} x {100 * one.size[1]:.1f} cm, {100 * one.height:.1f} cm high"


def _line(survey: Survey, pixels: Float64Array, style: str, text: str, *, closed: bool = True) -> list[str]:
    """A line over a wider light one, so that it stands out from every grey; none where a part of it is behind the camera."""
    if not np.isfinite(pixels).all():
        return []
    unit = WIDTH / survey.frame.depth.shape[1]
    around = [] if style in ("small", "workspace") else ["around"]
    return [
        titled_polygon(pixels, lambda at: (unit * (at[0] + 0.5), unit * (at[1] + 0.5)), name, text, closed=closed)
        for name in (*around, style)
    ]


def _label(survey: Survey, pixel: Float64Array, text: str) -> str:
    unit = WIDTH / survey.frame.depth.shape[1]
    x, y = np.nan_to_num(unit * (pixel + 0.5), nan=-WIDTH)
    return f'<text class="on-image" x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle">{text}</text>'


def _borders(mask: BoolArray) -> list[Float64Array]:
    """Outer borders of pixels of the image [px], shape (n, 2) each; the largest first, specks left out beside it."""
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    borders = sorted((border[:, 0].astype(np.float64) for border in found), key=len, reverse=True)
    return [border for border in borders if len(border) > 16] or borders[:1]


def _widest(mask: BoolArray) -> Float64Array:
    """The middle of the widest part of a mask [px]."""
    room = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(room)), room.shape)
    return np.array([column, row], dtype=np.float64)


def _project(survey: Survey, outline: Float64Array, height: float) -> Float64Array:
    """Pixels of points of the table frame, shape (n, 2); NaN behind the camera or within 5 cm of it."""
    camera = survey.frame.intrinsics
    points = np.column_stack([outline, np.full(len(outline), height), np.ones(len(outline))]) @ np.linalg.inv(survey.camera_in_table).T
    points[points[:, 2] < 0.05] = np.nan
    pixels = np.array([camera.fx, camera.fy]) * points[:, :2] / points[:, 2:3] + np.array([camera.cx, camera.cy])
    return np.clip(pixels, -1e4, 1e4)


def _pixels_of(survey: Survey, refused: Sequence[Refusal], wall: float = 0.006) -> list[BoolArray]:
    """Pixels of each refusal, shape (height, width): higher than the table, in its outline and in no smaller one, and on no object.

    `wall`: points up to this distance outside the outline of an object are its walls, not those of another one [m].
    """
    points = points_in_table(survey.frame, survey.camera_in_table)
    with np.errstate(invalid="ignore"):
        rows, columns = np.nonzero(points[..., 2] > 0.5 * survey.least_height)
    own = points[rows, columns, :2].astype(np.float64)
    owner = np.full(len(own), -1)
    for index in sorted(range(len(refused)), key=lambda i: -hull_area(refused[i].outline)):
        outline = refused[index].outline
        middle = outline.mean(axis=0)
        # A little larger, so that the points that the convex outline was made of lie inside.
        owner[points_in_polygon(own, middle + 1.02 * (outline - middle))] = index
    for known in survey.objects:
        near = np.flatnonzero(np.all((own > known.outline.min(axis=0) - wall) & (own < known.outline.max(axis=0) + wall), axis=1))
        owner[near[signed_distance(own[near], known.outline) < wall]] = -1
    masks = []
    for index in range(len(refused)):
        mask = np.zeros(survey.frame.depth.shape, dtype=bool)
        mask[rows[owner == index], columns[owner == index]] = True
        masks.append(mask)
    return masks


def _image(survey: Survey) -> tuple[np.ndarray, float]:
    """Depth in grey, near is light; table and robot tinted, stripes where nothing is measured; and the fraction of pixels on the robot."""
    depth = survey.frame.depth
    near, far = (float(value) for value in np.nanquantile(depth, [0.01, 0.99]))
    grey = np.nan_to_num(np.clip(235 - 165 * (depth - near) / max(far - near, 1e-3), 60, 245), nan=60.0).astype(np.float32)
    measured = np.isfinite(depth)
    settings = replace(survey.settings, min_object_height=survey.least_height)
    labels = FrameView(survey.frame, survey.camera_in_table, settings=settings).labels
    image, tint = np.repeat(grey[..., None], 3, axis=2), 0.4
    for label, colour in ((TABLE, _TABLE_COLOUR), (ROBOT, _ROBOT_COLOUR)):
        tinted = (labels == label) & measured
        image[tinted] = (1 - tint) * image[tinted] + tint * _bgr(colour)
    rows, columns = depth.shape
    period = max(4, columns // 80)
    striped = (np.arange(rows)[:, None] + np.arange(columns)) % period < period // 4
    image[~measured & striped] = _bgr(_UNMEASURED_COLOUR)
    return np.clip(image, 0, 255).astype(np.uint8), float(np.mean((labels == ROBOT) & measured))


def _bgr(colour: str) -> np.ndarray:
    """Blue, green, red of a colour of CSS."""
    return np.array([int(colour[k : k + 2], 16) for k in (5, 3, 1)], np.float32)


def _legend(survey: Survey, share_on_robot: float, least: float = 1e-3) -> tuple[tuple[str, str], ...]:
    """Colours and what they mean, for those that the figure has, on a fraction of the pixels above `least`."""
    low, high = survey.settings.workspace_low, survey.settings.workspace_high
    n_small = sum(map(is_small, survey.refused))
    rows = [
        (True, _TABLE_COLOUR, f"table; workspace dashed, {100 * (high[0] - low[0]):.0f} x {100 * (high[1] - low[1]):.0f} cm; x, y: 10 cm"),
        (share_on_robot > least, _ROBOT_COLOUR, f"higher than {100 * survey.settings.max_object_height:.0f} cm: taken for the robot"),
        (
            survey.share_measured < 1 - least,
            _UNMEASURED_COLOUR,
            f"striped: nothing measured, {100 * (1 - survey.share_measured):.1f} % of the pixels",
        ),
        (bool(survey.objects), _OBJECT_COLOUR, "object"),
        (len(survey.refused) > n_small, _REFUSED_COLOUR, "not taken in, numbered as below"),
        (n_small > 0, _REFUSED_COLOUR, "thin: smaller than min_object_area, or no higher than the noise there"),
    ]
    return tuple((colour, text) for shown, colour, text in rows if shown)
