"""Contacts that a fit starts with, rests that end where poses show motion, and what the modes leave of the discrepancy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.fits import fit_base
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.fitting.contacts import freed, in_contact
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.observing.observation import NoiseModel, at_rest, observe_push, rest_frames
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import PushRecord

NOISE = NoiseModel(discrepancy_modes=6, max_moving_frames=30, single_frame_inflation=1.0)


def moved_tool(records: list[PushRecord], by: tuple[float, float]) -> list[PushRecord]:
    """The pushes as a cell whose tool is displaced would report them."""
    return [replace(r, pusher=replace(r.pusher, position=r.pusher.position - by)) for r in records]


def problem_of(records: list[PushRecord]) -> FitProblem:
    return FitProblem(records, UnknownsSpec.of(records[0].shape, Prior()), noise=NOISE)


def test_a_tool_that_is_reported_elsewhere_starts_in_contact() -> None:
    precise = np.array([5e-5, 5e-5, 5e-4])
    records = moved_tool(simulated_pushes(4, 3, noise=precise), (0.006, 0.0))
    problem = problem_of(records)
    x = np.zeros(problem.size)
    started, at = in_contact(problem, x)
    assert started is not problem and started.noise is not None and started.noise.discrepancy_factor[0] > 5.0
    # The first frame stays where it was seen: what the surface is displaced by, the first pose is not.
    for push in range(4):
        assert started.first_pose(at, push) + started.displacement(at, push)[0] == pytest.approx(started.observations[push].pose[0])
    assert started.cost(at) < problem.cost(x)
    exact = problem_of(simulated_pushes(4, 3, noise=precise))
    assert in_contact(exact, x)[0] is exact


def test_pushes_that_show_no_motion_start_as_reported() -> None:
    """Of poses at rest alone nobody knows when the object began to move: the pusher may have left long before the last of them."""
    records = moved_tool([at_rest(r) for r in simulated_pushes(4, 3, noise=np.array([5e-5, 5e-5, 5e-4]))], (0.006, 0.0))
    problem = problem_of(records)
    assert all(len(observed.time) == 2 for observed in problem.observations)
    assert in_contact(problem, np.zeros(problem.size))[0] is problem


def test_a_push_is_freed_from_a_contact_that_explains_it_badly() -> None:
    fit = fit_base(simulated_pushes(4, 3), DiagnosisSettings())
    assert freed(fit.problem, fit.x) is fit.x
    stuck, own = fit.x.copy(), fit.problem.slice_of_push(2)
    stuck[own][:3] += 40.0
    assert fit.problem.cost(stuck) > fit.end.cost + 20.0
    assert fit.problem.cost(freed(fit.problem, stuck)) < fit.end.cost + 1.0


def test_the_first_pose_is_that_before_the_pusher_moves_whenever_its_rest_was_seen() -> None:
    """At the mean time of that rest, a simulation that begins in contact has moved the object: its first pose would be free."""
    (record,) = simulated_pushes(1, 3)
    assert np.mean(record.poses.time[rest_frames(record)[0]]) > record.pusher.time[0]
    assert observe_push(record).time[0] == record.pusher.time[0]


def test_an_object_that_moves_before_the_reported_contact_is_not_at_rest() -> None:
    (record,) = simulated_pushes(1, 3, noise=np.array([5e-5, 5e-5, 5e-4]))
    late = replace(record, pusher=replace(record.pusher, radius=record.pusher.radius - 0.008))
    (before, _, touched), (as_it_was, _, _) = rest_frames(late), rest_frames(record)
    assert not touched and abs(len(before) - len(as_it_was)) <= 3
    assert np.ptp(late.poses.pose[before], axis=0)[:2] == pytest.approx(0.0, abs=5e-4)


def test_what_the_modes_leave_of_the_discrepancy_counts_as_errors_of_frames() -> None:
    (record,) = simulated_pushes(1, 3)
    factor = (20.0, 30.0)
    alone, observed = observe_push(record, NOISE), observe_push(record, replace(NOISE, rest_factor=factor))
    added = [np.linalg.inv(o.whitening[1:].transpose(0, 2, 1) @ o.whitening[1:]) for o in (observed, alone)]
    rest = (added[0] - added[1])[:, [0, 2], [0, 2]]
    travel = alone.discrepancy[1:, 0] / NOISE.model_discrepancy_position
    whole, rate = travel.max(), (np.arange(6) + 0.5) * np.pi
    # The variance of a Wiener process less that of its first modes.
    variance = whole * travel - np.sum(2.0 * (whole / rate * np.sin(np.outer(travel / whole, rate))) ** 2, axis=1)
    expected = np.outer(
        np.maximum(variance, 0.0), (np.array(factor) * [NOISE.model_discrepancy_position, NOISE.model_discrepancy_yaw]) ** 2
    )
    np.testing.assert_allclose(rest, expected, atol=1e-12)
    np.testing.assert_array_equal(observed.shared, alone.shared)
