"""Sequences of mutated and clean depth frames through `Perception`, and what must hold after each."""

from __future__ import annotations

import faulthandler
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np

from push_ident.errors import InputError, PushIdentError
from push_ident.geometry.outline import polygon_centroid
from push_ident.geometry.se2 import transform_points
from push_ident.geometry.shape_check import check_shape
from push_ident.limits import LIMITS
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.known_object import TrackStatus
from push_ident.perception.observation import Observation
from push_ident.perception.pipeline import Perception
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import DepthFrame, Float64Array
from push_ident_sim.fuzz.frame_scenes import WIDTHS, FrameScene, scene_of
from push_ident_sim.fuzz.mutate_frame import FRAME_MUTATIONS, Around, mutated

__all__ = ["IN_A_ROW", "FrameMutation", "FrameRecipe", "SequenceResult", "Step", "draw_sequence", "run_sequence"]

IN_A_ROW: Final = 32
"""Sequences of one scene: to render it takes as long as some of them."""
MAX_SECONDS: Final = 1.0
"""Longest time of the processor for an image of 640 x 480 pixels [s]; larger ones have more in proportion. A frame takes 0.03 s."""
_USUAL: Final = 640 * 480
_HANG: Final = 120.0
"""After so long within one frame the process ends with the place where it was [s]."""
_SETTINGS: Final = PerceptionSettings(rest_frames=3)
"""Fewer frames at rest than a cell has, so that mutated frames come before, during and after an object is taken in."""
_PREFIX: Final = 5
"""Clean frames from which an object is taken in."""
_TAIL: Final = 12
"""Clean frames at the end: after 3.6 s the plane was checked three times, and what is lost was searched for in each other frame."""
_TAIL_GAP: Final = 0.3
"""Between two of them [s]."""
_SAME_PLACE: Final = 0.02
"""An object that is found again lies this near to where it is without mutated frames [m]: about half its width."""
_COARSE: Final = min(width for width in WIDTHS if width)
"""In images of this width a pixel is 6 to 10 mm: poses drift without mutated frames too, and places are not compared [px]."""
_SAME_PLANE: Final = 0.004
"""The table is as near to where it is without them, at the corners of the workspace [m]; perception replaces it from 1.5 mm on."""
_ROBOT: Final = (Cylinder(0.05, 0.05, 0.02), Cylinder(0.05, 0.05, 0.09, 0.1))
"""A tool and a hand over the table."""


@dataclass(frozen=True, slots=True)
class FrameMutation:
    """One change of a frame."""

    name: str
    seed: int


@dataclass(frozen=True, slots=True)
class Step:
    """One frame of a sequence."""

    view: int
    """Number of the clean image."""
    gap: float
    """Time since the frame before [s]."""
    robot: bool = False
    """Whether parts of a robot are given as well."""
    mutations: tuple[FrameMutation, ...] = ()
    """Of the image; none: it stays clean."""


@dataclass(frozen=True, slots=True)
class FrameRecipe:
    """How a sequence is made. Clean frames follow it."""

    scene: str
    width: int
    """Of the image [px]; 0: that of the sensor."""
    steps: tuple[Step, ...]


@dataclass(slots=True)
class SequenceResult:
    """What became of a sequence."""

    n_mutated: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    """Of the mutated frames: taken, or the type of the error that refused it."""
    worst: float = 0.0
    """Longest time of the processor for one frame, for 640 x 480 pixels [s]."""
    failure: str = ""
    """Empty where all held."""
    at: int = -1
    """Number of the frame that failed; those after the sequence count on."""


