"""Do pusher and object meet while the object moves? By how much they miss, and which one mistake would explain it.

An object on a table moves only while it is pushed: in every frame in which it moves, the pusher's surface lies on its outline. The mistakes
that imports make are few (units, axes, frames, radius, clocks); each is a hypothesis with at most three unknowns, fitted to these frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Final

import numpy as np

from push_ident.geometry.frames import axes_text
from push_ident.geometry.outline import outline_distance
from push_ident.geometry.se2 import transform_points
from push_ident.types import BoolArray, Float64Array, ObjectShape

NOISE_FACTOR: Final = 6.0
"""Standard deviations of the noise of a way that count as motion."""
_TURNS: Final = np.linspace(-0.4, 0.4, 9)
"""About the turn that the ways of pusher and object suggest, which the turning of the object falsifies [rad]."""
_PLACES: Final = np.linspace(-1.0, 1.0, 9)
"""Where the origin of its frame is looked for, about where the path of the pusher comes to the middle of the object, in radii of it [-]."""
_SHOWN: Final = 3.0
"""Tolerances that an object moves at least in a push that shows whether it meets the pusher [-]: less fits anything."""
_UNITS: Final = (
    (1e-3, "mm"),
    (1e-2, "cm"),
    (1e3, "m instead of mm"),
    (1e2, "m instead of cm"),
    (0.0254, "inches"),
    (0.1, "mm instead of cm"),
    (10.0, "cm instead of mm"),
)
"""Factors by which lengths are wrong where they were in fact of this unit."""


@dataclass(frozen=True, slots=True)
class Streams:
    """A recording on one clock and in one frame."""

    poses: Float64Array
    """Rows (time, x, y, yaw) of the object [s, m, m, rad], shape (n, 4)."""
    runs: list[Float64Array]
    """Samples of the pusher by push or motion, rows (time, x, y, z) [s, m]."""
    shape: ObjectShape
    radius: float
    """Of the pusher [m]."""
    tolerance: float
    """Distance between pusher and outline that noise explains [m]."""
    units: frozenset[str] = frozenset({"length", "angle"})
    """What came as numbers whose unit somebody named: lengths, and a yaw, which a quaternion is not."""
    pusher_axes: Float64Array = field(default_factory=lambda: np.eye(3))
    """Rotation from the axes of the pusher's file to those of the table, shape (3, 3)."""


@dataclass(frozen=True, slots=True)
class Cause:
    """One mistake that would explain that pusher and object do not meet."""

    finding: str
    """What is probably wrong."""
    mend: str
    """What mends it when the recording is imported; empty where no option does."""
    error: float
    """Root mean square distance of pusher and outline that is left with it [m]."""

    @property
    def text(self) -> str:
        """What is probably wrong, how an import mends it, and what is left."""
        return f"{self.finding}{': ' if self.mend else ''}{self.mend} (leaves {1e3 * self.error:.1f} mm)"


@dataclass(frozen=True, slots=True)
class Overlap:
    """Pusher and object while the object moves."""

    shape: ObjectShape
    radius: float
    """Of the pusher [m]."""
    tolerance: float
    """[m]"""
    push: Float64Array
    """Number of the push of each frame, from 0, shape (n,)."""
    time: Float64Array
    """Since the object began to move in that push [s], shape (n,)."""
    pose: Float64Array
    """Of the object in `table`, shape (n, 3)."""
    pusher: Float64Array
    """Axis of the pusher in `table` [m], shape (n, 2)."""
    distance: Float64Array
    """Of the pusher's surface to the outline [m], negative inside, shape (n,)."""
    causes: tuple[Cause, ...]
    """What would explain a miss, the most probable first; empty where they meet, or nothing explains it."""

    @property
    def fits(self) -> bool:
        """Whether pusher and object meet as far as noise allows to say; True where no frame shows it."""
        return _meet(self.distance, self.tolerance)

    @property
    def miss(self) -> float:
        """Median distance between pusher and outline while the object moves [m], negative inside; NaN without such frames."""
        return float(np.median(self.distance)) if len(self.distance) else np.nan

    def remedy(self) -> str:
        """What to check in an import, the likely cause first."""
        if not self.causes:
            return "check frames, units, the pusher's radius and the clocks of both."
        return "likely: " + "; or: ".join(cause.text for cause in self.causes) + "."

    def finding(self) -> str:
        """By how much they miss, in one clause."""
        if not len(self.distance):
            return "no frame shows the object in motion"
        return f"while the object moves the pusher is {1e3 * abs(self.miss):.1f} mm {'inside' if self.miss < 0 else 'outside'} the outline"

    def explanation(self) -> str:
        """By how much they miss, and why, in one line, for the one who imports."""
        if not len(self.distance):
            return f"{self.finding()}, so that the cause of a miss cannot be found; record poses during the pushes."
        if self.fits:
            return f"{self.finding()} in the median, which noise explains."
        if not self.causes:
            return f"{self.finding()} in the median, and no single mistake explains it; {self.remedy()}"
        return f"{self.finding()} in the median; {self.remedy()}"


