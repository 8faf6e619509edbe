"""Effects put into recordings of others: the records as a cell with these errors would have reported them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.types import Float64Array, PusherPath, PushRecord
from push_ident_sim.injected.effects import INJECTED, InjectedEffects
from push_ident_sim.injected.sensing import observed_poses

Values = tuple[float, ...]


def _poses(name: str) -> Callable[[PushRecord, Values], PushRecord]:
    def change(record: PushRecord, values: Values) -> PushRecord:
        poses = record.poses
        return replace(record, poses=replace(poses, pose=observed_poses(InjectedEffects.of({name: values}), poses.pose)))

    return change


def _late(record: PushRecord, values: Values) -> PushRecord:
    return replace(record, poses=replace(record.poses, time=record.poses.time + values[0]))


def _path(position: Callable[[PusherPath, Values], Float64Array]) -> Callable[[PushRecord, Values], PushRecord]:
    def change(record: PushRecord, values: Values) -> PushRecord:
        return replace(record, pusher=replace(record.pusher, position=position(record.pusher, values)))

    return change


def _offset(path: PusherPath, values: Values) -> Float64Array:
    return path.position - values


def _scaled(path: PusherPath, values: Values) -> Float64Array:
    return path.position[0] + (path.position - path.position[0]) / (1.0 + values[0])


def _ahead(path: PusherPath, values: Values) -> Float64Array:
    """The command that a servo follows with a first-order lag."""
    return path.position + values[0] * np.gradient(path.position, path.time, axis=0)


def _drifted(record: PushRecord, values: Values) -> PushRecord:
    return replace(record, pusher=replace(record.pusher, position=record.pusher.position - record.order * np.array(values)))


def _thinner(record: PushRecord, values: Values) -> PushRecord:
    """A surface that lies inside of what is reported (values < 0): the pusher is reported thicker by as much."""
    return replace(record, pusher=replace(record.pusher, radius=record.pusher.radius - values[0]))


CHANGES: Final[Mapping[str, Callable[[PushRecord, Values], PushRecord]]] = {
    "camera_rotation": _poses("camera_rotation"),
    "camera_translation": _poses("camera_translation"),
    "camera_scale": _poses("camera_scale"),
    "pose_latency": _late,
    "tool_offset": _path(_offset),
    "tool_drift": _drifted,
    "pusher_speed_scale": _path(_scaled),
    "pusher_lag": _path(_ahead),
    "outline_error": _thinner,
}
"""Of each effect of the catalogue that can be put into a recording: the record as a cell with this error would report it."""


def with_causes(records: Sequence[PushRecord], causes: Mapping[str, Values]) -> list[PushRecord]:
    """The pushes as a cell with these errors would have reported them."""
    changed = list(records)
    for name, values in causes.items():
        changed = [CHANGES[name](record, values) for record in changed]
    return changed


def displacement(records: Sequence[PushRecord], changed: Sequence[PushRecord]) -> float:
    """By how much the contact was displaced [m]: root mean square of the change of poses, at equal times, of the path and of the radius."""
    squares = []
    for record, other in zip(records, changed, strict=True):
        time = record.poses.time
        moved = np.column_stack([np.interp(time, other.poses.time, other.poses.pose[:, axis]) for axis in (0, 1)])
        parts = [moved - record.poses.pose[:, :2], other.pusher.position - record.pusher.position]
        of_radius = other.pusher.radius - record.pusher.radius
        squares.append(of_radius**2 + sum(float(np.mean(np.sum(part**2, axis=1))) for part in parts))
    return float(np.sqrt(np.mean(squares)))


def values_of(name: str, size: float, angle: float, records: Sequence[PushRecord]) -> Values:
    """An effect of `CHANGES` that displaces the contact of recorded pushes by `size` [m].

    At most at its largest size: a slow push shows little of a delay. `angle` [rad]: its direction, or sign, -pi to pi.
    """
    parameters = INJECTED[name].acting
    length = parameters[0].typical
    if len(parameters) == 2:
        typical: Values = (length * float(np.cos(angle)), length * float(np.sin(angle)))
    elif name == "outline_error":
        typical = (-length,)
    else:
        typical = (length if parameters[0].lowest >= 0 or angle > 0 else -length,)
    factor = size / max(displacement(records, with_causes(records, {name: typical})), 1e-12)
    return tuple(value * min(factor, parameters[0].highest / length) for value in typical)
