"""Are measured forces those of the pusher on the object, in the frame of the table, and zero without contact?

A pusher only presses, and friction inclines its force by no more than its angle: while it drives the object, the force lies in a cone about
the inward normal of the outline. A force in another frame, or of the other sign, does not, whatever the object. Without contact there is
none: what is measured then is an offset of the sensor, which is taken off push by push, so that slow drift goes with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np

from push_ident.checking.contact import contact_tolerance_of
from push_ident.geometry.outline import outline_distance
from push_ident.types import BoolArray, Float64Array, PushRecord, WrenchTrack

_WIDEST: Final = np.pi / 4
"""Half angle of the widest friction cone [rad]: that of a coefficient of 1, above that of dry rubber, wood or metal in use."""
_AXES: Final = {
    ",".join(f"{'-' if row[at] < 0 else ''}{'xy'[at]}" for row, at in zip(axes, order, strict=True)): axes
    for order in ((0, 1), (1, 0))
    for signs in product((1.0, -1.0), repeat=2)
    for axes in (np.diag(signs)[:, list(order)],)
}
"""Axes of a force that are x and y of the table, by their names."""
_TARE: Final = 0.1
"""Offset that a tare leaves [N]; identification has it as an unknown."""
_DEVIATIONS: Final = 5.0
"""Standard deviations of the noise of a sample that count as a force: 1 in 2 million samples without one."""
_FEWEST: Final = 5
"""Samples in contact, or without, from which something is concluded."""


@dataclass(frozen=True, slots=True)
class ForceCheck:
    """What the forces of some pushes are worth."""

    records: tuple[PushRecord, ...]
    """The pushes, with what was measured without contact taken off; without forces where these are wrong."""
    notes: tuple[str, ...] = ()
    """What was corrected."""
    warnings: tuple[str, ...] = ()
    """Why the forces were left out."""


@dataclass(frozen=True, slots=True)
class _Samples:
    """Forces of one push, and where the pusher was."""

    record: PushRecord
    time: Float64Array
    """[s], shape (n,)."""
    force: Float64Array
    """[N], shape (n, 2)."""
    noise: float
    """Standard deviation of a sample [N]."""
    driving: BoolArray
    """Whether the pusher is at the outline and advances into it, shape (n,)."""
    free: BoolArray
    """Whether it is certainly away from it, shape (n,)."""
    before: BoolArray
    """Whether it is so before any contact, shape (n,)."""
    inward: Float64Array
    """Unit normal of the outline into the object where it is nearest to the pusher, shape (n, 2)."""
    moved: float
    """When the object has certainly moved [s]; NaN where it does not."""


def check_forces(records: Sequence[PushRecord], *, tare: bool = True) -> ForceCheck:
    """Compare measured forces with the contacts of pushes whose poses and paths agree with each other (`check_records`).

    Without a push in which forces were measured, or where the pusher is no cylinder, the pushes are returned as they are; without `tare`
    offsets are, too.
    """
    measured = [record for record in records if record.wrench is not None and record.pusher.shape.is_cylinder]
    if not measured:
        return ForceCheck(tuple(records))
    samples = [_samples(record) for record in measured]
    offsets = _offsets(samples)
    tared = [replace(s, force=s.force - offset) for s, offset in zip(samples, offsets, strict=True)]
    if problem := _problem(tared):
        return ForceCheck(tuple(replace(record, wrench=None) for record in records), warnings=(f"{problem}; forces are left out.",))
    if not (tare and np.any(offsets)):
        return ForceCheck(tuple(records))
    most = float(np.max(np.linalg.norm(offsets, axis=1)))
    force = {id(s.record): s.force for s in tared}
    note = f"up to {most:.1f} N are measured without contact, and taken off."
    return ForceCheck(tuple(_with_force(r, force[id(r)]) if id(r) in force else r for r in records), notes=(note,))


def _with_force(record: PushRecord, force: Float64Array) -> PushRecord:
    return replace(record, wrench=record.wrench and WrenchTrack(record.wrench.time, force))


def _offsets(samples: Sequence[_Samples]) -> Float64Array:
    """What is measured before contact in each push, or in the nearest that shows it [N], shape (n_pushes, 2); zeros where none is more than
    a tare leaves."""
    offsets, shown = np.zeros((len(samples), 2)), []
    for number, push in enumerate(samples):
        if np.count_nonzero(push.before) >= _FEWEST:
            offsets[number] = np.mean(push.force[push.before], axis=0)
            shown.append(number)
    if not np.any(np.linalg.norm(offsets, axis=1) > _TARE + _DEVIATIONS * max(push.noise for push in samples) / np.sqrt(_FEWEST)):
        return np.zeros_like(offsets)
    return np.array([offsets[min(shown, key=lambda other: abs(other - number))] for number in range(len(samples))])


def _samples(record: PushRecord) -> _Samples:
    wrench, pusher, poses = record.wrench, record.pusher, record.poses
    assert wrench is not None
    time, step = wrench.time, 1e-4  # [m] of the numerical derivative of the distance
    pose = np.column_stack([np.interp(time, poses.time, poses.pose[:, axis]) for axis in range(3)])
    place = np.column_stack([np.interp(time, pusher.time, pusher.position[:, axis]) for axis in (0, 1)])
    velocity = np.gradient(pusher.position, pusher.time, axis=0)
    velocity = np.column_stack([np.interp(time, pusher.time, velocity[:, axis]) for axis in (0, 1)])
    outline, tolerance = record.shape.outline, contact_tolerance_of([record])
    distance = outline_distance(place, pose, outline) - pusher.radius
    slope = [outline_distance(place + s, pose, outline) - outline_distance(place - s, pose, outline) for s in step * np.eye(2)]
    outward = np.column_stack(slope)
    inward = -outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    within = (time >= max(poses.time[0], pusher.time[0])) & (time <= min(poses.time[-1], pusher.time[-1]))
    speed = np.linalg.norm(velocity, axis=1)
    # It advances where most of its motion is into the object, at a good part of its speed: at the ends of a push it hardly moves.
    advances = (np.sum(velocity * inward, axis=1) > np.cos(_WIDEST) * speed) & (speed > 0.25 * np.max(speed))
    free = within & (distance > 2.0 * tolerance)
    contact = within & (distance < tolerance)
    first = int(np.argmax(contact)) if np.any(contact) else 0
    noise = float(np.median(np.abs(np.diff(wrench.force, axis=0))) / (0.6745 * np.sqrt(2.0))) if len(time) > 1 else 0.0
    away = np.linalg.norm(poses.pose[:, :2] - poses.pose[0, :2], axis=1) > tolerance
    moved = float(poses.time[np.argmax(away)]) if np.any(away) else np.nan
    return _Samples(record, time, wrench.force, noise, contact & advances, free, free & (np.arange(len(time)) < first), inward, moved)


def _problem(samples: Sequence[_Samples]) -> str:
    """Why these cannot be forces of the pusher on the object; empty where they can."""
    n_driven = sum(np.count_nonzero(s.driving) >= _FEWEST for s in samples)
    if not n_driven:
        return ""
    acting = np.concatenate([size[size > _least(s)] for s in samples for size in (np.linalg.norm(s.force, axis=1),)])
    typical = float(np.median(acting)) if len(acting) else 0.0
    if len(acting) and len(late := _lateness(samples, typical)) and (delay := float(np.median(late))) > 0:
        return f"the force begins {delay:.2f} s after the object has moved (median): the clock of the sensor is wrong"
    inward, force = (np.concatenate(parts) for parts in zip(*(_driving_forces(s) for s in samples), strict=True))
    if len(force) < _FEWEST:
        return f"no force is measured while the pusher drives the object, in {n_driven} pushes: check the topic, the sensor and its clock"
    if problem := _other_frame(inward, force):
        return problem
    free = np.concatenate([np.linalg.norm(s.force[s.free], axis=1) for s in samples])
    if len(free) >= _FEWEST and np.mean(free > 0.5 * typical) > 0.5:
        return (
            f"{np.median(free):.1f} N are measured without contact, and {typical:.1f} N in it: check the clock of the sensor, and tare it"
        )
    return ""


def _least(samples: _Samples) -> float:
    """Size above which a sample is a force [N]."""
    return max(_DEVIATIONS * samples.noise, _TARE)


def _driving_forces(samples: _Samples) -> tuple[Float64Array, Float64Array]:
    """Inward normals and forces [N] where the pusher drives the object and a force is measured, both of shape (n, 2)."""
    at = samples.driving & (np.linalg.norm(samples.force, axis=1) > _least(samples))
    return samples.inward[at], samples.force[at]


def _angles(inward: Float64Array, force: Float64Array) -> Float64Array:
    """Of the forces from the inward normals [rad], shape (n,)."""
    (nx, ny), (fx, fy) = inward.T, force.T
    return np.asarray(np.arctan2(nx * fy - ny * fx, nx * fx + ny * fy))


def _pressing(inward: Float64Array, force: Float64Array) -> float:
    """Share of the forces that lie in the widest friction cone."""
    return float(np.mean(np.abs(_angles(inward, force)) <= _WIDEST))


def _other_frame(inward: Float64Array, force: Float64Array) -> str:
    """Why these are no forces on the object in the frame of the table; empty where they may be.

    Other axes are believed where they put at least half of the forces outside the cone into it.
    """
    share = _pressing(inward, force)
    names, shares = zip(*((name, _pressing(inward, force @ axes.T)) for name, axes in _AXES.items()), strict=True)
    if max(shares) - share >= 0.5 * (1.0 - share) and share < 1.0:
        if (axes := names[int(np.argmax(shares))]) == "-x,-y":
            return "the force points out of the object, which no pusher can do: it is that on the sensor, with the other sign"
        return f"the force presses into the object only if x,y of the table are its {axes}: it is in another frame than the table"
    if share >= 0.5:
        return ""
    # Friction acts along both senses of the outline: in the mean only an offset does so along one direction of the table.
    along = np.column_stack([-inward[:, 1], inward[:, 0]])
    offset = np.linalg.lstsq(along, np.sum(along * force, axis=1), rcond=None)[0]
    if _pressing(inward, force - offset) >= 0.5:
        return f"the force has an offset of about {np.linalg.norm(offset):.1f} N: tare the sensor before a push"
    return (
        "the force points into the object in some pushes and not in others: it is in a frame that turns with the tool; give it in that "
        "of the table"
    )


def _lateness(samples: Sequence[_Samples], typical: float) -> Float64Array:
    """By how much the force begins later than the object moves [s], of the pushes that show both; at most 0 for a right clock."""
    late = []
    for push in samples:
        acts = np.linalg.norm(push.force, axis=1) > max(0.5 * typical, _DEVIATIONS * push.noise)
        if np.isfinite(push.moved) and np.any(acts):
            late.append(push.time[np.argmax(acts)] - push.moved)
    return np.array(late)