@dataclass(frozen=True, slots=True)
class MovingFrames:
    """The frames in which the object moves."""

    push: Float64Array
    time: Float64Array
    pose: Float64Array
    streams: Streams

    def pusher(self, offset: float = 0.0) -> Float64Array:
        """Axis of the pusher [m], shape (n, 2), with its clock moved by `offset` [s]."""
        position = np.empty((len(self.time), 2))
        for number in np.unique(self.push):
            own, run = self.push == number, self.streams.runs[int(number)]
            position[own] = np.column_stack([np.interp(self.time[own] - offset, run[:, 0], run[:, axis]) for axis in (1, 2)])
        return position

    def distance(self, pusher: Float64Array, *, pose: Float64Array | None = None, outline: Float64Array | None = None) -> Float64Array:
        """Of the pusher's surface to the outline [m], shape (n,)."""
        given = self.streams.shape.outline if outline is None else outline
        return outline_distance(pusher, self.pose if pose is None else pose, given) - self.streams.radius

    @property
    def n_pushes(self) -> int:
        """Pushes in which the object is seen moving."""
        return len(np.unique(self.push))


def overlap_of(streams: Streams) -> Overlap:
    """Compare pusher and object in the frames in which the object moves, and look for the cause where they do not meet."""
    frames = moving_frames(streams)
    pusher = frames.pusher() if len(frames.time) else np.zeros((0, 2))
    distance = frames.distance(pusher) if len(pusher) else np.zeros(0)
    since = frames.time - np.array([frames.time[frames.push == k].min() for k in frames.push]) if len(pusher) else np.zeros(0)
    causes = () if _meet(distance, streams.tolerance) else tuple(_causes(frames))
    return Overlap(
        streams.shape,
        streams.radius,
        streams.tolerance,
        frames.push,
        since,
        frames.pose,
        pusher,
        distance,
        _best(causes, streams.tolerance),
    )


def _meet(distance: Float64Array, tolerance: float) -> bool:
    """Whether 95 % of the frames lie within the tolerance: one of three deviations holds for more."""
    return not len(distance) or float(np.mean(np.abs(distance) <= tolerance)) >= 0.95


def _rms(distance: Float64Array) -> float:
    return float(np.sqrt(np.mean(distance**2)))


