"""First stage: can the data be trusted? A diagnosis abstains where a gate is not passed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from push_ident.checking.records import check_records
from push_ident.diagnosis.policy import GatePolicy
from push_ident.diagnosis.state import DiagnosisState
from push_ident.diagnosis.verdict import Gate
from push_ident.errors import InputError
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.observing.observation import (
    NoiseModel,
    at_rest,
    noise_at_rest,
    noise_correlation,
    noise_correlation_std,
    observe_push,
    pusher_gaps,
)  # fmt: skip
from push_ident.types import BoolArray, PoseTrack, PushRecord


def check_pushes(state: DiagnosisState) -> DiagnosisState:
    """The stage: gates of the data; pushes without contact are left out, and the noise is as correlated as frames at rest show.

    A push with too many missing frames counts by its poses at rest: nothing says where its other frames went.
    """
    settings = state.settings
    policy, noise = settings.policy.gates, settings.noise
    bursts = [in_burst(record, policy) for record in state.records]
    # An offset of the sensor is a cause that a diagnosis looks for.
    checked = check_records([_without(record, burst) for record, burst in zip(state.records, bursts, strict=True)], tare=False)
    records = checked.records
    gates = [*_bursts(bursts), *check_data(records, noise, policy)]
    records = tuple(at_rest(record) if _missing_share(record, policy) >= policy.max_missing_share else record for record in records)
    return replace(
        state,
        records=tuple(record for record in records if _is_pushed(record, noise, policy)),
        settings=replace(settings, noise=noise_at_rest(records, noise)),
        rest_noise_known=bool(np.isfinite(noise_correlation(records, enough_pairs=policy.min_rest_pairs))),
        rest_correlation_std=noise_correlation_std(records),
        data_gates=tuple(gates),
        contradictions=checked.warnings,
    )


def reference_pushes(state: DiagnosisState, records: Sequence[PushRecord]) -> tuple[PushRecord, ...]:
    """Pushes of a reference that touch the object. Raises InputError where a gate is not passed."""
    reference = check_pushes(replace(state, records=tuple(records), data_gates=()))
    failed = next((gate for gate in reference.gates if not gate.passed), None)
    if failed is not None:
        raise InputError(f"The reference cannot be used: {failed.finding}. {failed.remedy}")
    return reference.records


def check_data(records: Sequence[PushRecord], noise: NoiseModel, policy: GatePolicy) -> list[Gate]:
    """Gates: number of pushes, missing frames (passed, since pushes then count by their ends), and poses that jump."""
    touched = [record for record in records if _is_pushed(record, noise, policy)]
    gates = [
        Gate(
            len(touched) >= policy.min_pushes,
            f"{len(touched)} of {len(records)} pushes touch the object",
            f"Record at least {policy.min_pushes} pushes that move the object; 8 to 14 from different sides determine much more.",
        )
    ]
    if not gates[0].passed and (apart := _moved_from_afar(records, noise)):
        gates = [
            Gate(
                False,
                f"in {len(apart)} of {len(records)} pushes the object moves while the pusher is reported at least "
                f"{1e3 * float(np.median(apart)):.0f} mm from it (median)",
                "Poses, path of the pusher and outline disagree by more than any effect explains: check their frames and units, the "
                "calibration of the camera (offset, rotation, scale) and the radius of the pusher.",
            )
        ]
    gates += _missing_frames(records, policy)
    return [*gates, _jumps(records, policy)]


def _is_pushed(record: PushRecord, noise: NoiseModel, policy: GatePolicy) -> bool:
    """Whether the pusher touches the object, or moves it from no farther than errors of poses, tool and outline make it seem."""
    return observe_push(record, noise).touched or any(gap < policy.max_gap for gap in _moved_from_afar([record], noise))


def _moved_from_afar(records: Sequence[PushRecord], noise: NoiseModel) -> list[float]:
    """Least gap between pusher and object [m] of each push in which that does not touch and this moves, by five standard deviations."""
    apart = []
    for record in records:
        deviation = np.sqrt(np.diagonal(np.median(record.poses.covariance, axis=0)))
        moved = np.abs(record.poses.pose[-1] - record.poses.pose[0])[:2] > 5.0 * np.maximum(deviation[:2], noise.floor_position)
        if np.any(moved) and not observe_push(record, noise).touched:
            apart.append(float(np.min(pusher_gaps(record))))
    return apart


def in_burst(record: PushRecord, policy: GatePolicy) -> BoolArray:
    """Of each pose, whether it lies in a burst of wrong ones: between a jump away and the next, which undoes it, no longer than
    `max_burst`; shape (n_frames,). A tracker that loses its object for a moment does that, and no object."""
    pose, time = record.poses.pose, record.poses.time
    wrong = np.zeros(len(pose), dtype=bool)
    deviation = np.sqrt(np.diagonal(record.poses.covariance, axis1=1, axis2=2))
    limit = np.array(policy.jump_size) + policy.jump_deviations * deviation[1:]
    step = np.diff(pose, axis=0)
    step[:, 2] = wrap_angle(step[:, 2])
    jumps = np.flatnonzero(np.any(np.abs(step) > limit, axis=1))
    for first, last in pairwise(jumps):
        both = step[first] + step[last]
        both[2] = wrap_angle(both[2])
        comes_back = np.all(np.abs(both) <= limit[last]) and time[last] - time[first + 1] <= policy.max_burst
        if comes_back and not wrong[first]:
            wrong[first + 1 : last + 1] = True
    return wrong


def _without(record: PushRecord, wrong: BoolArray) -> PushRecord:
    if not np.any(wrong):
        return record
    poses = record.poses
    return replace(record, poses=PoseTrack(poses.time[~wrong], poses.pose[~wrong], poses.covariance[~wrong]))


def _bursts(bursts: Sequence[BoolArray]) -> list[Gate]:
    """What is done about bursts of wrong poses; nothing where there are none."""
    n = sum(int(np.count_nonzero(burst)) for burst in bursts)
    if not n:
        return []
    share = n / sum(map(len, bursts))
    finding = f"{n} poses ({100 * share:.1f} %) jump away together and come back, and are left out"
    return [Gate(True, finding, "Find out why the tracker loses the object for a moment.")]


def _missing_frames(records: Sequence[PushRecord], policy: GatePolicy) -> list[Gate]:
    """What is done about missing frames; nothing where none are."""
    shares = np.array([_missing_share(record, policy) for record in records])
    sparse = int(np.sum(shares >= policy.max_missing_share))
    if not sparse:
        return []
    finding = (
        f"{sparse} of {len(records)} pushes count by their poses at rest only: up to {100 * float(np.max(shares)):.0f} % of their frames "
        "are missing"
    )
    return [Gate(True, finding, "Find out why the camera drops frames: motions would say more than ends.")]


def _missing_share(record: PushRecord, policy: GatePolicy) -> float:
    """Share of the intervals between frames in which one is missing; 0 where a push is too short to know the interval."""
    if len(record.poses.time) < policy.min_frames:
        return 0.0
    intervals = np.diff(record.poses.time)
    return float(np.mean(intervals > policy.missing_frame_interval * np.median(intervals)))


def _jumps(records: Sequence[PushRecord], policy: GatePolicy) -> Gate:
    """Poses that leave those around them and come back: no object does that."""
    share = float(np.mean(np.concatenate([_leaves_its_neighbours(record, policy) for record in records])))
    return Gate(
        share < policy.max_jump_share,
        f"{100 * share:.1f} % of the poses jump away from those before and after them",
        "The tracker sometimes confuses poses of the object (turned by half a turn, most likely): give the object a shape or marks without "
        "that symmetry, or let the tracker refuse such frames.",
    )


def _leaves_its_neighbours(record: PushRecord, policy: GatePolicy) -> BoolArray:
    """Of each pose, whether it is far from at least three of the two before and the two after it, shape (n_frames,)."""
    pose = record.poses.pose
    if len(pose) < 5:
        return np.zeros(len(pose), dtype=bool)
    around = sliding_window_view(np.pad(pose, ((2, 2), (0, 0)), mode="edge"), 5, axis=0) - pose[:, :, None]
    around[:, 2] = wrap_angle(around[:, 2])
    deviation = np.sqrt(np.diagonal(record.poses.covariance, axis1=1, axis2=2))
    limit = np.array(policy.jump_size) + policy.jump_deviations * deviation
    far = np.any(np.abs(around) > limit[:, :, None], axis=1)
    return np.asarray(far.sum(axis=1) >= 3)
