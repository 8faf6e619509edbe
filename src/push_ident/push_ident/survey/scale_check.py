"""A check of focal length and depth scale: a box of known size against what the camera measures of it.

Let the images be interpreted with s times the true focal length and k times the true depth. A point at X in the optical frame (x right,
y down, z forward) is then placed at

    X' = k diag(1/s, 1/s, 1) X,

because its pixel is u = f x/z + c. The map is linear: planes stay planes, and the top of a box stays parallel to the table. Fitted to the
same images, the plane of the table does not betray either error. With the tilt t' of the optical axis against the normal of that plane,
as measured (tan t' = s tan t), lengths on the table across the view, lengths along the view, and heights come out as

    across  k / s,
    along   k / sqrt(s^2 cos^2 t' + sin^2 t'),
    height  k sqrt(cos^2 t' + sin^2 t' / s^2)

times the true ones. A wrong depth unit (k) scales all three alike. A wrong focal length (s) scales the widths and, seen from above, leaves
the height: the ratio of width and height tells them apart. The more the view is tilted, the more the height changes too, but less than the
width does. Seen obliquely a wrong focal length also skews what is turned against the view: a rectangle becomes a parallelogram. Errors of
the principal point are not looked for.

The check undoes the map for a candidate (s, k), takes the edges of the rectangle with the second moments of the corrected outline and the
corrected height, and compares. Moments follow a linear map exactly, and the noise of a corner hardly changes them. The simplest explanation
that the errors of measurement allow is reported: none, one, or both. Walls that seem to lean stand out of the outline of the top; so where
the focal length looks wrong, the images are looked at again with the better one until it stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.special import chdtri

from push_ident.errors import InputError, PerceptionError
from push_ident.survey.survey import Survey, SurveyedObject, survey_frames
from push_ident.types import Float64Array

_SIMILAR: Final = (0.3, 3.0)
"""Range of the measured area relative to the known one [-]: a focal length that is wrong by 70 %. Beyond, it is something else."""
_RECTANGLE: Final = (12.0, 12.0, 12.0)
"""Of a rectangle with edges a, b and second central moments C of its unit mass: a^2 + b^2 over trace C, a b over sqrt det C, area over
sqrt det C. The last one does not change under linear maps, so it recognises the kind of an outline whatever the error."""
_TRIANGLE: Final = (18.0, 20.785, 10.392)
"""The same of a right-angled triangle with legs a, b."""
_NAMED: Final = 0.2
"""Deviation of the logarithm of an error above which its size means nothing [-]."""


_NO_BOX: Final = "the outline of {}, the nearest in size, is neither a rectangle nor a right-angled triangle; put such a thing on the table"


class ScaleError(Enum):
    """What explains the measured size; the value is the word of the JSON."""

    NONE = "agrees"
    FOCAL = "focal_length"
    DEPTH = "depth_scale"
    BOTH = "focal_length_and_depth_scale"
    EITHER = "focal_length_or_depth_scale"
    """The data cannot tell them apart."""
    NEITHER = "another_object"
    """No focal length and depth scale explain the size."""


@dataclass(frozen=True, slots=True)
class KnownSize:
    """Edges of a box, or legs of a right-angled mark, and its height; each at least 2 cm, a smaller one has too few pixels."""

    width: float
    """[m]"""
    depth: float
    """[m]"""
    height: float | None = None
    """[m]; without it a wrong focal length and a wrong depth scale can hardly be told apart."""

    def __post_init__(self) -> None:
        for length in (self.width, self.depth, *([] if self.height is None else [self.height])):
            if not 0.02 <= length <= 2.0:
                raise InputError(f"The known size has a length of {length:g} m, expected 0.02 to 2 m; give metres, such as 0.2x0.1x0.05.")


@dataclass(frozen=True, slots=True)
class ScaleCheck:
    """Outcome of the check."""

    object_id: str
    known: KnownSize
    measured: tuple[float, float, float]
    """Width, depth and height as measured [m], in the order of the known ones."""
    error: ScaleError
    focal: float
    """Focal length in use over the true one [-]; of the explanation that was chosen, 1 where it is not part of it."""
    focal_std: float
    """Its standard deviation [-]; 0 where it is not part of the explanation."""
    depth_scale: float
    """Depth in use over the true one [-], likewise."""
    depth_scale_std: float
    within: float
    """Largest relative error of focal length or depth scale alone that the measurement leaves open, at two deviations [-]."""
    sentence: str
    """The outcome in words."""


@dataclass(frozen=True, slots=True)
class _Fit:
    """The best focal length and depth scale of one explanation."""

    log_focal: float
    log_scale: float
    std: tuple[float, float]
    chi2: float
    residual: float
    """Largest relative difference of a length that is left [-]."""


@dataclass(frozen=True, slots=True)
class _Moments:
    """An outline as its second moments."""

    second: Float64Array
    """Second central moments of unit mass [m^2], shape (2, 2)."""
    kind: tuple[float, float, float]
    """`_RECTANGLE` or `_TRIANGLE`."""
    is_of_kind: bool
    """Whether it is that; else the nearer of both."""

    def edges(self, change: Float64Array) -> tuple[float, float]:
        """Edges or legs of the figure with these moments after a linear change, shape (2, 2) [m], the longer one first."""
        changed = change @ self.second @ change.T
        squares = self.kind[0] * float(np.trace(changed))
        product = self.kind[1] * float(np.sqrt(np.linalg.det(changed)))
        total, difference = np.sqrt(squares + 2.0 * product), np.sqrt(max(squares - 2.0 * product, 0.0))
        return 0.5 * float(total + difference), 0.5 * float(total - difference)


@dataclass(frozen=True, slots=True)
class _Compared:
    """The object that is compared, as one survey has it."""

    surveyed: SurveyedObject
    moments: _Moments
    view: Float64Array
    """Optical frame in the table frame, shape (3, 3)."""
    deviation: Float64Array
    """Standard deviations of width, depth and height [m], shape (3,)."""
    focal: float
    """What the focal length of the images was divided by before the survey [-]."""

    def lengths(self, focal: float, scale: float) -> Float64Array:
        """Both edges, the longer one first, and the height with the map of the images undone [m], shape (3,)."""
        remaining = focal / self.focal
        undo = np.diag([remaining, remaining, 1.0]) @ self.view.T / scale
        across, along = undo[:, 0], undo[:, 1]
        # Coordinates on the true table: an orthonormal basis of its plane, whose lengths are the true ones.
        first = across / np.linalg.norm(across)
        normal = np.cross(across, along)
        normal /= np.linalg.norm(normal)
        second = np.cross(normal, first)
        to_plane = np.array([[first @ across, first @ along], [second @ across, second @ along]])
        return np.array([*self.moments.edges(to_plane), abs(float(normal @ undo[:, 2])) * self.surveyed.top])


def check_scale(survey: Survey, known: KnownSize) -> ScaleCheck:
    """Compare the rectangle or right-angled triangle whose area is nearest to the known one.

    The images are looked at with a better focal length up to four times, until it changes by less than 1 %.

    Raises:
        PerceptionError: There is no object, or none of about this size.
    """
    lengths = np.array([known.width, known.depth] + ([] if known.height is None else [known.height]))
    compared = first = _compared_at_all(survey, known)
    for _ in range(4):
        fits = _fits(compared, lengths)
        error = _simplest(fits, len(lengths)) if compared.moments.is_of_kind else ScaleError.NEITHER
        focal = _focal_to_try(error, fits)
        if abs(np.log(focal / compared.focal)) < 0.01:
            break
        try:
            compared = _compared(_with_focal(survey, focal), known, focal)
        except PerceptionError:
            break  # not the focal length: the fits before hold
    chosen = fits[_shown(error, fits)]
    single = fits[ScaleError.FOCAL], fits[ScaleError.DEPTH]
    within = max(abs(single[0].log_focal) + 2.0 * single[0].std[0], abs(single[1].log_scale) + 2.0 * single[1].std[1])
    measured = _in_order(first.lengths(1.0, 1.0), lengths, with_height=True)
    name = first.surveyed.object_id
    return ScaleCheck(
        name,
        known,
        (float(measured[0]), float(measured[1]), float(measured[2])),
        error,
        float(np.exp(chosen.log_focal)),
        chosen.std[0],
        float(np.exp(chosen.log_scale)),
        chosen.std[1],
        within,
        _sentence(error, fits, name, within, known) if compared.moments.is_of_kind else _NO_BOX.format(name),
    )


def _compared(survey: Survey, known: KnownSize, focal: float) -> _Compared:
    """The object nearest in area. `focal`: what the focal length of the images was divided by before the survey.

    The distance between two edges has a standard deviation of 0.3 px (rendered boxes, in views from above to 60 degrees, have 0.1 to 0.3),
    and at least what a folding rule and the rounding of an edge allow.
    """
    least = 5e-4  # [m]
    surveyed, moments = _nearest(survey, known)
    pixel = surveyed.distance / min(survey.frame.intrinsics.fx, survey.frame.intrinsics.fy)
    bulge = max((abs(band.median) for band in survey.bands if band.near <= surveyed.distance < band.far), default=0.0)
    across = max(least, 0.3 * pixel)
    deviation = np.array([across, across, max(least, bulge)])
    return _Compared(surveyed, moments, survey.camera_in_table[:3, :3], deviation, focal)


def _compared_at_all(survey: Survey, known: KnownSize) -> _Compared:
    """Also where the object was not taken in since its own frames do not fit its outline: a wrong focal length does that."""
    try:
        return _compared(survey, known, 1.0)
    except PerceptionError as error:
        try:
            return _compared(_with_focal(survey, 1.0), known, 1.0)
        except PerceptionError:
            raise error from None


def _with_focal(survey: Survey, focal: float) -> Survey:
    """The same images looked at again with another focal length, in which the walls of a box stand upright if it is right."""
    frame = survey.frame
    intrinsics = replace(frame.intrinsics, fx=frame.intrinsics.fx / focal, fy=frame.intrinsics.fy / focal)
    return survey_frames([replace(frame, intrinsics=intrinsics)], must_fit=False)


def _fits(compared: _Compared, lengths: Float64Array) -> dict[ScaleError, _Fit]:
    """The best fit of each explanation to known lengths [m], shape (2,) or (3,)."""
    deviation = compared.deviation[: len(lengths)]

    def residuals(values: Float64Array) -> Float64Array:
        focal, scale = np.exp(values)
        return (_in_order(compared.lengths(float(focal), float(scale)), lengths) - lengths) / deviation

    explanations = (
        (ScaleError.NONE, (False, False)),
        (ScaleError.FOCAL, (True, False)),
        (ScaleError.DEPTH, (False, True)),
        (ScaleError.BOTH, (True, True)),
    )
    return {error: _fit(residuals, free, deviation / lengths) for error, free in explanations}


def _focal_to_try(error: ScaleError, fits: dict[ScaleError, _Fit]) -> float:
    """The focal length in use over the one that an outcome suggests, at most a factor of two."""
    if error in (ScaleError.NONE, ScaleError.DEPTH):
        return 1.0
    both = fits[ScaleError.BOTH]
    use_both = error in (ScaleError.BOTH, ScaleError.NEITHER) and max(both.std) < _NAMED
    log_focal = both.log_focal if use_both else fits[ScaleError.FOCAL].log_focal
    return float(np.exp(np.clip(log_focal, -0.7, 0.7)))


def _nearest(survey: Survey, known: KnownSize) -> tuple[SurveyedObject, _Moments]:
    if not survey.objects:
        raise PerceptionError(f"No object was taken in to compare with the known size: {survey.failure or survey.why_no_object}.")
    area = known.width * known.depth
    moments = {surveyed.object_id: _moments(surveyed.outline) for surveyed in survey.objects}
    ratios = {name: float(np.prod(of.edges(np.eye(2)))) / area for name, of in moments.items()}
    # A hammer may be nearer in area than the box, above all while the focal length is wrong.
    of_kind = [surveyed for surveyed in survey.objects if moments[surveyed.object_id].is_of_kind] or survey.objects
    best = min(of_kind, key=lambda surveyed: abs(np.log(ratios[surveyed.object_id])))
    if not _SIMILAR[0] < ratios[best.object_id] < _SIMILAR[1]:
        size = " x ".join(f"{100 * edge:.1f}" for edge in moments[best.object_id].edges(np.eye(2)))
        raise PerceptionError(
            f"None of {len(survey.objects)} objects is about as large as the known one, {100 * known.width:.1f} x {100 * known.depth:.1f} "
            f"cm; the nearest, {best.object_id}, is {size} cm. If that is it, the unit of the depth is wrong."
        )
    return best, moments[best.object_id]


def _moments(outline: Float64Array) -> _Moments:
    """Second central moments of a simple polygon, shape (n, 2) [m], and its kind (Green's theorem over the edges).

    Area over sqrt det C of an ellipse differs from that of a rectangle by 0.57, that of an L with thin legs by 3 and more.
    """
    x, y = (outline - outline.mean(axis=0)).T
    u, v = np.roll(x, -1), np.roll(y, -1)
    cross = x * v - u * y
    area = 0.5 * float(np.sum(cross))
    mean = np.array([np.sum((x + u) * cross), np.sum((y + v) * cross)]) / (6.0 * area)
    xx, yy = np.sum((x * x + x * u + u * u) * cross), np.sum((y * y + y * v + v * v) * cross)
    xy = 0.5 * np.sum((x * v + 2.0 * x * y + 2.0 * u * v + u * y) * cross)
    second = np.array([[xx, xy], [xy, yy]]) / (12.0 * area) - np.outer(mean, mean)
    invariant = abs(area) / float(np.sqrt(np.linalg.det(second)))
    kind = min((_RECTANGLE, _TRIANGLE), key=lambda numbers: abs(numbers[2] - invariant))
    return _Moments(second, kind, abs(kind[2] - invariant) < 0.45)


def _in_order(measured: Float64Array, lengths: Float64Array, *, with_height: bool = False) -> Float64Array:
    """Edges in the order of the known ones, and the height where it is known or asked for."""
    edges = measured[:2] if lengths[0] >= lengths[1] else measured[1::-1]
    return np.append(edges, measured[2]) if with_height or len(lengths) == 3 else edges


def _fit(residuals: Callable[[Float64Array], Float64Array], free: tuple[bool, bool], relative: Float64Array) -> _Fit:
    """Least squares over the free logarithms of focal length and scale; `relative`: deviations over known lengths."""
    chosen = np.flatnonzero(free)

    def all_values(some: Float64Array) -> Float64Array:
        values = np.zeros(2)
        values[chosen] = some
        return values

    values, std = np.zeros(2), np.zeros(2)
    if len(chosen):
        best = least_squares(lambda some: residuals(all_values(some)), np.zeros(len(chosen)), x_scale=0.1)
        values = all_values(best.x)
        information = best.jac.T @ best.jac
        is_determined = np.linalg.cond(information) < 1e6
        std[chosen] = np.sqrt(np.diag(np.linalg.inv(information))) if is_determined else np.inf
    rest = residuals(values)
    return _Fit(
        float(values[0]), float(values[1]), (float(std[0]), float(std[1])), float(rest @ rest), float(np.max(np.abs(rest * relative)))
    )


def _simplest(fits: dict[ScaleError, _Fit], n_lengths: int) -> ScaleError:
    """The explanation with the fewest errors that the measurement allows; one of two where it is better by two standard deviations."""

    def is_allowed(error: ScaleError, n_free: int) -> bool:
        """Its residuals have a probability of 1 % or more, or are below 1 %: edges are rounded, and a skewed box shows its walls."""
        fit = fits[error]
        return fit.chi2 < chdtri(max(n_lengths - n_free, 1), 0.01) or (n_free > 0 and fit.residual < 0.01)

    if is_allowed(ScaleError.NONE, 0):
        return ScaleError.NONE
    single = sorted((e for e in (ScaleError.FOCAL, ScaleError.DEPTH) if is_allowed(e, 1)), key=lambda e: fits[e].chi2)
    if len(single) == 2 and fits[single[1]].chi2 - fits[single[0]].chi2 < 4.0:
        return ScaleError.EITHER
    if single:
        return single[0]
    return ScaleError.BOTH if max(fits[ScaleError.BOTH].std) < _NAMED and is_allowed(ScaleError.BOTH, 2) else ScaleError.NEITHER


def _shown(error: ScaleError, fits: dict[ScaleError, _Fit]) -> ScaleError:
    """The fit whose numbers stand for an outcome."""
    if error is ScaleError.EITHER:
        return min((ScaleError.FOCAL, ScaleError.DEPTH), key=lambda single: fits[single].chi2)
    return ScaleError.NONE if error is ScaleError.NEITHER else error


def _sentence(error: ScaleError, fits: dict[ScaleError, _Fit], object_id: str, within: float, known: KnownSize) -> str:
    remedy = "give the height as well (--known WxDxH)" if known.height is None else "use a taller box"
    focal = f"focal length looks {_percent(fits[ScaleError.FOCAL].log_focal, fits[ScaleError.FOCAL].std[0])}"
    scale = f"depth scale looks {_percent(fits[ScaleError.DEPTH].log_scale, fits[ScaleError.DEPTH].std[1])}"
    both = fits[ScaleError.BOTH]
    return {
        ScaleError.NONE: f"{object_id} agrees with the known size: focal length and depth scale are right within {100 * within:.1f} %",
        ScaleError.FOCAL: focal,
        ScaleError.DEPTH: scale,
        ScaleError.BOTH: f"focal length looks {_percent(both.log_focal, both.std[0])} and depth scale "
        f"{_percent(both.log_scale, both.std[1])}",
        ScaleError.EITHER: f"either {focal}, or {scale}; {remedy} to tell them apart",
        ScaleError.NEITHER: f"{object_id} is not of the known size: no focal length and depth scale explain it "
        f"(the best leaves {100 * both.residual:.0f} %); check the size, and that it is a box or a right-angled mark",
    }[error]


def _percent(logarithm: float, std: float) -> str:
    return f"{100 * abs(np.expm1(logarithm)):.1f} % too {'large' if logarithm > 0 else 'small'} (± {100 * std:.1f} %)"
