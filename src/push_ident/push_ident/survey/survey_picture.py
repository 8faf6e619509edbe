"""The picture of a survey: what the camera sees, over its depth in grey, with a legend below that gives the reasons.

It is read on a phone: capital letters are a 45th of the width high, colours are those of Okabe and Ito, and what a colour says a number, a
name or a pattern says as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.outline import points_in_polygon, signed_distance
from push_ident.limits import printable
from push_ident.perception.frame.view import ROBOT, TABLE, FrameView, points_in_table
from push_ident.perception.refusals import Reason, Refusal
from push_ident.survey.survey import Survey, SurveyedObject
from push_ident.types import BoolArray, Float64Array

__all__ = ["draw_survey", "is_small", "png_of", "size_text"]

Picture = NDArray[np.uint8]
"""Shape (rows, columns, 3), blue, green, red."""
_Colour = tuple[int, int, int]

_LEAST_WIDTH: Final = 1280
"""Smaller images are enlarged to this width, so that lines and letters are smooth [px]."""
_LETTER: Final = 1 / 45
"""Height of a capital letter over the width of the picture [-]."""
_LINE: Final = 1.75
"""Distance of two lines of text, in heights of a capital letter [-]."""
_PAD: Final = 0.7
"""Margin of text, likewise [-]."""
_TABLE_COLOUR: Final[_Colour] = (178, 114, 0)
_OBJECT_COLOUR: Final[_Colour] = (115, 158, 0)
_REFUSED_COLOUR: Final[_Colour] = (0, 159, 230)
_UNMEASURED_COLOUR: Final[_Colour] = (167, 121, 204)
_FAILURE_COLOUR: Final[_Colour] = (0, 94, 213)
_ROBOT_COLOUR: Final[_Colour] = (66, 228, 240)
"""Blue, bluish green, orange, reddish purple, vermillion and yellow of Okabe and Ito, in the order blue, green, red."""
_INK: Final[_Colour] = (48, 36, 28)
_PAPER: Final[_Colour] = (255, 255, 255)
_TINT: Final = 0.4
"""Share of the colour on the table [-]."""
_STRIPES: Final = 16
"""Distance of the stripes where nothing is measured, over 1280 px of width [px]."""
_MOST_REASONS: Final = 10
"""Refusals that the legend lists; the page has all."""
_AXIS: Final = 0.1
"""Length of the axes of the table frame [m]."""
_SEEN: Final = 1e-3
"""Fraction of the pixels from which a colour has a line in the legend [-]."""
_SPECK: Final = 16
"""Borders with fewer pixels are left out beside a longer one."""
_BESIDE: Final = 0.006
"""Points up to this distance outside the outline of an object are its walls, not those of another thing [m]."""
_NEAREST: Final = 0.05
"""What is nearer to the plane of the camera than this is not drawn [m]."""


def draw_survey(survey: Survey) -> Picture:
    """The picture and its legend."""
    size = max(1.0, _LEAST_WIDTH / survey.frame.depth.shape[1])
    canvas = _Canvas(survey, size)
    canvas.workspace()
    canvas.axes()
    shown = [refusal for refusal in survey.refused if not is_small(refusal)]
    masks = _pixels_of(survey, survey.refused)
    refused = [canvas.contours(mask) for mask in masks]
    objects = [[canvas.project(own.outline, own.top)] for own in survey.objects]
    for refusal, lines in zip(survey.refused, refused, strict=True):
        canvas.outline(lines, _REFUSED_COLOUR, thin=is_small(refusal))
    for lines in objects:
        canvas.outline(lines, _OBJECT_COLOUR)
    for own, lines in zip(survey.objects, objects, strict=True):
        canvas.label([own.object_id, *size_text(own).split(", ")], lines, _OBJECT_COLOUR)
    numbered = [(lines, mask) for lines, mask, refusal in zip(refused, masks, survey.refused, strict=True) if not is_small(refusal)]
    for number, (lines, mask) in enumerate(numbered, start=1):
        canvas.label([str(number)], lines, _REFUSED_COLOUR, mask)
    return np.vstack([canvas.picture, _legend(survey, shown, canvas)])


def png_of(picture: Picture) -> bytes:
    """The picture as a PNG file."""
    _, content = cv2.imencode(".png", picture)
    return content.tobytes()


def is_small(refusal: Refusal) -> bool:
    """Whether it is one of the many small patches that are not listed one by one."""
    return refusal.reason is Reason.TOO_SMALL


def size_text(own: SurveyedObject) -> str:
    """Size and height of an object for people."""
    return f"{100 * own.size[0]:.1f} x {100 * own.size[1]:.1f} cm, {100 * own.height:.1f} cm high"


class _Canvas:
    """The enlarged depth image, and drawing in metres on it."""

    def __init__(self, survey: Survey, size: float) -> None:
        self._survey, self._size = survey, size
        self._to_camera = np.linalg.inv(survey.camera_in_table)
        self._taken: list[tuple[int, int, int, int]] = []
        self._outlined: list[tuple[int, int, int, int]] = []
        self.picture, self.share_on_robot = _background(survey, size)
        self._thick = max(2, round(self.picture.shape[1] / 420))

    def workspace(self) -> None:
        """The border of the workspace on the table, dashed."""
        (x0, y0), (x1, y1) = self._survey.settings.workspace_low, self._survey.settings.workspace_high
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        share = np.linspace(0.0, 1.0, 61)[:, None]
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            pixels = self.project((1 - share) * start + share * end, 0.0)
            for first, second in zip(pixels[:-1:2], pixels[1::2], strict=True):
                if np.isfinite(first).all() and np.isfinite(second).all():
                    for colour, more in ((_PAPER, 3), (_TABLE_COLOUR, 0)):
                        cv2.line(self.picture, _pixel(first), _pixel(second), colour, self._thick + more, cv2.LINE_AA)

    def axes(self) -> None:
        """x and y of the table frame at its origin."""
        ends = self.project(np.array([(0.0, 0.0), (_AXIS, 0.0), (0.0, _AXIS)]), 0.0)
        if not np.isfinite(ends).all():
            return
        for end, name in zip(ends[1:], "xy", strict=True):
            for colour, more in ((_PAPER, 4), (_INK, 0)):
                cv2.arrowedLine(self.picture, _pixel(ends[0]), _pixel(end), colour, self._thick + more, cv2.LINE_AA, tipLength=0.2)
            _write(self.picture, name, (int(end[0]) + 6, int(end[1]) + 6), _INK, self.picture.shape[1], halo=True)

    def contours(self, mask: BoolArray) -> list[Float64Array]:
        """Outer borders of pixels of the image, shape (n, 2) each, in pixels of the enlarged picture; the largest first."""
        found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        found = sorted(found, key=lambda border: -len(border))
        return [(border[:, 0].astype(np.float64) + 0.5) * self._size - 0.5 for border in found if len(border) > _SPECK] or [
            (border[:, 0].astype(np.float64) + 0.5) * self._size - 0.5 for border in found[:1]
        ]

    def outline(self, lines: Sequence[Float64Array], colour: _Colour, *, thin: bool = False) -> None:
        """Closed lines [px], shape (n, 2) each."""
        for pixels in lines:
            if not np.isfinite(pixels).all():
                continue
            corners = np.rint(pixels).astype(np.int32)[:, None]
            if not thin:
                cv2.polylines(self.picture, [corners], True, _PAPER, self._thick + 4, cv2.LINE_AA)
            cv2.polylines(self.picture, [corners], True, colour, max(1, self._thick // 2) if thin else self._thick + 1, cv2.LINE_AA)
            if not thin:
                low, high = pixels.min(axis=0), pixels.max(axis=0)
                self._outlined += [(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))]

    def label(self, texts: Sequence[str], lines: Sequence[Float64Array], colour: _Colour, inside: BoolArray | None = None) -> None:
        """Text beside closed lines [px], where it hides as little as possible, or amid the pixels `inside`, where they have room for it."""
        if not lines or not np.isfinite(lines[0]).all():
            return
        columns, rows = self.picture.shape[1], self.picture.shape[0]
        letter = _LETTER * columns
        width = max(_text_width(text, columns) for text in texts) + int(2 * _PAD * letter)
        tall = int((len(texts) - 1) * _LINE * letter + (1 + 2 * _PAD) * letter)
        (left, top), (right, bottom) = lines[0].min(axis=0), lines[0].max(axis=0)
        gap = 0.4 * letter
        across = (left - width - gap, left, 0.5 * (left + right - width), right - width, right + gap)
        down = (top - tall - gap, top, 0.5 * (top + bottom - tall), bottom - tall, bottom + gap)
        places = [(x, y) for x in across for y in down]
        boxes = [(int(np.clip(x, 0, max(columns - width, 0))), int(np.clip(y, 0, max(rows - tall, 0))), width, tall) for x, y in places]
        middle = np.array([0.5 * (left + right - width), 0.5 * (top + bottom - tall)])

        def cost(box: tuple[int, int, int, int]) -> float:
            hidden = 3.0 * sum(_overlap(box, other) for other in self._taken) + sum(_overlap(box, other) for other in self._outlined)
            return hidden + letter * float(np.linalg.norm(np.array(box[:2]) - middle)) * 0.1

        amid = None if inside is None else self._amid(inside, width, tall)
        x, y = min(boxes if amid is None else [amid], key=cost)[:2]
        self._taken += [(x, y, width, tall)]
        cv2.rectangle(self.picture, (x, y), (x + width, y + tall), _PAPER, -1)
        cv2.rectangle(self.picture, (x, y), (x + width, y + tall), colour, self._thick)
        for index, text in enumerate(texts):
            _write(self.picture, text, (x + int(_PAD * letter), y + int((_PAD + index * _LINE) * letter)), _INK, columns)

    def _amid(self, inside: BoolArray, width: int, tall: int) -> tuple[int, int, int, int] | None:
        """The box of a label in the middle of the widest part of a mask of the image; None where it would hide most of that."""
        room = cv2.distanceTransform(np.pad(inside.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1] * self._size
        row, column = np.unravel_index(int(np.argmax(room)), room.shape)
        if room[row, column] < 0.6 * max(width, tall):
            return None
        return int((column + 0.5) * self._size - 0.5 * width), int((row + 0.5) * self._size - 0.5 * tall), width, tall

    def project(self, outline: Float64Array, height: float) -> Float64Array:
        """Pixels of the enlarged picture, shape (n, 2); NaN behind the camera."""
        camera = self._survey.frame.intrinsics
        points = np.column_stack([outline, np.full(len(outline), height), np.ones(len(outline))]) @ self._to_camera.T
        with np.errstate(divide="ignore", invalid="ignore"):
            u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
            v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
        pixels = (np.column_stack([u, v]) + 0.5) * self._size - 0.5
        pixels[points[:, 2] < _NEAREST] = np.nan
        return np.clip(pixels, -1e4, 1e4)


def _pixels_of(survey: Survey, refused: Sequence[Refusal]) -> list[BoolArray]:
    """Pixels of each refusal, shape (height, width): higher than the table, in its outline and in no smaller one, and on no object."""
    points = points_in_table(survey.frame, survey.camera_in_table)
    with np.errstate(invalid="ignore"):
        rows, columns = np.nonzero(points[..., 2] > 0.5 * survey.least_height)
    own = points[rows, columns, :2].astype(np.float64)
    owner = np.full(len(own), -1)
    for index in sorted(range(len(refused)), key=lambda i: -_area(refused[i].outline)):
        owner[points_in_polygon(own, _grown(refused[index].outline))] = index
    for known in survey.objects:
        near = np.flatnonzero(np.all((own > known.outline.min(axis=0) - _BESIDE) & (own < known.outline.max(axis=0) + _BESIDE), axis=1))
        owner[near[signed_distance(own[near], known.outline) < _BESIDE]] = -1
    masks = []
    for index in range(len(refused)):
        mask = np.zeros(survey.frame.depth.shape, dtype=bool)
        mask[rows[owner == index], columns[owner == index]] = True
        masks.append(mask)
    return masks


def _area(outline: Float64Array) -> float:
    return float(cv2.contourArea(outline.astype(np.float32))) if len(outline) > 2 else 0.0


def _grown(outline: Float64Array) -> Float64Array:
    """A convex outline a little larger, so that the points that it was made of lie inside."""
    middle = outline.mean(axis=0)
    return np.asarray(middle + 1.02 * (outline - middle))


def _background(survey: Survey, size: float) -> tuple[Picture, float]:
    """Depth in grey, near is light; table and robot tinted, stripes where nothing is measured; and the fraction of pixels on the robot."""
    depth = survey.frame.depth
    rows, columns = round(depth.shape[0] * size), round(depth.shape[1] * size)
    near, far = (float(value) for value in np.nanquantile(depth, [0.01, 0.99]))
    grey = np.nan_to_num(np.clip(235 - 165 * (depth - near) / max(far - near, 1e-3), 60, 245), nan=90.0).astype(np.float32)
    measured = np.isfinite(depth)
    settings = replace(survey.settings, min_object_height=survey.least_height)
    labels = FrameView(survey.frame, survey.camera_in_table, settings=settings).labels
    image = cv2.resize(np.repeat(grey[..., None], 3, axis=2), (columns, rows), interpolation=cv2.INTER_NEAREST)

    def enlarged(mask: BoolArray) -> BoolArray:
        return np.asarray(cv2.resize(mask.astype(np.uint8), (columns, rows), interpolation=cv2.INTER_NEAREST) > 0)

    for label, colour in ((TABLE, _TABLE_COLOUR), (ROBOT, _ROBOT_COLOUR)):
        tinted = enlarged((labels == label) & measured)
        image[tinted] = (1 - _TINT) * image[tinted] + _TINT * np.array(colour, np.float32)
    period = max(4, round(_STRIPES * columns / _LEAST_WIDTH))
    striped = (np.arange(rows)[:, None] + np.arange(columns)) % period < period // 4
    without = enlarged(~measured)
    image[without] = 60.0
    image[without & striped] = _UNMEASURED_COLOUR
    return np.clip(image, 0, 255).astype(np.uint8), float(np.mean((labels == ROBOT) & measured))


def _legend(survey: Survey, shown: Sequence[Refusal], canvas: _Canvas) -> Picture:
    """Colours, sizes and reasons, one below the other."""
    columns, rows = canvas.picture.shape[1], _legend_rows(survey, shown, canvas.share_on_robot)
    letter = _LETTER * columns
    indent = int(3.2 * letter)
    lines = [(kind, colour, _wrapped(text, columns - indent - int(letter), columns)) for kind, colour, text in rows]
    height = int(letter * (2 * _PAD + sum(len(texts) * _LINE + 0.25 for _, _, texts in lines)))
    legend = np.full((height, columns, 3), 255, np.uint8)
    y = _PAD * letter
    for kind, colour, texts in lines:
        _swatch(legend, (int(_PAD * letter), int(y)), int(letter), kind, colour)
        for index, line in enumerate(texts):
            _write(legend, line, (indent, int(y + index * _LINE * letter)), _INK, columns)
        y += (len(texts) * _LINE + 0.25) * letter
    return legend


def _legend_rows(survey: Survey, shown: Sequence[Refusal], share_on_robot: float) -> list[tuple[str, _Colour, str]]:
    """Kind of the sample, its colour, and the text."""
    low, high = survey.settings.workspace_low, survey.settings.workspace_high
    rows: list[tuple[str, _Colour, str]] = []
    if survey.failure:
        rows.append(("full", _FAILURE_COLOUR, f"Perception refuses these images: {survey.failure}"))
    rows.append(
        ("full", _TABLE_COLOUR, f"table, {100 * (high[0] - low[0]):.0f} x {100 * (high[1] - low[1]):.0f} cm of it (dashed); x, y: 10 cm")
    )
    if share_on_robot > _SEEN:
        rows.append(("full", _ROBOT_COLOUR, f"higher than {100 * survey.settings.max_object_height:.0f} cm: taken for the robot"))
    if survey.share_measured < 1 - _SEEN:
        rows.append(("striped", _UNMEASURED_COLOUR, f"nothing measured: {100 * (1 - survey.share_measured):.1f} % of the pixels"))
    rows += [("line", _OBJECT_COLOUR, f"{own.object_id}: {size_text(own)}") for own in survey.objects]
    if not survey.objects and not survey.failure:
        rows.append(("line", _OBJECT_COLOUR, f"no object: {survey.why_no_object}" if not shown else "no object was taken in"))
    for number, refusal in enumerate(shown[:_MOST_REASONS], start=1):
        rows.append(("line", _REFUSED_COLOUR, f"{number}: no object, {refusal.why}"))
    if len(shown) > _MOST_REASONS:
        rows.append(("line", _REFUSED_COLOUR, f"and {len(shown) - _MOST_REASONS} more that are no objects"))
    if n_small := len(survey.refused) - len(shown):
        rows.append(("thin", _REFUSED_COLOUR, f"{n_small} {'patch' if n_small == 1 else 'patches'} smaller than min_object_area"))
    return rows


def _swatch(legend: Picture, at: tuple[int, int], letter: int, kind: str, colour: _Colour) -> None:
    """The sample of a colour, two letters wide."""
    x, y = at
    if kind in ("line", "thin"):
        thick = max(2, letter // 7) if kind == "line" else 1
        cv2.rectangle(legend, (x + 2, y), (x + 2 * letter - 2, y + letter), colour, thick)
        return
    area = legend[y : y + letter, x : x + 2 * letter]
    area[:] = colour
    if kind == "striped":
        period = max(4, round(_STRIPES * legend.shape[1] / _LEAST_WIDTH))
        area[(np.arange(area.shape[0])[:, None] + np.arange(area.shape[1])) % period >= period // 4] = 60


@lru_cache(maxsize=8)
def _letters(columns: int) -> tuple[float, int]:
    """Scale and thickness of the font for a picture of that width: measured, because versions of OpenCV bring different fonts."""
    probe = np.zeros((120, 120), np.uint8)
    cv2.putText(probe, "H", (20, 80), cv2.FONT_HERSHEY_SIMPLEX, 2.0, 255, 2, cv2.LINE_AA)
    rows = np.flatnonzero((probe > 127).any(axis=1))
    return 2.0 * _LETTER * columns / max(int(rows[-1] - rows[0] + 1), 1), max(1, round(columns / 640))


def _text_width(text: str, columns: int) -> int:
    scale, thick = _letters(columns)
    return int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)[0][0])


def _write(picture: Picture, text: str, at: tuple[int, int], colour: _Colour, columns: int, *, halo: bool = False) -> None:
    """Text with its upper left corner at a pixel; only what OpenCV can write."""
    scale, thick = _letters(columns)
    line = printable(text).encode("ascii", "replace").decode()
    place = (at[0], at[1] + round(_LETTER * columns))
    if halo:
        cv2.putText(picture, line, place, cv2.FONT_HERSHEY_SIMPLEX, scale, _PAPER, thick + 4, cv2.LINE_AA)
    cv2.putText(picture, line, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thick, cv2.LINE_AA)


def _wrapped(text: str, width: int, columns: int) -> list[str]:
    """Lines of at most `width` pixels; a word that is longer is cut."""
    lines, line = [], ""
    for word in text.split():
        longer = f"{line} {word}".strip()
        if line and _text_width(longer, columns) > width:
            lines.append(line)
            longer = word
        line = longer
    return [*lines, line]


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> float:
    """Common area of two boxes (x, y, width, height) [px^2]."""
    wide = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    tall = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    return float(max(wide, 0) * max(tall, 0))


def _pixel(at: Float64Array) -> tuple[int, int]:
    return round(float(at[0])), round(float(at[1]))
