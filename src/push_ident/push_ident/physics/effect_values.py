"""Active effects with their values, and their laws outside the compiled rollout: path, friction, times, poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import InputError
from push_ident.physics.effect import (
    STEP_OF_INPUT,
    Effect,
    EffectParameter,
    OnForces,
    OnForceTimes,
    OnPoses,
    OnPusherFriction,
    OnPusherPath,
    OnTimes,
)  # fmt: skip
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array

ComplexArray = NDArray[np.complex128]
_IMAGINARY_STEP = STEP_OF_INPUT * 1j


@cache
def _effects_of(names: tuple[str, ...]) -> tuple[Effect, ...]:
    """A fit asks for the same ones thousands of times."""
    return tuple(EFFECTS[name] for name in names)


@cache
def _parameters_of(names: tuple[str, ...]) -> tuple[EffectParameter, ...]:
    """One a value."""
    return tuple(parameter for effect in _effects_of(names) for parameter in effect.parameters)


@cache
def _positions_of(names: tuple[str, ...]) -> tuple[tuple[Effect, slice], ...]:
    """Each effect with the position of its values. A fit asks for it in every simulation."""
    ends = np.cumsum([0, *(len(effect.parameters) for effect in _effects_of(names))]).tolist()
    return tuple((effect, slice(*ends[k : k + 2])) for k, effect in enumerate(_effects_of(names)))


@dataclass(frozen=True, slots=True)
class EffectValues:
    """Active effects with the values of their parameters; made by `effect_values`."""

    names: tuple[str, ...]
    """Of the effects, as keys of `EFFECTS`, each once."""
    values: Float64Array
    """Of all their parameters, effect by effect, shape (n_values,)."""

    def __len__(self) -> int:
        return len(self.values)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """In the order of `names`."""
        return _effects_of(self.names)

    @property
    def parameters(self) -> tuple[EffectParameter, ...]:
        """One a value."""
        return _parameters_of(self.names)

    @property
    def labels(self) -> tuple[str, ...]:
        """`effect.parameter`, one a value."""
        return tuple(f"{effect.name}.{parameter.name}" for effect in self.effects for parameter in effect.parameters)

    def slice_of(self, name: str) -> slice:
        """Position of the values of an active effect."""
        for effect, position in _positions_of(self.names):
            if effect.name == name:
                return position
        raise InputError(f"The effect {name!r} is not active, expected one of {', '.join(self.names) or 'none'}.")

    @property
    def of_motion(self) -> EffectValues:
        """Those that change how things move; the others change what is reported."""
        return self._but(OnPoses, OnForces, OnForceTimes)

    @property
    def move_pusher(self) -> bool:
        """Whether one changes the path of the pusher."""
        return any(isinstance(effect.acts, OnPusherPath) for effect in self.effects)

    @property
    def of_poses(self) -> EffectValues:
        """Those that poses show: all but errors of measured forces, with which nothing is simulated."""
        return self._but(OnForces, OnForceTimes)

    @property
    def at_rest(self) -> EffectValues:
        """Those that decide where pushed objects come to rest."""
        reported = (OnTimes, OnPoses, OnForces, OnForceTimes)
        return self._only(effect for effect in self.effects if not (isinstance(effect.acts, reported) or effect.fades_at_rest))

    @property
    def beside_outline(self) -> EffectValues:
        """All but an error of the outline."""
        return self._only(effect for effect in self.effects if not effect.moves_outline)

    def _but(self, *kinds: type) -> EffectValues:
        return self._only(effect for effect in self.effects if not isinstance(effect.acts, kinds))

    def _only(self, kept: Iterable[Effect]) -> EffectValues:
        effects = tuple(kept)
        if len(effects) == len(self.names):
            return self
        values = [self.values[self.slice_of(effect.name)] for effect in effects]
        return EffectValues(tuple(effect.name for effect in effects), np.concatenate([np.zeros(0), *values]))

    def with_values(self, values: ArrayLike) -> EffectValues:
        """The same effects with other values.

        Raises:
            InputError: another shape, or values out of their range.
        """
        array = np.array(values, dtype=np.float64)
        if array.shape != self.values.shape:
            raise InputError(f"`values` has shape {array.shape}, expected {self.values.shape}, one for each of {', '.join(self.labels)}.")
        for number, (parameter, value) in enumerate(zip(self.parameters, array.tolist(), strict=True)):
            if not (math.isfinite(value) and parameter.low <= value <= parameter.high):
                label = self.labels[number]
                raise InputError(f"{label} is {value} {parameter.unit}".rstrip() + f", expected {parameter.low:g} to {parameter.high:g}.")
        array.setflags(write=False)
        return EffectValues(self.names, array)


EffectsLike = EffectValues | Mapping[str, Mapping[str, float] | ArrayLike] | Sequence[str]
"""Effects by name, each with its values in order or by name (those left out are nominal): {"table_tilt": {"x": 0.01}}. A list
of names gives effects at their nominal values, which have no influence but a derivative."""

NO_EFFECTS = EffectValues((), np.zeros(0))


def effect_values(effects: EffectsLike | None) -> EffectValues:
    """Active effects in the form of this package.

    Raises:
        InputError: an unknown effect or parameter, another number of values, or values out of their range.
    """
    if effects is None:
        return NO_EFFECTS
    if isinstance(effects, EffectValues):
        return effects
    given: dict[str, Any] = dict(effects) if isinstance(effects, Mapping) else {name: {} for name in effects}
    values: list[Float64Array] = []
    for name, value in given.items():
        if name not in EFFECTS:
            raise InputError(f"There is no effect {name!r}, expected some of {', '.join(EFFECTS)}.")
        effect = EFFECTS[name]
        if isinstance(value, Mapping):
            known = [parameter.name for parameter in effect.parameters]
            if unknown := set(value) - set(known):
                raise InputError(f"{name} has no parameter {sorted(unknown)[0]!r}, expected some of {', '.join(known)}.")
            value = [value.get(parameter.name, parameter.nominal) for parameter in effect.parameters]
        array = np.atleast_1d(np.array(value, dtype=np.float64))
        if array.shape != (len(effect.parameters),):
            raise InputError(f"{name} got {array.size} values, expected {len(effect.parameters)}.")
        values.append(array)
    together = np.concatenate(values) if values else np.zeros(0)
    return EffectValues(tuple(given), np.full(len(together), np.nan)).with_values(together)


_Step = Callable[[ComplexArray, ComplexArray], ComplexArray]


def _steps(effects: EffectValues, kind: type, law: str) -> list[tuple[slice, _Step]]:
    """Laws of the active effects that act on one kind of thing, with the positions of their values."""
    return [(position, getattr(effect.acts, law)) for effect, position in _positions_of(effects.names) if isinstance(effect.acts, kind)]


def _through(steps: list[tuple[slice, _Step]], effects: EffectValues, x: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Result of steps (values, x) -> x, one after the other, and its derivative by the values, shape (n_values, *x.shape)."""
    by_value = np.zeros((len(effects), *x.shape))
    if not steps:
        return np.array(x, dtype=np.float64, order="C"), by_value
    values = effects.values.astype(np.complex128)

    def result() -> ComplexArray:
        y = x.astype(np.complex128)
        for position, step in steps:
            y = step(values[position], y)
        return y

    for position, _ in steps:
        for k in range(position.start, position.stop):
            values[k] += _IMAGINARY_STEP
            by_value[k] = result().imag / STEP_OF_INPUT
            values[k] = effects.values[k]
    return np.ascontiguousarray(result().real), by_value


