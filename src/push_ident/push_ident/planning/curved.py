"""Pushes that curve: short pushes of one contact, improved so that the object stays on a path.

The tool moves as if it were fixed to an object that keeps to the path, plus a relative velocity in each of three segments:

    p(t) = ref(s0 + v t) o (q0 + sum_k w_k t_k(t))        t_k: time spent in segment k, w_k: unknown, two numbers a segment

so the unknowns turn the tool's heading and change its speed; at zero the tool follows the path like the object. Gauss-Newton
improves them: the residuals are the errors of the object along the path under each of several models, in tolerances, and the contact that
slides to the end of its face, the tool that leaves the object, its corridor or its workspace. All pushes, with one unknown changed in each,
are simulated in one batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.geometry.se2 import inverse, rotation, transform_points, wrap_angle
from push_ident.physics.batch import BatchClock, ModelBatch
from push_ident.planning.path_goal import PathGoal
from push_ident.pushing.push import PushSettings
from push_ident.pushing.tool_path import Corridor
from push_ident.types import Float64Array

_BREAKS: Final = np.array([0.0, 0.15, 0.45, 1.0])
"""Ends of the segments as shares of the horizon [1]: the first is the one that will be made before the next plan."""
N_SEGMENTS: Final = len(_BREAKS) - 1
N_LIMITS: Final = 2
"""Number of limits of the tool with a residual each, the last ones: corridor and workspace."""
_DAMPING: Final = np.array([0.5, 0.15])
"""Residual of an unknown of one speed, along and across the path [tolerances]: regularises unknowns that hardly change the errors."""


@dataclass(frozen=True, slots=True)
class CurvedOptions:
    """Numbers of the simulation and the optimisation of curved pushes."""

    frames: int = 8
    """Poses along a push that are compared with the path."""
    step_travel: float = 0.0025
    """Travel of the tool in a time step [m]."""
    longest_step: float = 0.1
    """Longest time step [s]."""
    difference: float = 0.1
    """Change of an unknown for the derivative [speeds of the path]: large enough that the contact may begin or cease to slide."""
    largest: float = 1.2
    """Largest unknown [speeds of the path]."""
    largest_change: float = 0.5
    """Largest change of an unknown in an iteration [speeds of the path]."""
    step_shares: tuple[float, ...] = (1.0, 0.5, 0.2)
    """Shares of a Gauss-Newton step that are tried [1]."""
    face_margin: float = 0.005
    """Least distance of the contact from the end of its face [m]."""
    face_scale: float = 0.002
    """Violation of that by one tolerance [m]."""
    gap_margin: float = 0.002
    """Largest gap between tool and object [m]."""
    gap_scale: float = 0.002
    """Violation of that by one tolerance [m]."""
    limit_scale: float = 0.001
    """Distance beyond corridor or workspace that is one tolerance [m]."""
    failed: float = 1e3
    """Residual of a failed simulation [tolerances]."""


_OPTIONS: Final = CurvedOptions()


@dataclass(frozen=True, slots=True)
class Face:
    """The straight part of the outline that the tool touches, object frame."""

    start: Float64Array
    """[m], shape (2,)."""
    tangent: Float64Array
    """Unit vector, counter-clockwise, shape (2,)."""
    length: float
    """[m]"""
    is_open: tuple[bool, bool]
    """Whether the tool would slide off beyond the start, or the end: not in a concave corner."""

    @property
    def normal(self) -> Float64Array:
        """Outward, shape (2,)."""
        return np.array([self.tangent[1], -self.tangent[0]])


def face_of(outline: Float64Array, tool: Float64Array) -> tuple[Face, float]:
    """The face nearest to the axis of the tool, shape (2,), and its distance [m], negative inside; object frame."""
    edge = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(edge, axis=1)
    tangent = edge / np.maximum(length, 1e-12)[:, None]
    along = np.clip(np.sum((tool - outline) * tangent, axis=1), 0.0, length)
    offset = tool - outline - along[:, None] * tangent
    distance = np.linalg.norm(offset, axis=1)
    side = tangent[:, 1] * offset[:, 0] - tangent[:, 0] * offset[:, 1]
    # At a corner both faces are equally near: the one that the tool is in front of.
    k = int(np.lexsort((-side, np.round(distance, 9)))[0])
    turn = np.roll(edge, 1, axis=0)
    convex = turn[:, 0] * edge[:, 1] - turn[:, 1] * edge[:, 0] > 0
    face = Face(outline[k], tangent[k], float(length[k]), (bool(convex[k]), bool(convex[(k + 1) % len(outline)])))
    return face, float(distance[k] if side[k] >= 0 else -distance[k])


@dataclass(frozen=True, slots=True)
class PushStart:
    """Where a push begins."""

    pose: Float64Array
    """Of the object, table frame, shape (3,), when the lead begins."""
    velocity: Float64Array
    """Of the object frame then [m/s, m/s, rad/s], shape (3,)."""
    done: float
    """Length of path that is behind when the segments begin [m]."""
    lead: Float64Array
    """Axis of the tool at the times of the lead, table frame [m], shape (n_lead, 2): what is not to be changed any more."""
    face: Face
    """That is touched."""


@dataclass(frozen=True, slots=True)
class Horizon:
    """Times of a push: a lead, then the segments from 0 on."""

    speed: float
    """Along the path [m/s]."""
    lead: Float64Array
    """[s], shape (n_lead,), ascending, the last is 0."""
    knots: Float64Array
    """When the tool is where [s], shape (n_knots,), the lead among them."""
    frames: Float64Array
    """When poses are compared with the path [s], shape (n_frames,)."""
    breaks: Float64Array
    """Beginnings and ends of the segments [s], shape (N_SEGMENTS + 1,)."""
    clock: BatchClock
    """Steps of the simulation."""
    at_frames: np.ndarray
    """Numbers of the knots at the frames, shape (n_frames,)."""

    @classmethod
    def of(cls, speed: float, travel: float, lead: Float64Array) -> Horizon:
        """For a travel along the path [m]; `lead` as its times."""
        end, step = travel / speed, min(_OPTIONS.step_travel / speed, _OPTIONS.longest_step)
        n = max(_OPTIONS.frames, int(np.ceil(end / step)))
        n += -n % _OPTIONS.frames
        later = end * np.arange(1, n + 1) / n
        knots, frames = np.concatenate([lead, later]), later[n // _OPTIONS.frames - 1 :: n // _OPTIONS.frames]
        at_frames = np.searchsorted(knots, frames - 1e-9)
        return cls(speed, lead, knots, frames, end * _BREAKS, BatchClock.of(knots, frames, step), at_frames)

    def later(self, unknowns: Float64Array, delay: float) -> Float64Array:
        """Unknowns, shape (N_SEGMENTS, 2), of the same motion when a time [s] has passed."""
        ends = np.minimum(self.breaks + delay, self.breaks[-1])
        spent = np.clip(ends[:, None] - self.breaks[:-1], 0.0, np.diff(self.breaks))
        return np.asarray(np.diff(spent @ unknowns, axis=0) / np.diff(self.breaks)[:, None])


@dataclass(frozen=True, slots=True)
class RolledPushes:
    """Pushes, and what they do under several models."""

    tool: Float64Array
    """Axis of the tool at the knots [m], shape (n_starts, n_variants, n_knots, 2)."""
    poses: Float64Array
    """Of the object at the frames, shape (n_models, n_starts, n_variants, n_frames, 3)."""
    residual: Float64Array
    """In tolerances, shape (n_models, n_starts, n_variants, n_residuals)."""
    error: Float64Array
    """Across the path and in yaw, at the frames, in tolerances: root of the sum of squares, shape (n_models, n_starts, n_variants,
    n_frames)."""
    progress: Float64Array
    """Along the path since the segments began, at the frames [m], of that shape."""

    @property
    def cost(self) -> Float64Array:
        """Mean over the models of the sum of squared residuals, shape (n_starts, n_variants)."""
        return np.asarray(np.mean(np.sum(self.residual**2, axis=-1), axis=0))


@dataclass(frozen=True, slots=True)
class _Prepared:
    """Arrays that all pushes from some starts share, computed once for many simulations."""

    horizon: Horizon
    starts: Sequence[PushStart]
    lead: Float64Array
    """Of the tool, shape (n_starts, n_lead, 2)."""
    offset: Float64Array
    """Axis of the tool at the end of the lead, frame of the path there, shape (n_starts, 1, 1, 2)."""
    turn: Float64Array
    """From the directions along and across the path to that frame, shape (n_starts, 1, 1, 2, 2)."""
    frame: Float64Array
    """The object on its path at the knots after the lead, shape (n_starts, 1, n_later, 3), and its rotation."""
    frame_turn: Float64Array
    spent: Float64Array
    """Time in each segment at those knots [s], shape (n_later, N_SEGMENTS)."""
    wanted: Float64Array
    """The object on its path at the frames, shape (n_starts, 1, n_frames, 3)."""
    to_path: Float64Array
    """From the table to the directions along and across the path there, shape (n_starts, 1, n_frames, 2, 2)."""
    progress: Float64Array
    """Reference progress along the path at the frames since the segments began [m], shape (n_starts, 1, n_frames)."""
    pose: Float64Array
    """At the start, shape (n_starts, 3), and velocity."""
    velocity: Float64Array
    faces: tuple[Float64Array, ...]
    """Start, tangent, normal, length and openness of each, with axes for variants and frames."""


class CurvedPushes:
    """Simulates and optimises pushes of one object along one path, with limits of the tool; no corridor: the workspace alone."""

    def __init__(self, settings: PushSettings, path: PathGoal, corridor: Corridor | None = None) -> None:
        self._settings, self._path, self._corridor = settings, path, corridor

    def roll(self, models: ModelBatch, horizon: Horizon, starts: Sequence[PushStart], unknowns: Float64Array) -> RolledPushes:
        """Simulate pushes.

        `unknowns`: velocities along and across the path beside that of the path, in its speed, shape (n_starts, n_variants, N_SEGMENTS, 2).
        """
        return self._roll(models, self._prepared(horizon, starts), unknowns)

    def _prepared(self, horizon: Horizon, starts: Sequence[PushStart]) -> _Prepared:
        path, later = self._path, horizon.knots[len(horizon.lead) :]
        lead = np.array([start.lead for start in starts])
        begun = np.array([start.done for start in starts])
        now = path.at(begun)
        offset = np.array([transform_points(inverse(pose), tool[-1:])[0] for pose, tool in zip(now, lead, strict=True)])
        frame = path.at(begun[:, None] + horizon.speed * later)[:, None]
        reference = np.minimum(begun[:, None] + horizon.speed * horizon.frames, path.length)
        faces = [start.face for start in starts]
        start, tangent, normal = (
            np.array([getattr(face, name) for face in faces])[:, None, None] for name in ("start", "tangent", "normal")
        )
        opens = np.array([face.is_open for face in faces], dtype=np.float64)[:, None, None]
        length = np.array([face.length for face in faces])[:, None, None]
        return _Prepared(
            horizon,
            starts,
            lead,
            offset[:, None, None, :],
            rotation(path.direction(begun) - now[:, 2])[:, None, None],
            frame,
            rotation(frame[..., 2]),
            np.clip(later[:, None] - horizon.breaks[:-1], 0.0, np.diff(horizon.breaks)),
            path.at(reference)[:, None],
            np.swapaxes(rotation(path.direction(reference)), -1, -2)[:, None],
            (reference - begun[:, None])[:, None],
            np.array([start_of.pose for start_of in starts]),
            np.array([start_of.velocity for start_of in starts]),
            (start, tangent, normal, length, opens),
        )

    def _tool(self, prepared: _Prepared, unknowns: Float64Array) -> Float64Array:
        in_path_frame = prepared.offset + prepared.horizon.speed * _turned(prepared.turn, prepared.spent @ unknowns)
        moving = prepared.frame[..., :2] + _turned(prepared.frame_turn, in_path_frame)
        fixed = np.broadcast_to(prepared.lead[:, None], (len(prepared.lead), unknowns.shape[1], *prepared.lead.shape[1:]))
        return self._slowed(prepared.horizon, np.concatenate([fixed, moving], axis=2))

    def _slowed(self, horizon: Horizon, tool: Float64Array) -> Float64Array:
        """Tool paths of the same headings, no faster than the tool may be: a slower tool stays in contact and is corrected again."""
        step, n_fixed = np.diff(tool, axis=2), len(horizon.lead) - 1
        share = self._settings.max_speed * np.diff(horizon.knots) / np.maximum(np.hypot(step[..., 0], step[..., 1]), 1e-12)
        share[..., :n_fixed] = 1.0
        if np.all(share >= 1.0):
            return tool
        slower = tool[:, :, :1] + np.cumsum(step * np.minimum(share, 1.0)[..., None], axis=2)
        # Paths that are not too fast stay equal to the last bit.
        too_fast = np.min(share, axis=-1) < 1.0
        changed = np.where(too_fast[..., None, None], slower, tool[:, :, 1:])
        return np.concatenate([tool[:, :, :1], changed], axis=2)

    def _roll(self, models: ModelBatch, prepared: _Prepared, unknowns: Float64Array) -> RolledPushes:
        n_starts, n_variants = unknowns.shape[:2]
        each, n_frames = (len(models), n_starts, n_variants), len(prepared.horizon.frames)
        tool = self._tool(prepared, unknowns)
        first, velocity = np.repeat(prepared.pose, n_variants, axis=0), np.repeat(prepared.velocity, n_variants, axis=0)
        poses = models.roll(prepared.horizon.clock, tool.reshape(-1, *tool.shape[2:]), first, velocity).reshape(*each, n_frames, 3)
        difference = poses - prepared.wanted
        along_across = _turned(prepared.to_path, difference[..., :2])
        error = np.empty_like(poses)
        error[..., 0] = along_across[..., 0] / self._path.position
        error[..., 1] = along_across[..., 1] / self._path.position
        error[..., 2] = wrap_angle(difference[..., 2]) / self._path.yaw
        failed = np.asarray(~np.isfinite(error).all(axis=(-1, -2)))
        if failed.any():
            error = np.where(failed[..., None, None], _OPTIONS.failed, error)
            poses = np.where(failed[..., None, None], prepared.wanted, poses)
            along_across = np.where(failed[..., None, None], 0.0, along_across)
        residual = np.empty((*each, 5 * n_frames + 2 * N_SEGMENTS + N_LIMITS))
        residual[..., : 3 * n_frames] = (error / np.sqrt(n_frames)).reshape(*each, -1)
        residual[..., 3 * n_frames : 5 * n_frames] = self._contact(prepared, tool, poses).reshape(*each, -1)
        residual[..., 5 * n_frames : -N_LIMITS] = (_DAMPING * unknowns).reshape(n_starts, n_variants, -1)
        residual[..., -N_LIMITS:] = self._limits(prepared.horizon, tool)
        progress = np.where(failed[..., None], 0.0, prepared.progress + along_across[..., 0])
        return RolledPushes(tool, poses, residual, np.hypot(error[..., 1], error[..., 2]), progress)

    def _contact(self, prepared: _Prepared, tool: Float64Array, poses: Float64Array) -> Float64Array:
        """How far the contact is beyond its face, and the tool away, at the frames: shape (n_models, n_starts, n_variants, n_frames, 2)."""
        offset = tool[:, :, prepared.horizon.at_frames] - poses[..., :2]
        cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        start, tangent, normal, length, opens = prepared.faces
        x, y = cos * offset[..., 0] + sin * offset[..., 1] - start[..., 0], cos * offset[..., 1] - sin * offset[..., 0] - start[..., 1]
        margin = np.minimum(_OPTIONS.face_margin, 0.3 * length)
        along = x * tangent[..., 0] + y * tangent[..., 1]
        beyond = opens[..., 0] * np.maximum(margin - along, 0.0) + opens[..., 1] * np.maximum(along - length + margin, 0.0)
        gap = np.maximum(x * normal[..., 0] + y * normal[..., 1] - self._settings.pusher_radius - _OPTIONS.gap_margin, 0.0)
        share = 1.0 / np.sqrt(poses.shape[-2])
        return np.stack([share / _OPTIONS.face_scale * beyond, share / _OPTIONS.gap_scale * gap], axis=-1)

    def _limits(self, horizon: Horizon, tool: Float64Array) -> Float64Array:
        """Corridor and workspace, each as far as it is violated most: shape (n_starts, n_variants, N_LIMITS)."""
        x_min, x_max, y_min, y_max = self._settings.workspace
        outside = np.max(np.maximum(np.array([x_min, y_min]) - tool, tool - np.array([x_max, y_max])), axis=(-1, -2))
        corridor = np.zeros(tool.shape[:2])
        if self._corridor is not None:
            corridor = np.max(self._corridor.excess(tool[:, :, horizon.at_frames]), axis=-1)
        return np.stack([corridor / _OPTIONS.limit_scale, np.maximum(outside, 0.0) / _OPTIONS.limit_scale], axis=-1)

    def improve(
        self,
        models: ModelBatch,
        horizon: Horizon,
        starts: Sequence[PushStart],
        first: Float64Array,
        n_iterations: int,
        is_late: Callable[[], bool] = lambda: False,
    ) -> tuple[Float64Array, RolledPushes]:
        """Better unknowns, shape (n_starts, N_SEGMENTS, 2), and what they do (one variant), after some iterations of Gauss-Newton.

        `first`: guesses, shape (n_starts, n_guesses, N_SEGMENTS, 2), of which the best of each start is improved; `is_late`: called before
        each iteration, the best so far is returned when it is true.
        """
        n_starts, prepared = len(first), self._prepared(horizon, starts)
        number, n_unknowns = np.arange(n_starts), 2 * N_SEGMENTS
        rolled = self._roll(models, prepared, first)
        chosen = np.argmin(rolled.cost, axis=1)
        best, cost = first[number, chosen], rolled.cost[number, chosen]
        kept = _picked(rolled, number, chosen)
        for _ in range(n_iterations):
            if is_late():
                break
            changes = _OPTIONS.difference * np.eye(n_unknowns).reshape(n_unknowns, N_SEGMENTS, 2)
            # Towards zero, so that an unknown stays in its range.
            sign = np.where(best > 0, -1.0, 1.0)
            varied = self._roll(models, prepared, best[:, None] + changes * sign[:, None])
            by_unknown = (varied.residual - kept.residual) / (_OPTIONS.difference * sign.reshape(n_starts, n_unknowns, 1))
            step = _gauss_newton(by_unknown, kept.residual[:, :, 0]).reshape(best.shape)
            tried = np.stack([np.clip(best + share * step, -_OPTIONS.largest, _OPTIONS.largest) for share in _OPTIONS.step_shares], axis=1)
            stepped = self._roll(models, prepared, tried)
            chosen = np.argmin(stepped.cost, axis=1)
            better = stepped.cost[number, chosen] < cost
            kept = _merged(better, _picked(stepped, number, chosen), kept)
            best = np.where(better[:, None, None], tried[number, chosen], best)
            cost = np.where(better, stepped.cost[number, chosen], cost)
        return best, kept


def _turned(matrix: Float64Array, vectors: Float64Array) -> Float64Array:
    """Matrices, shape (..., 2, 2), times vectors, shape (..., 2)."""
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([matrix[..., 0, 0] * x + matrix[..., 0, 1] * y, matrix[..., 1, 0] * x + matrix[..., 1, 1] * y], axis=-1)


def _gauss_newton(by_unknown: Float64Array, residual: Float64Array) -> Float64Array:
    """Step of each start, shape (n_starts, n_unknowns).

    `by_unknown`: shape (n_models, n_starts, n_unknowns, n_residuals); `residual`: shape (n_models, n_starts, n_residuals).
    """
    n_models = len(residual)
    matrix = np.einsum("mcur,mcvr->cuv", by_unknown, by_unknown) / n_models + 1e-3 * np.eye(by_unknown.shape[2])
    right = np.einsum("mcur,mcr->cu", by_unknown, residual) / n_models
    step = -np.linalg.solve(matrix, right[..., None])[..., 0]
    largest = np.max(np.abs(step), axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _OPTIONS.largest_change / np.maximum(largest, 1e-12)))


def _picked(rolled: RolledPushes, number: np.ndarray, chosen: np.ndarray) -> RolledPushes:
    """One variant of each start."""
    of_models = (array[:, number, chosen][:, :, None] for array in (rolled.poses, rolled.residual, rolled.error, rolled.progress))
    return RolledPushes(rolled.tool[number, chosen][:, None], *of_models)


def _merged(better: np.ndarray, new: RolledPushes, old: RolledPushes) -> RolledPushes:
    """Of each start the new one where it is better."""

    def pick(name: str, axis: int) -> Float64Array:
        now, then = getattr(new, name), getattr(old, name)
        shape = [1] * now.ndim
        shape[axis] = len(better)
        return np.where(better.reshape(shape), now, then)

    return RolledPushes(pick("tool", 0), *(pick(name, 1) for name in ("poses", "residual", "error", "progress")))
