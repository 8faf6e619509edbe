"""When and how the poses of a rollout are reported, and the derivative of reported poses.

With effects on times and poses, the pose reported for the time t is

    reported(t) = report(pose(move(t))),      d reported = report' (d pose + pose' d move) + d report

pose' is the velocity, the slope of the rollout between the ends of the step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from push_ident.physics.effect import OnPoses, OnTimes
from push_ident.physics.effect_values import EffectValues, measurement_times, reported_poses
from push_ident.physics.tape import Frames, Param
from push_ident.types import BoolArray, Float64Array


@dataclass(frozen=True, slots=True)
class StepClock:
    """The steps of a rollout."""

    ends: Float64Array
    """Start of the first step and ends of all [s], shape (n_steps + 1,)."""
    lengths: Float64Array
    """Of the steps [s], shape (n_steps,)."""
    step: float | None
    """Length of a step where all are equal [s]."""

    @classmethod
    def of(cls, start: float, end: float, step: float) -> StepClock:
        """Equal steps from `start` until at least `end` [s], one at least."""
        n_steps = max(1, int(np.ceil((end - start) / step)))
        ends = np.asarray(start + step * np.arange(n_steps + 1), dtype=np.float64)
        return cls(ends, np.full(n_steps, step), step)

    @classmethod
    def through(cls, times: Float64Array, end: float, step: float) -> StepClock:
        """Steps no longer than `step` [s] that end at given `times` [s], ascending, shape (n,), the first being the start.

        Of times that lie closer together than a step, one a step is met. After the last time, steps go on until `end`.
        """
        slot = np.floor((times - times[0]) / step + 1e-9)
        met = times[np.flatnonzero(np.diff(slot, prepend=-1.0) > 0)]
        met = np.unique(np.append(met, [times[-1], max(end, times[-1])]))
        if len(met) < 2:
            met = np.append(met, met[0] + step)
        parts = np.maximum(1, np.ceil(np.diff(met) / step - 1e-9)).astype(np.int64)
        lengths = np.repeat(np.diff(met) / parts, parts)
        within = np.arange(len(lengths)) - np.repeat(np.cumsum(parts) - parts, parts)
        return cls(np.append(np.repeat(met[:-1], parts) + within * lengths, met[-1]), lengths, None)

    @property
    def n_steps(self) -> int:
        """Number of steps."""
        return len(self.lengths)

    @property
    def dt(self) -> float | Float64Array:
        """Length of the steps [s]: one number where they are equal, otherwise shape (n_steps,)."""
        return self.lengths if self.step is None else self.step

    @property
    def middles(self) -> Float64Array:
        """Of the steps [s], shape (n_steps,)."""
        return np.asarray(self.ends[:-1] + self.dt / 2)

    def frames(self, time: Float64Array) -> tuple[Frames, BoolArray]:
        """Step and fraction of it at which each time [s] lies, shape (n_frames,), and whether that is within the rollout."""
        if self.step is not None:
            at = np.clip((time - self.ends[0]) / self.step, 0.0, self.n_steps)
            step = np.minimum(at.astype(np.int64), self.n_steps - 1)
            return Frames(step, at - step), (at > 0.0) & (at < self.n_steps)
        step = np.clip(np.searchsorted(self.ends, time, side="right") - 1, 0, self.n_steps - 1)
        fraction = np.clip((time - self.ends[step]) / self.lengths[step], 0.0, 1.0)
        return Frames(step, fraction), (time > self.ends[0]) & (time < self.ends[-1])


@dataclass(frozen=True, slots=True)
class ReportTimes:
    """When the reported poses are measured."""

    clock: StepClock
    frames: Frames
    within: BoolArray
    """Whether each is within the rollout, so that it moves with the time, shape (n_frames,)."""
    by_value: Float64Array
    """Derivative of the times by the values of the effects [s], shape (n_values, n_frames)."""

    @classmethod
    def of(cls, time: Float64Array, clock: StepClock) -> ReportTimes:
        """For poses that are reported for `time` [s], shape (n_frames,), without effects."""
        return cls(clock, *clock.frames(time), np.zeros((0, len(time))))

    def with_effects(self, time: Float64Array, effects: EffectValues) -> ReportTimes:
        """The same times [s], shape (n_frames,), with effects on them."""
        if not any(isinstance(effect.acts, OnTimes) for effect in effects.effects):
            return replace(self, by_value=np.zeros((len(effects), len(time)))) if len(effects) > 0 else self
        measured, by_value = measurement_times(effects, time)
        return ReportTimes(self.clock, *self.clock.frames(measured), by_value)

    @property
    def is_moved(self) -> bool:
        """Whether effects move the times, so that the derivative needs the velocity."""
        return len(self.by_value) > 0 and bool(np.any(self.by_value))

    @property
    def simulated(self) -> Frames:
        """Frames to simulate: those reported, each after the ends of its step where the velocity is needed."""
        if not self.is_moved:
            return self.frames
        reported = self.frames.fraction
        fraction = np.column_stack([np.zeros_like(reported), np.ones_like(reported), reported]).ravel()
        return Frames(np.repeat(self.frames.step, 3), fraction)

    def split(self, pose: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Poses at the frames and their velocities, each shape (n_frames, 3), from those at the frames `wanted`."""
        if not self.is_moved:
            return pose, np.zeros((len(self.frames.step), 3))
        velocity = (pose[1::3] - pose[::3]) / self.clock.lengths[self.frames.step][:, None] * self.within[:, None]
        return np.ascontiguousarray(pose[2::3]), velocity


