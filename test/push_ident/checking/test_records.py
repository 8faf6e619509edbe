"""Contacts, clocks and forces of pushes that contradict each other are named, and results of such pushes say so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import push_ident as pi
from helpers.objects import hammer, random_records, with_forces, with_frames
from push_ident.checking.records import check_records
from push_ident.identification.online.session import ObjectSession, SessionOptions
from push_ident.types import Float64Array, PoseTrack, PushRecord, WrenchTrack

MODEL = hammer(3)
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


@pytest.fixture(scope="module")
def pushes() -> list[PushRecord]:
    return random_records(MODEL, 6, 3, noise=0.5)


@pytest.fixture(scope="module")
def measured(pushes: list[PushRecord]) -> list[PushRecord]:
    return [with_forces(record, MODEL) for record in pushes]


def late(record: PushRecord, delay: float) -> PushRecord:
    """The same push seen by a camera whose clock is behind [s]."""
    poses = record.poses
    return replace(record, poses=PoseTrack(poses.time + delay, poses.pose, poses.covariance))


def with_force(records: list[PushRecord], change: Callable[[Float64Array], Float64Array], delay: float = 0.0) -> list[PushRecord]:
    tracks = [record.wrench for record in records]
    changed = [track and WrenchTrack(track.time + delay, change(track.force)) for track in tracks]
    return [replace(record, wrench=track) for record, track in zip(records, changed, strict=True)]


def test_right_pushes_pass_with_their_forces(pushes: list[PushRecord], measured: list[PushRecord]) -> None:
    for records in (pushes, measured, [with_frames(record, [0, -1]) for record in pushes]):
        checked = check_records(records)
        assert checked.records == tuple(records) and checked.warnings == checked.notes == ()
    assert checked.overlap is not None and not len(checked.overlap.distance)


def test_a_late_clock_is_named_with_its_size_by_everything_that_takes_the_pushes(pushes: list[PushRecord]) -> None:
    wrong = [late(record, 0.1) for record in pushes]
    checked = check_records([with_forces(record, MODEL) for record in wrong])
    (warning,) = checked.warnings
    assert "the clock of the pusher is 0.1" in warning and "--" not in warning
    assert all(record.wrench is None for record in checked.records), "nothing shows whether they are right"
    result = pi.identify(wrong, max_seconds=5.0)
    assert result.warnings == (warning,)
    assert pi.diagnose(wrong[:3]).warnings


def test_a_live_session_says_what_is_wrong_with_its_pushes(pushes: list[PushRecord]) -> None:
    session, right = (ObjectSession("1", MODEL.shape, SessionOptions()) for _ in range(2))
    for record in pushes[:2]:
        session.finish(late(record, 0.1))
        right.finish(record)
    assert session.n_pushes == right.n_pushes == 2
    assert "clock" in session.warnings[0] and right.warnings == ()


def test_end_poses_of_an_object_that_the_pusher_never_reaches_are_named(pushes: list[PushRecord]) -> None:
    apart = [replace(r, pusher=replace(r.pusher, position=r.pusher.position + np.array([0.0, 0.3]))) for r in pushes]
    (warning,) = check_records([with_frames(record, [0, -1]) for record in apart]).warnings
    assert warning.startswith("the object moves while the pusher is still")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda force: force @ QUARTER.T, "x,y of the table are its y,-x"),
        (lambda force: -force, "the other sign"),
        (lambda force: force * [1.0, -1.0], "are its x,-y"),
        (lambda force: 0.0 * force, "no force is measured"),
    ],
    ids=["turned", "sign", "mirrored", "none"],
)
def test_forces_that_no_pusher_exerts_are_left_out_and_named(
    measured: list[PushRecord], change: Callable[[Float64Array], Float64Array], reason: str
) -> None:
    checked = check_records(with_force(measured, change))
    (warning,) = checked.warnings
    assert reason in warning and all(record.wrench is None for record in checked.records)


def test_a_force_on_a_late_clock_is_left_out(measured: list[PushRecord]) -> None:
    (warning,) = check_records(with_force(measured, lambda force: force, delay=0.5)).warnings
    assert "after the object has moved" in warning


def test_an_offset_of_the_sensor_is_taken_off_also_where_it_drifts(measured: list[PushRecord]) -> None:
    offsets = np.linspace(2.0, 5.0, len(measured))
    drifting = [with_force([r], partial(np.add, [o, 0.0]))[0] for r, o in zip(measured, offsets, strict=True)]
    checked = check_records(drifting)
    assert "up to 5.0 N are measured without contact" in checked.notes[0] and not checked.warnings
    for record, true in zip(checked.records, measured, strict=True):
        assert record.wrench is not None and true.wrench is not None
        assert np.abs(record.wrench.force - true.wrench.force).max() < 0.1


def test_a_mass_is_not_identified_from_forces_in_another_frame(measured: list[PushRecord]) -> None:
    result = pi.identify(with_force(measured, lambda force: force @ QUARTER.T))
    right = pi.identify(measured)
    assert not result.posterior.total_mass_identifiable and len(result.warnings) == 1
    assert right.posterior.total_mass_identifiable and not right.warnings
    assert abs(right.model.total_mass / MODEL.total_mass - 1.0) < 0.15
