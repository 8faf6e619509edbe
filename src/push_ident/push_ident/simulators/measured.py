"""A simulator as the cell sees it: errors of the tool's path, of clocks and of the camera, which act outside any engine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.physics.effect import Effect, ExportAs, OnPoses, OnPusherPath, OnTimes
from push_ident.physics.effect_values import EffectValues, driven_path, measurement_times, reported_poses, true_pose
from push_ident.simulators.protocol import PushSimulator
from push_ident.types import Float64Array, PusherPath

_STEP: Final = 2e-3
"""Of the path [s]: a lag of the tool is a law of time."""
_OUTSIDE: Final = (OnPusherPath, OnTimes, OnPoses)
_IN_SCENE: Final = (ExportAs.GRAVITY, ExportAs.PUSHER_FRICTION)


def inexpressible(effects: EffectValues) -> tuple[str, ...]:
    """Names of the effects that neither a scene nor corrected data can have."""
    return tuple(one.name for one in effects.effects if not (_is_of_data(one) or one.export in _IN_SCENE))


def of_the_data(effects: EffectValues) -> tuple[str, ...]:
    """Names of the effects of tool, clocks and camera: corrections of the data, not of a scene."""
    return tuple(one.name for one in effects.effects if _is_of_data(one))


def _is_of_data(effect: Effect) -> bool:
    return isinstance(effect.acts, _OUTSIDE) or effect.moves_outline


def outline_offset(effects: EffectValues) -> float:
    """By how much the surface that the pusher touches lies outside the outline [m]."""
    return float(sum(float(np.sum(effects.values[effects.slice_of(one.name)])) for one in effects.effects if one.moves_outline))


def corrected_path(effects: EffectValues, path: PusherPath, order: float = 0.0) -> PusherPath:
    """The path that the tool drove where `path` was reported, after `order` pushes."""
    if offset := outline_offset(effects):
        # A pusher that is thicker touches as a surface that lies further out.
        path = replace(path, radius=max(path.radius + offset, 0.0))
    if not any(isinstance(one.acts, OnPusherPath) for one in effects.effects):
        return path
    time = np.linspace(path.time[0], path.time[-1], max(2, int(np.ceil((path.time[-1] - path.time[0]) / _STEP)) + 1))
    position = [np.interp(time, path.time, path.position[:, axis]) for axis in (0, 1)]
    yaw = np.zeros(len(time)) if path.yaw is None else np.interp(time, path.time, path.yaw)
    driven = driven_path(effects, np.diff(time), np.column_stack([*position, yaw]), order)[0]
    return replace(path, time=time, position=driven[:, :2], yaw=None if path.yaw is None else driven[:, 2])


@dataclass(frozen=True, slots=True)
class Measured:
    """Another simulator whose poses are those that the cell would report, and whose tool goes where it went in the cell."""

    simulator: PushSimulator
    effects: EffectValues
    """Those of path, clocks and camera act; others are the business of the simulator."""
    order: float = 0.0
    """Number of pushes made before."""

    @property
    def name(self) -> str:
        """Of the simulator."""
        return self.simulator.name

    def simulate(self, first_pose: Float64Array, tool_path: PusherPath, times: Float64Array) -> Float64Array:
        """As of `PushSimulator`, with poses as they are reported."""
        measured = measurement_times(self.effects, times)[0]
        poses = self.simulator.simulate(true_pose(self.effects, first_pose), corrected_path(self.effects, tool_path, self.order), measured)
        return reported_poses(self.effects, poses)[0]