def moving_frames(streams: Streams) -> MovingFrames:
    """Frames strictly inside the motions of the object, numbered by the nearest run of the pusher.

    The object moves in a frame if it has moved in the 0.2 s before and moves on in the 0.2 s after it, at more than its noise and 2.5 mm/s,
    below the speed of any push. Of the frames within 2 s of a run 400 are compared; more add time, no knowledge.
    """
    window, rounding = 0.2, 1e-6  # [s]; the latter of stamps in text
    poses, time = streams.poses, streams.poses[:, 0]
    lever = float(np.linalg.norm(streams.shape.outline, axis=1).max())
    least = max(0.5e-3, NOISE_FACTOR * float(np.sqrt(2.0)) * _scatter(poses[:, 1:] * [1.0, 1.0, lever]))
    moving: BoolArray = np.ones(len(time), dtype=np.bool_)
    before = np.searchsorted(time, time - window + rounding, side="right") - 1
    after = np.searchsorted(time, time + window - rounding)
    for other in (before, after):
        there = other.clip(0, len(time) - 1)
        way = np.linalg.norm(poses[there, 1:3] - poses[:, 1:3], axis=1) + lever * np.abs(poses[there, 3] - poses[:, 3])
        # Across a gap of more than half a second nothing shows when the object moved.
        without_gap = (there == other) & (np.abs(time[there] - time) <= 0.5)
        moving &= (way > least) & without_gap
    at = np.flatnonzero(moving)
    at = at[np.unique(np.linspace(0, len(at) - 1, min(len(at), 400)).astype(int))] if len(at) else at
    middle = np.array([0.5 * (run[0, 0] + run[-1, 0]) for run in streams.runs])
    half = np.array([0.5 * (run[-1, 0] - run[0, 0]) for run in streams.runs])
    apart = np.abs(time[at, None] - middle) - half
    near = apart.min(axis=1) < 2.0 if len(middle) and len(at) else np.zeros(len(at), dtype=np.bool_)
    number = apart.argmin(axis=1) if len(middle) and len(at) else np.zeros(len(at))
    return MovingFrames(np.asarray(number[near], dtype=np.float64), time[at][near], poses[at][near, 1:], streams)


def _scatter(values: Float64Array) -> float:
    """Standard deviation of a row of values [m], shape (n, 3), from one frame to the next, in all columns together.

    Errors that last do not count: they do not look like motion.
    """
    if len(values) < 3:
        return 0.0
    bend = values[2:] - 2.0 * values[1:-1] + values[:-2]
    # Median of the absolute value and variance of a second difference of independent normal numbers.
    return float(np.linalg.norm(np.median(np.abs(bend), axis=0) / (0.6745 * np.sqrt(6.0))))


def _best(causes: Sequence[Cause], tolerance: float) -> tuple[Cause, ...]:
    """Those that explain the miss, and leave at most twice the error of the best of them."""
    ordered = sorted(causes, key=lambda cause: cause.error)
    least = max(ordered[0].error, tolerance / 3.0) if ordered else 0.0
    return tuple(cause for cause in ordered if cause.error <= 2.0 * least)[:3]


def _causes(frames: MovingFrames) -> Iterator[Cause]:
    """Each mistake that brings pusher and object together; one with more unknowns needs more pushes to be believed."""
    tolerance = frames.streams.tolerance
    found = [*(_unit_causes(frames) if frames.streams.units else ()), *_flipped_cause(frames), *_axes_causes(frames)]
    if frames.n_pushes > 1:
        found += [_radius_cause(frames), _clock_cause(frames)]
    explained = [(cause, distance) for cause, distance in found if _meet(distance, tolerance)]
    for n_unknown, hypotheses in ((2, (_outline_cause,)), (3, (_body_cause, _frame_cause))):
        # A frame that is fitted explains whatever fewer unknowns explain.
        if not explained and frames.n_pushes > n_unknown:
            explained = [fitted for hypothesis in hypotheses if _meet((fitted := hypothesis(frames))[1], tolerance)]
    yield from (cause for cause, _ in explained)


_Found = tuple[Cause, Float64Array]


def _cause(finding: str, mend: str, distance: Float64Array) -> _Found:
    return Cause(finding, mend, _rms(distance)), distance


def _unit_causes(frames: MovingFrames) -> Iterator[_Found]:
    pusher, pose, outline = frames.pusher(), frames.pose, frames.streams.shape.outline
    for factor, unit in _UNITS:
        yield _cause(f"the lengths of the pusher are in {unit}", "check --pusher-length-unit", frames.distance(factor * pusher))
        scaled = np.column_stack([factor * pose[:, :2], pose[:, 2]])
        yield _cause(f"the lengths of the poses are in {unit}", "check --length-unit", frames.distance(pusher, pose=scaled))
        yield _cause(f"the outline is in {unit}", "check --outline-length-unit", frames.distance(pusher, outline=factor * outline))
    yield from _scale_cause(frames)
    for factor, unit in ((np.pi / 180.0, "degrees"), (180.0 / np.pi, "radians")) if "angle" in frames.streams.units else ():
        turned = np.column_stack([pose[:, :2], factor * pose[:, 2]])
        yield _cause(f"the yaw of the poses is in {unit}", "check --angle-unit", frames.distance(pusher, pose=turned))