def draw_sequence(seed: int, number: int, scenes: Sequence[str]) -> FrameRecipe:
    """The recipe with this number; `IN_A_ROW` in a row have the same scene, so that it is made once."""
    rng = np.random.default_rng([seed, number])
    scene, width = scenes[number // IN_A_ROW % len(scenes)], int(rng.choice(WIDTHS, p=(0.3, 0.55, 0.15)))
    n_prefix = int(rng.choice([0, 2, _PREFIX, _PREFIX]))
    steps = [Step(int(rng.integers(4)), 0.05) for _ in range(n_prefix)]
    latest: tuple[FrameMutation, ...] = ()
    for _ in range(int(rng.integers(6, 16))):
        kind = rng.random()
        if kind > 0.2 and not (latest and kind > 0.75):  # one in four repeats what was done to the frame before
            names = rng.choice(list(FRAME_MUTATIONS), int(rng.choice([1, 1, 1, 2, 2, 3])))
            latest = tuple(FrameMutation(str(name), int(rng.integers(1 << 31))) for name in names)
        view = int(rng.integers(4)) if rng.random() < 0.6 else int(rng.integers(10))
        gap = float(rng.choice([1 / 30, 0.1, 0.3, 1.1]))
        steps.append(Step(view, gap, bool(rng.random() < 0.2), latest if kind > 0.2 else ()))
    return FrameRecipe(scene, width, tuple(steps))


def run_sequence(recipe: FrameRecipe, max_seconds: float = MAX_SECONDS) -> SequenceResult:
    """Give a sequence, and clean frames after it, to a new `Perception`.

    A frame that takes more than `max_seconds` of the processor, for 640 x 480 pixels, is a failure. The first of a process loads kernels.
    """
    scene = scene_of(recipe.scene, recipe.width)
    perception = Perception(scene.camera_in_table, _SETTINGS)
    result, stamp, latest = SequenceResult(), 1000.0, -math.inf
    for number, step in enumerate(recipe.steps):
        stamp += step.gap
        frame = DepthFrame(stamp, scene.views[step.view], scene.intrinsics)
        for mutation in step.mutations:
            frame = mutated(frame, mutation.name, mutation.seed, Around(scene.other, latest))
        latest = frame.stamp
        outcome = _give(perception, frame, step.robot, result, max_seconds)
        if step.mutations:
            result.n_mutated += 1
            result.verdicts[outcome] += 1
        if result.failure:
            result.at = number
            return result
    refusal = ""
    for number in range(_TAIL):
        stamp += _TAIL_GAP
        frame = DepthFrame(stamp, scene.at_rest[number % len(scene.at_rest)], scene.intrinsics)
        refusal = _give(perception, frame, False, result, max_seconds)
        if result.failure:
            result.at = len(recipe.steps) + number
            return result
    result.failure = _not_normal(perception, refusal, scene, recipe.width)
    result.at = len(recipe.steps) + _TAIL if result.failure else -1
    return result


def _give(perception: Perception, frame: DepthFrame, robot: bool, result: SequenceResult, max_seconds: float) -> str:
    """Let perception observe a frame; "taken", or the error that refused it. A failure is written to the result."""
    faulthandler.dump_traceback_later(_HANG, exit=True)
    began = time.thread_time()
    try:
        observation = perception.observe(frame, _ROBOT if robot else ())
        outcome = "taken"
        result.failure = _wrong(observation) or _wrong_camera(perception)
    except PushIdentError as error:
        outcome = type(error).__name__
        if not str(error):
            result.failure = f"{outcome} without a reason"
    except Exception as error:
        outcome = "failed"
        place = error.__traceback__
        while place is not None and place.tb_next is not None:
            place = place.tb_next
        where = f"{place.tb_frame.f_code.co_filename.rpartition('/')[2]}:{place.tb_lineno}" if place is not None else ""
        result.failure = f"{type(error).__name__} in {where}: {str(error)[:200]}"
    finally:
        faulthandler.cancel_dump_traceback_later()
    took = (time.thread_time() - began) / max(1.0, frame.depth.size / _USUAL)
    result.worst = max(result.worst, took)
    if took > max_seconds and not result.failure:
        result.failure = f"slow: {took:.1f} s for 640 x 480 pixels"
    return outcome


def _wrong(observation: Observation) -> str:
    """What is wrong with the result of a frame."""
    for known in observation.objects:
        if (known.status is TrackStatus.TRACKED) != (known.pose is not None and known.covariance is not None):
            return f"pose of {known.object_id} and its status {known.status.name} contradict each other"
        if known.pose is not None and known.covariance is not None and (why := _wrong_pose(known.pose, known.covariance)):
            return f"pose of {known.object_id}: {why}"
    for name, shape in observation.new_shapes.items():
        try:
            check_shape(shape)
        except InputError as error:
            return f"shape of {name}: {error}"
        if not (np.isfinite(shape.outline).all() and np.isfinite(shape.cells.centres).all()):
            return f"shape of {name} is not finite"
        if len(shape.outline) > LIMITS.VERTICES.value or len(shape.cells) > LIMITS.CELLS.value:
            return f"shape of {name} has {len(shape.outline)} vertices and {len(shape.cells)} cells, beyond what messages take"
    for refusal in observation.refused:
        if not (np.isfinite(refusal.outline).all() and math.isfinite(refusal.height) and len(refusal.outline) and refusal.why):
            return f"refusal {refusal.reason.name} has no finite outline, height or reason"
    grid = observation.occupancy
    if grid is not None and not (np.isfinite(grid.origin).all() and grid.occupancy.min() >= -1 and grid.occupancy.max() <= 100):
        return "the occupancy is none"
    return "" if all(count >= 0 for count in observation.counts.values()) else f"counts are negative: {observation.counts}"


def _wrong_pose(pose: Float64Array, covariance: Float64Array) -> str:
    if pose.shape != (3,) or not np.isfinite(pose).all() or np.abs(pose[:2]).max() > LIMITS.COORDINATE.value:
        return f"{pose.tolist()} is not finite or far away"
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all():
        return "its covariance is not finite"
    if np.abs(covariance - covariance.T).max() > 1e-9 * np.abs(covariance).max() or np.linalg.eigvalsh(covariance)[0] <= 0:
        return f"its covariance is not positive definite: {covariance.tolist()}"
    return ""


def _wrong_camera(perception: Perception) -> str:
    camera = perception.camera_in_table
    is_pose = np.isfinite(camera).all() and np.abs(camera[:3, :3] @ camera[:3, :3].T - np.eye(3)).max() < 1e-6
    return "" if is_pose else f"the corrected pose of the camera is none: {camera.tolist()}"


def _not_normal(perception: Perception, latest: str, scene: FrameScene, width: int) -> str:
    """Why the clean frames after a sequence were not taken as without it."""
    camera, places = _without_mutations(scene.name, width)
    if latest != "taken":
        return f"not normal again: the last clean frame is refused ({latest})"
    off = _table_off(perception.camera_in_table, camera)
    if off > _SAME_PLANE:
        return f"not normal again: the table is {1e3 * off:.1f} mm from its place"
    found = _places(perception, scene) if places else []
    for place in places:
        if not _is_near(place, found):
            return f"not normal again: nothing is tracked at {np.round(place, 3).tolist()}, but at {np.round(found, 3).tolist()}"
    return ""


@lru_cache(maxsize=64)
def _without_mutations(name: str, width: int) -> tuple[Float64Array, tuple[Float64Array, ...]]:
    """Corrected pose of the camera, and places of the objects, after clean frames only.

    Objects that are found only where one of the images comes first are left out.
    """
    scene = scene_of(name, width)
    runs = []
    for first in range(len(scene.at_rest)):
        perception = Perception(scene.camera_in_table, _SETTINGS)
        for number in range(_TAIL):
            depth = scene.at_rest[(first + number) % len(scene.at_rest)]
            perception.observe(DepthFrame(_TAIL_GAP * number, depth, scene.intrinsics))
        runs.append((perception.camera_in_table, _places(perception, scene)))
    camera, places = runs[0]
    if width == _COARSE:
        return camera, ()
    return camera, tuple(place for place in places if all(_is_near(place, others) for _, others in runs))


def _is_near(place: Float64Array, others: Sequence[Float64Array]) -> bool:
    return any(np.linalg.norm(place - other) < _SAME_PLACE for other in others)


def _places(perception: Perception, scene: FrameScene) -> list[Float64Array]:
    """Where the objects are that a clean frame shows: centroids of their outlines [m], table frame."""
    frame = DepthFrame(1e6, scene.at_rest[0], scene.intrinsics)
    observation = perception.observe(frame)
    return [
        np.asarray(polygon_centroid(transform_points(known.pose, perception.known(known.object_id).traced.shape.outline)))
        for known in observation.objects
        if known.pose is not None
    ]


def _table_off(camera: Float64Array, expected: Float64Array) -> float:
    """Largest distance between two places of the table at the corners of the workspace [m]."""
    (x0, y0), (x1, y1) = _SETTINGS.workspace_low, _SETTINGS.workspace_high
    corners = np.array([(x, y, 0.0, 1.0) for x in (x0, x1) for y in (y0, y1)])
    return float(np.abs((corners @ (camera @ np.linalg.inv(expected)).T)[:, 2]).max())
