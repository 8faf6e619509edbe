"""What a depth camera sees of a table, from frames at rest and without a number given: table, noise, objects, refusals.

The table is the largest plane in view, or one high above it; the workspace is the box around what is visible of it. Perception then runs on
the frames as it does live, so that what it takes in here it takes in there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.errors import FrameError, PerceptionError
from push_ident.geometry.outline import points_in_polygon
from push_ident.geometry.se2 import transform_points
from push_ident.perception.calibration import camera_over_table, table_extent
from push_ident.perception.frame.depth_unit import WrongUnit, wrong_unit
from push_ident.perception.frame.table import TableElsewhereError, TablePlane
from push_ident.perception.frame.view import median_frame, points_in_table
from push_ident.perception.observation import Observation
from push_ident.perception.pipeline import Perception
from push_ident.perception.refusals import Reason, Refusal
from push_ident.perception.settings import PerceptionSettings, SegmentSettings, TableSettings
from push_ident.survey.noise_bands import NoiseBand, noise_by_distance
from push_ident.types import DepthFrame, Float64Array, ObjectShape

_MOVED: Final = (0.01, 0.01)
"""A pixel whose depth differs by more than the first [m] plus the second times its depth shows something else: three deviations of a
Kinect at 2 m, 5 mm each (Nguyen et al., 2012)."""
_TWO_PLANES: Final = (
    "The largest plane in view and the one found over the workspace are not the same: the table bends, or a thing or the floor is taken "
    "for it; move the camera so that the table fills the picture, or give its pose."
)
"""Why perception does not find the table where this survey has it, where nobody gave a pose that could be wrong."""


@dataclass(frozen=True, slots=True)
class SurveyedObject:
    """One object on the table."""

    object_id: str
    shape: ObjectShape
    outline: Float64Array
    """Its outline [m], shape (n, 2), table frame."""
    size: tuple[float, float]
    """Length and width along the sides of the smallest rectangle around the outline, the longer one first [m]."""
    height: float
    """Of its highest points above the table [m]."""
    top: float
    """Median height of the middle of its upper side [m]; of a flat top its height without the bias of single points."""
    distance: float
    """Median depth [m]."""


@dataclass(frozen=True, slots=True)
class Survey:
    """The result of `survey_frames`."""

    frame: DepthFrame
    """Median of the frames."""
    n_frames: int
    camera_in_table: Float64Array
    """Optical frame in the table frame, shape (4, 4), z = 0 on the table."""
    is_pose_given: bool
    """Whether that is a given pose, corrected by the plane; else the table frame is in the middle of what is visible of the table, its x
    axis along the rows of the image."""
    settings: PerceptionSettings
    """With the workspace and, where the camera needs it, another least height of objects."""
    noise: float
    """Deviation of single heights of the whole table from its plane [m]."""
    least_height: float
    """Of an object: that of the settings, or what the noise allows [m]."""
    share_on_table: float
    """Fraction of the measured points on the plane of the table [-]."""
    share_measured: float
    """Fraction of the pixels with a depth [-]."""
    bands: tuple[NoiseBand, ...]
    """Noise of a height by distance."""
    objects: tuple[SurveyedObject, ...]
    refused: tuple[Refusal, ...]
    """In the order of their areas, largest first."""
    failure: str
    """Why perception refuses these frames, with a remedy; empty where it does not."""
    why_no_object: str
    """Empty where there is one."""
    notes: tuple[str, ...]
    """What was assumed or left out, one line each."""

    @property
    def tilt(self) -> float:
        """Angle between the optical axis and the normal of the table [rad]."""
        return float(np.arccos(np.clip(-self.camera_in_table[2, 2], -1.0, 1.0)))


def frames_at_rest(
    frames: Iterable[DepthFrame], *, wanted: int = 30, enough: int = 10, looked_at: int = 300
) -> tuple[list[DepthFrame], str]:
    """The first frames among which nothing moves, and a note on what was passed over; empty where nothing was.

    Frames of a robot in motion before a rest are passed over.

    Args:
        frames: of one camera.
        wanted: frames that are used at most: a second of a usual camera; the noise of their median is a fifth of that of one frame.
        enough: a shorter rest is used only where there is no longer one: `rest_frames` of perception.
        looked_at: frames in which a rest is looked for: ten seconds of a usual camera.
    """
    best: list[DepthFrame] = []
    run: list[DepthFrame] = []
    n_seen = 0
    for frame in frames:
        n_seen += 1
        if run and (frame.depth.shape != run[0].depth.shape or frame.intrinsics != run[0].intrinsics or _is_moved(run[0], frame)):
            run = []
        run.append(frame)
        if len(run) > len(best):
            best = list(run)
        if len(run) == wanted or n_seen == looked_at or (not run[1:] and len(best) >= enough):
            break
    passed = n_seen - len(best)
    return best, f"{passed} of the first {n_seen} frames show something else and are not used" if passed > 0 else ""


def survey_frames(
    frames: Sequence[DepthFrame],
    camera_in_table: Float64Array | None = None,
    notes: Sequence[str] = (),
    *,
    must_fit: bool = True,
) -> Survey:
    """Look at frames at rest: one or more of a camera that does not move, in the order of their stamps [s].

    Args:
        camera_in_table: known pose of the optical frame in the table frame, shape (4, 4), which the plane of the table corrects.
        notes: of the source, which are passed on.
        must_fit: as of `SegmentSettings`.

    Raises:
        FrameError: There are no frames, or the image does not belong to its intrinsics.
        PerceptionError: Nothing is measured, or there is no table in view.
    """
    if not frames:
        raise FrameError("There are no depth frames; record or give at least one.")
    picture = median_frame(frames)
    wrong = None if camera_in_table is None else wrong_unit(picture, camera_in_table)
    try:
        fitted, plane_noise, share = camera_over_table(picture)
    except PerceptionError as error:
        raise PerceptionError(_unit_text(wrong) or str(error)) from None
    camera, is_given, note = _agreed(camera_in_table, fitted, plane_noise, _unit_text(wrong))
    low, high = table_extent(picture, camera, plane_noise)
    if not is_given:
        middle = 0.5 * np.add(low, high)
        camera = camera.copy()
        camera[:2, 3] -= middle
        low, high = _pair(low - middle), _pair(high - middle)
    settings = PerceptionSettings(workspace_low=low, workspace_high=high, segments=SegmentSettings(must_fit=must_fit))
    bands, noise = noise_by_distance(frames, picture, camera, settings)
    settings = replace(settings, min_object_height=_least_height(bands, noise, settings))
    perception, ids, doubts, observation, failure = _perceive(frames, camera, settings, is_given=is_given)
    if perception.plane is not None:
        camera = perception.camera_in_table
    points = points_in_table(picture, camera)
    objects = tuple(_object(perception, name, points, picture.depth) for name in ids)
    refused = () if observation is None else tuple(sorted(observation.refused, key=lambda refusal: -hull_area(refusal.outline)))
    return Survey(
        frame=picture,
        n_frames=len(frames),
        camera_in_table=camera,
        is_pose_given=is_given,
        settings=settings,
        noise=noise,
        least_height=max(settings.min_object_height, 0.0 if perception.plane is None else perception.plane.least_height),
        share_on_table=share,
        share_measured=float(np.mean(np.isfinite(picture.depth))),
        bands=bands,
        objects=objects,
        refused=refused,
        failure=failure,
        why_no_object="" if objects or observation is None else observation.why_no_pose(),
        notes=tuple(line for line in (*notes, note, *doubts, _robot_note(refused, settings)) if line),
    )


def _robot_note(refused: Sequence[Refusal], settings: PerceptionSettings) -> str:
    """What to do where a robot may be in view; empty where nothing reaches into the image above what a tool can touch, as a robot does."""
    reaching = [refusal for refusal in refused if refusal.reason is Reason.AT_IMAGE_BORDER and refusal.height > settings.tool_reach[1]]
    if not reaching:
        return ""
    highest = max(refusal.height for refusal in reaching)
    return (
        f"what reaches in over the border of the image, up to {1e3 * highest:.0f} mm high, may be a robot, and what it hides or "
        "cuts off is refused as well; no image says what is robot: turn it out of the view "
        "(perception_node masks it by its joint states and description)"
    )


def _is_moved(first: DepthFrame, frame: DepthFrame) -> bool:
    """Whether patches of the image show something else, more than 25 x 25 pixels of 640 x 480; pixels and edges flicker in every camera."""
    with np.errstate(invalid="ignore"):
        differs = np.abs(frame.depth - first.depth) > _MOVED[0] + _MOVED[1] * first.depth
    patches = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    return bool(np.count_nonzero(patches) > 0.002 * differs.size)


def _unit_text(wrong: WrongUnit | None) -> str:
    if wrong is None:
        return ""
    return f"{wrong}; give --depth-unit {wrong.unit:g}, or let the driver of a live camera publish millimetres (16UC1)"


def _agreed(given: Float64Array | None, fitted: Float64Array, noise: float, cause: str) -> tuple[Float64Array, bool, str]:
    """The given pose corrected by the plane, or the fitted one where none is given or the plane contradicts it, of which the `cause` may be
    known; whether it is the given one; and a note."""
    if given is None:
        return fitted, False, ""
    plane_in_table = np.asarray(given, dtype=np.float64) @ np.linalg.inv(fitted)
    normal, point = plane_in_table[:3, 2], plane_in_table[:3, 3]
    tilt = float(np.arccos(np.clip(normal[2], -1.0, 1.0)))
    offset = float(normal @ point / normal[2]) if abs(normal[2]) > 0.1 else np.inf
    accepted = TableSettings()
    if tilt > accepted.max_tilt or abs(offset) > accepted.max_offset:
        wrong = (
            f"the given camera pose is not used: the table is {np.degrees(tilt):.1f} degrees and {offset * 1e3:.0f} mm from its place, "
            f"expected at most {np.degrees(accepted.max_tilt):.1f} degrees and {accepted.max_offset * 1e3:.0f} mm; "
            f"{cause or 'calibrate anew'}"
        )
        return fitted, False, wrong
    slope = (float(-normal[0] / normal[2]), float(-normal[1] / normal[2]))
    note = f"the plane corrects the given pose of the camera by {np.degrees(tilt):.2f} degrees and {abs(offset) * 1e3:.1f} mm"
    return TablePlane(slope, offset, noise).correct(given), True, note


def _least_height(bands: Sequence[NoiseBand], noise: float, settings: PerceptionSettings, step: float = 5e-4) -> float:
    """Least height of objects [m], in steps of `step`: more than the default only where the table itself bulges by more than the noise.

    What the noise needs, perception adds by itself.
    """
    bulge = max((abs(band.median) for band in bands), default=0.0)
    if bulge <= noise:
        return settings.min_object_height
    needed = float(np.ceil((bulge + 4.0 * noise) / step) * step)
    return min(max(settings.min_object_height, round(needed, 6)), 0.5 * settings.max_object_height)


def _perceive(
    frames: Sequence[DepthFrame], camera: Float64Array, settings: PerceptionSettings, *, is_given: bool
) -> tuple[Perception, list[str], list[str], Observation | None, str]:
    """Perception after all frames, the ids of what it took in, what is doubtful of contact with them, its last observation, and why it
    refuses the frames.

    Fewer frames than `rest_frames` count as the whole rest: repeating them would claim less noise than they have.

    Args:
        is_given: Whether the pose of the camera is; else it is that over a plane of the first frames.
    """
    # Every frame is searched, and none is spent on an occupancy grid.
    every_frame = replace(settings, search_period=0.0, occupancy_period=1e9, rest_frames=min(settings.rest_frames, len(frames)))
    perception = Perception(camera, every_frame)
    ids: list[str] = []
    doubts: list[str] = []
    observation, failure = None, ""
    for index, frame in enumerate(frames):
        try:
            observation = perception.observe(replace(frame, stamp=index / 30))  # stamps of files are made up, those of a bag may repeat
            ids += observation.new_shapes
            doubts += [f"object {name}: {doubt}" for name, doubt in observation.doubts.items()]
        except TableElsewhereError as error:
            failure = str(error) if is_given else _TWO_PLANES
            break
        except (FrameError, PerceptionError) as error:
            failure = str(error)
            break
    return perception, ids, doubts, observation, failure


def _object(perception: Perception, name: str, points: NDArray[np.float32], depth: NDArray[np.float32]) -> SurveyedObject:
    """One object. Its height is the 0.98 quantile of its heights: single pixels are outliers.

    Points more than 1 cm above its top as it was traced belong to something over it, such as an arm. The middle of its outline, of 0.8 of
    its size, gives the height of the upper side: free of edges and walls.
    """
    known = perception.known(name)
    outline = transform_points(perception.first_pose(name), known.traced.shape.outline)
    flat, low, high = points.reshape(-1, 3), outline.min(axis=0), outline.max(axis=0)
    with np.errstate(invalid="ignore"):
        near = np.all((flat[:, :2] >= low) & (flat[:, :2] <= high), axis=1) & (flat[:, 2] < float(known.traced.top.max()) + 0.01)
    measured, measured_depth = flat[near].astype(np.float64), depth.ravel()[near]
    inside = points_in_polygon(measured[:, :2], outline)
    middle = outline.mean(axis=0)
    inner = points_in_polygon(measured[:, :2], middle + 0.8 * (outline - middle))
    heights = measured[inside, 2] if inside.any() else known.traced.top.ravel()
    top = measured[inner, 2] if inner.any() else heights
    distance = (
        float(np.median(measured_depth[inside])) if inside.any() else float(np.linalg.norm(perception.camera_in_table[:2, 3] - middle))
    )
    quantile = float(np.quantile(heights, 0.98))
    return SurveyedObject(name, known.traced.shape, outline, _edges(outline), quantile, float(np.median(top)), distance)


def _edges(outline: Float64Array, n: int = 2000, tip: float = 0.01) -> tuple[float, float]:
    """Length and width [m], along the sides of the smallest rectangle around an outline; less the tips, which noise makes.

    `n` points along the outline measure it. `tip`: fraction of the border that may stick out at each end of a length [-]; the short side of
    a hammer's handle has three times that.
    """
    corners = cv2.boxPoints(cv2.minAreaRect(outline.astype(np.float32))).astype(np.float64)
    axes = np.array([corners[1] - corners[0], corners[2] - corners[1]])
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9)
    steps = np.roll(outline, -1, axis=0) - outline
    lengths = np.linalg.norm(steps, axis=1)
    at = np.linspace(0.0, lengths.sum(), n, endpoint=False)
    edge = np.searchsorted(np.cumsum(lengths), at, side="right")
    share = (at - np.concatenate([[0.0], np.cumsum(lengths)])[edge]) / lengths[edge]
    along = (outline[edge] + share[:, None] * steps[edge]) @ axes.T
    low, high = np.quantile(along, [tip, 1.0 - tip], axis=0)
    short, long = sorted(float(value) for value in high - low)
    return long, short


def hull_area(hull: Float64Array) -> float:
    """Area of a polygon [m^2], shape (n, 2); 0 for fewer than three points."""
    return float(cv2.contourArea(hull.astype(np.float32))) if len(hull) > 2 else 0.0


def _pair(values: Float64Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])