def _flipped_cause(frames: MovingFrames) -> Iterator[_Found]:
    pusher, pose = frames.pusher(), frames.pose
    flipped = np.column_stack([pose[:, :2], -pose[:, 2]])
    yield _cause("the yaw has the other sign", "the z axis of the poses points down", frames.distance(pusher, pose=flipped))


def _scale_cause(frames: MovingFrames) -> Iterator[_Found]:
    """Poses and pusher in one other unit, the one that fits the outline best; one in which nothing moves fits it by accident."""
    pusher, pose = frames.pusher(), frames.pose
    ways = [np.ptp(pose[frames.push == push, :2], axis=0).max() for push in np.unique(frames.push)]
    found = [
        _cause(
            f"the lengths of poses and pusher are in {unit}",
            "check --length-unit",
            frames.distance(factor * pusher, pose=np.column_stack([factor * pose[:, :2], pose[:, 2]])),
        )
        for factor, unit in _UNITS
        if factor * float(np.median(ways)) >= _SHOWN * frames.streams.tolerance
    ]
    if found:
        yield min(found, key=lambda one: one[0].error)


def _axes_causes(frames: MovingFrames) -> Iterator[_Found]:
    pusher = frames.pusher()
    exchanged = frames.distance(pusher, pose=frames.pose[:, [1, 0, 2]])
    yield _cause("x and y of the poses are exchanged", "exchange their columns", exchanged)
    for swap, sign_x, sign_y in product((False, True), (1.0, -1.0), (1.0, -1.0)):
        if (swap, sign_x, sign_y) == (False, 1.0, 1.0):
            continue
        turn = np.diag([sign_x, sign_y, 1.0])[:, [1, 0, 2] if swap else [0, 1, 2]]
        # Right-handed axes with z up or, where two are exchanged or one is mirrored, down.
        turn[2] *= np.linalg.det(turn)
        mend = f"--pusher-axes {axes_text(turn @ frames.streams.pusher_axes)}"
        yield _cause("the pusher has other axes", mend, frames.distance(pusher @ turn[:2, :2].T))


def _radius_cause(frames: MovingFrames) -> _Found:
    distance = frames.distance(frames.pusher())
    radius = frames.streams.radius + float(np.median(distance))
    if radius < 0:
        return _cause("the outline is too large", "", distance)
    is_small = radius > frames.streams.radius
    text = (
        f"the radius of the pusher is {1e3 * radius:.1f} mm, not {1e3 * frames.streams.radius:.1f} mm, or the outline is too "
        f"{'small' if is_small else 'large'} by {1e3 * abs(radius - frames.streams.radius):.1f} mm on every side"
    )
    return _cause(text, "the distance is the same for both, so measure both", distance - float(np.median(distance)))


def _clock_cause(frames: MovingFrames, latest: float = 2.0, step: float = 0.01) -> _Found:
    """The offset of two clocks up to `latest` [s], in steps of `step` [s]."""
    offsets = np.arange(-latest, latest + step, step)
    offset = min(offsets, key=lambda value: _rms(frames.distance(frames.pusher(float(value)))))
    text = f"the clock of the pusher is {abs(offset):.2f} s {'behind' if offset > 0 else 'ahead'}"
    return _cause(text, f"add {offset:.2f} to --time-offset", frames.distance(frames.pusher(float(offset))))


def _outline_cause(frames: MovingFrames) -> _Found:
    x, y, _ = pose = _pose_of_outline(frames, np.zeros(1))
    return _cause(
        "the origin of the outline is not that of the poses",
        f"add ({x:.4f}, {y:.4f}) m to its points",
        frames.distance(frames.pusher(), outline=transform_points(pose, frames.streams.shape.outline)),
    )