@dataclass(frozen=True, slots=True)
class Measurement:
    """Derivative of reported poses by the true ones at the times of measurement, and by effects outside the rollout."""

    by_pose: Float64Array
    """Shape (n_frames, 3, 3)."""
    by_value: Float64Array
    """Shape (n_frames, 3, n_values)."""
    mu_by_value: Float64Array
    """Of the pusher's friction coefficient, shape (n_values,)."""
    is_true: bool
    """Whether poses are reported as they are, so that `by_pose` is the identity."""

    @classmethod
    def of(
        cls, effects: EffectValues, times: ReportTimes, pose: Float64Array, mu_by_value: Float64Array, n_modes: int = 0
    ) -> tuple[Float64Array, Measurement]:
        """Reported poses at the frames, shape (n_frames, 3), and their derivative, from poses at the frames that `times` wants.

        The `n_modes` of the outline, which change nothing here, are values behind those of the effects.
        """
        pose, velocity = times.split(pose)
        pose, by_pose, by_value = reported_poses(effects, pose)
        if times.is_moved:
            by_value += np.einsum("fij,fj,vf->vfi", by_pose, velocity, times.by_value)
        is_true = not any(isinstance(effect.acts, OnPoses) for effect in effects.effects)
        by_value = np.concatenate([by_value, np.zeros((n_modes, *pose.shape))])
        return pose, cls(by_pose, np.moveaxis(by_value, 0, 2), np.append(mu_by_value, np.zeros(n_modes)), is_true)

    def of_jacobian(self, jacobian: Float64Array) -> Float64Array:
        """That of the reported poses from that of the true ones."""
        n_values = len(self.mu_by_value)
        jacobian[:, :, -n_values:] += jacobian[:, :, Param.MU, None] * self.mu_by_value
        reported: Float64Array = jacobian if self.is_true else self.by_pose @ jacobian
        reported[:, :, -n_values:] += self.by_value
        return reported

    def add_pusher_friction(self, by_impulse: Float64Array) -> None:
        """Add what the values do to impulses through the pusher's friction, shape (n_forces, 2, n_columns)."""
        n_values = len(self.mu_by_value)
        by_impulse[:, :, -n_values:] += by_impulse[:, :, Param.MU, None] * self.mu_by_value

    def by_true_pose(self, by_pose: Float64Array) -> Float64Array:
        """Gradient by the true poses from that by the reported ones."""
        return np.einsum("fij,fi->fj", self.by_pose, by_pose)

    def add_gradient(self, by_pose: Float64Array, gradient: Float64Array) -> None:
        """Add the part of the values themselves to the gradient of a loss."""
        n_values = len(self.mu_by_value)
        gradient[-n_values:] += gradient[Param.MU] * self.mu_by_value + np.einsum("fiv,fi->v", self.by_value, by_pose)