def driven_path(
    effects: EffectValues, dt: float | Float64Array, path: Float64Array, order: float = 0.0
) -> tuple[Float64Array, Float64Array]:
    """The path that the pusher drove where `path` was reported, poses at the steps' ends, shape (n_steps + 1, 3), table frame.

    `dt`: length of the steps [s], a number or shape (n_steps,); `order`: number of pushes made before.

    Returns:
        The path, and its derivative by the values, shape (n_values, n_steps + 1, 3).
    """
    moves = _steps(effects, OnPusherPath, "move")
    return _through([(position, partial(_move, move, dt, order)) for position, move in moves], effects, path)


def _move(
    move: Callable[..., ComplexArray], dt: float | Float64Array, order: float, values: ComplexArray, path: ComplexArray
) -> ComplexArray:
    return move(values, dt, path, order)


def changed_friction(effects: EffectValues, coefficient: float) -> tuple[float, Float64Array]:
    """The pusher's friction coefficient under the effects, where that of the model is `coefficient`, and its derivative by the values."""
    value, by_value = _through(_steps(effects, OnPusherFriction, "change"), effects, np.array([coefficient]))
    return float(value[0]), by_value[:, 0]


def measurement_times(effects: EffectValues, time: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Times [s] at which the poses reported for `time` were measured, shape (n_frames,), and their derivative by the values, shape
    (n_values, n_frames)."""
    return _through(_steps(effects, OnTimes, "move"), effects, time)


def force_times(effects: EffectValues, time: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Times [s] at which the forces reported for `time` were measured, shape (n,), and their derivative by the values, shape (n_values,
    n)."""
    return _through(_steps(effects, OnForceTimes, "move"), effects, time)


def reported_poses(effects: EffectValues, pose: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Reported poses for true ones, shape (n_frames, 3), table frame.

    Returns:
        The poses; their derivative by the true ones, shape (n_frames, 3, 3); and by the values, shape (n_values, n_frames, 3).
    """
    return _reported(effects, OnPoses, pose)


def measured_forces(effects: EffectValues, force: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Measured forces for true ones of the pusher on the object [N], shape (n, 2), table frame.

    Returns:
        The forces; their derivative by the true ones, shape (n, 2, 2); and by the values, shape (n_values, n, 2).
    """
    return _reported(effects, OnForces, force)


def _reported(effects: EffectValues, kind: type, true: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    steps = _steps(effects, kind, "report")
    value, by_value = _through(steps, effects, true)
    by_true = np.empty((*true.shape, true.shape[1]))
    for axis in range(true.shape[1]):
        stepped = true.astype(np.complex128)
        stepped[:, axis] += _IMAGINARY_STEP
        for position, report in steps:
            stepped = report(effects.values[position].astype(np.complex128), stepped)
        by_true[:, :, axis] = stepped.imag / STEP_OF_INPUT
    return value, by_true, by_value


def true_pose(effects: EffectsLike | None, reported: Float64Array) -> Float64Array:
    """The pose that is reported as `reported`, shape (3,), table frame: the inverse of `reported_poses`."""
    acting = effect_values(effects)
    pose = np.array(reported, dtype=np.float64)
    if any(isinstance(effect.acts, OnPoses) for effect in acting.effects):
        # Newton's method. Measurements change poses by little and smoothly: two steps reach rounding.
        for _ in range(4):
            pose_of_estimate, by_pose, _ = reported_poses(acting, pose[None])
            pose -= np.linalg.solve(by_pose[0], pose_of_estimate[0] - reported)
    return pose