def _body_cause(frames: MovingFrames) -> _Found:
    x, y, yaw = pose = _pose_of_outline(frames, np.arange(0.0, 2.0 * np.pi, np.pi / 4))
    return _cause(
        "the axes of the outline are not those of the poses",
        f"turn its points by {np.degrees(np.angle(np.exp(1j * yaw))):.1f} degrees about their origin and add ({x:.4f}, {y:.4f}) m",
        frames.distance(frames.pusher(), outline=transform_points(pose, frames.streams.shape.outline)),
    )


def _pose_of_outline(frames: MovingFrames, yaws: Float64Array) -> Float64Array:
    """Pose of the outline's frame in that of the poses (x [m], y [m], yaw [rad]), fitted from each of `yaws` [rad]; from 0 alone, without
    its yaw."""
    pusher, outline = frames.pusher(), frames.streams.shape.outline
    extent, free = float(np.linalg.norm(outline, axis=1).max()), 3 if len(yaws) > 1 else 2

    def distance(pose: Float64Array) -> Float64Array:
        return frames.distance(pusher, outline=transform_points(np.append(pose, np.zeros(3 - len(pose))), outline))

    origins = list(product(extent * _PLACES, repeat=2))
    best = [min((np.array([x, y, yaw])[:free] for x, y in origins), key=lambda start: _rms(distance(start))) for yaw in yaws]
    return np.append(_fitted(distance, best, frames.streams.tolerance), np.zeros(3 - free))


def _frame_cause(frames: MovingFrames) -> _Found:
    """The five best starts are fitted: the distance to an outline has several minima."""
    pusher = frames.pusher()

    def starts() -> Iterator[Float64Array]:
        about = _turn_of_ways(frames, pusher)
        extent = float(np.linalg.norm(frames.streams.shape.outline, axis=1).max())
        for yaw in about + _TURNS:
            middle = np.median(frames.pose[:, :2] - transform_points([0.0, 0.0, yaw], pusher), axis=0)
            for x, y in product(extent * _PLACES, repeat=2):
                yield np.array([middle[0] + x, middle[1] + y, yaw])

    best = sorted(starts(), key=lambda start: _rms(frames.distance(transform_points(start, pusher))))[:5]
    pose = _fitted(lambda given: frames.distance(transform_points(given, pusher)), best, frames.streams.tolerance)
    mend = f"--pusher-frame {pose[0]:.4f},{pose[1]:.4f},{pose[2]:.4f}"
    return _cause("the pusher has another frame", mend, frames.distance(transform_points(pose, pusher)))


def _turn_of_ways(frames: MovingFrames, pusher: Float64Array) -> float:
    """By what the way of the pusher is to be turned to point along that of the object, in the mean over the pushes [rad]."""
    turn = 0.0j
    for push in np.unique(frames.push):
        own = np.flatnonzero(frames.push == push)[[0, -1]]
        (x, y), (u, v) = np.diff(frames.pose[own, :2], axis=0)[0], np.diff(pusher[own], axis=0)[0]
        turn += complex(x, y) * complex(u, -v)
    return float(np.angle(turn))


def _fitted(residual: Callable[[Float64Array], Float64Array], starts: Sequence[Float64Array], scale: float) -> Float64Array:
    """The unknowns [m or rad] with the least distances, from the best of several starts; frames beyond `scale` [m] count less.

    A fit that goes to the minimum needs some 20 evaluations.
    """
    from scipy.optimize import OptimizeResult, least_squares

    def fit(start: Float64Array, loss: str) -> OptimizeResult:
        return least_squares(residual, start, loss=loss, f_scale=scale, x_scale=0.01, max_nfev=60)

    # From afar only the sum of squares leads to the minimum; near it, frames beyond the scale must not pull.
    near = min((fit(start, "linear") for start in starts), key=lambda found: float(found.cost))
    return np.asarray(fit(near.x, "soft_l1").x)
