"""Derivatives are those of central differences: of the cost of a fit in all its forms, of the maps, and of the reference engine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, random_records, with_forces, with_frames
from push_ident.identification.fitting.problem import FitProblem, unknowns_of_push
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.solvers.autograd import reference_cost
from push_ident.identification.unknowns.mechanics import log_derivatives_at, mechanics_at, model_at
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec, nuisance_effects
from push_ident.physics.effect_values import effect_values
from push_ident.types import CameraAccuracy, PushRecord

TRUTH = hammer(1)
RECORDS = random_records(TRUTH, 2, 1)


def of_maps() -> FitProblem:
    return FitProblem(RECORDS, UnknownsSpec.of(TRUTH.shape, Prior()))


def cell_by_cell() -> FitProblem:
    return FitProblem(RECORDS[:1], UnknownsSpec.of(TRUTH.shape, Prior(), modes=np.eye(len(TRUTH.mass))))


def with_measured_forces() -> FitProblem:
    records, effects = (
        [with_forces(r, TRUTH) for r in RECORDS],
        ("force_offset", "force_scale", "force_delay", "table_tilt", "pusher_friction"),
    )
    return FitProblem(records, UnknownsSpec.of(TRUTH.shape, Prior().with_force_offset(records), effects=effects))


def seen_by_a_camera() -> FitProblem:
    shape = replace(TRUTH.shape, outline_std=np.full(len(TRUTH.shape.outline), 1.5e-3))
    records = [replace(r, shape=shape, poses=replace(r.poses, camera=CameraAccuracy(4e-3, 1e-2))) for r in RECORDS]
    prior = Prior(max_modes=4).with_camera_accuracy(record.poses.camera for record in records)
    problem = FitProblem(records, UnknownsSpec.of(shape, prior, effects=nuisance_effects(shape, prior), outline=True))
    assert problem.unknowns_of_push == unknowns_of_push(shape) == 5 and problem.unknowns.blocks["outline"].size > 4
    return problem


def with_shared_discrepancy() -> FitProblem:
    noise = NoiseModel(discrepancy_modes=2, discrepancy_factor=(3.0, 5.0, 2.0), frame_factor=1.5)
    problem = FitProblem(RECORDS, UnknownsSpec.of(TRUTH.shape, Prior(max_modes=4), effects=["table_tilt"]), noise=noise)
    assert problem.unknowns_of_push == unknowns_of_push(TRUTH.shape, noise) == 3 + 2 + 3 * 2
    return problem


def with_a_reference() -> FitProblem:
    """The second push, whose forces are measured, too, has the shared effects only; one of them has changed before the first."""
    records = [with_forces(r, TRUTH) for r in RECORDS]
    prior = Prior(max_modes=4).with_force_offset(records)
    unknowns = UnknownsSpec.of(TRUTH.shape, prior, effects=["table_tilt", "camera_rotation", "force_offset"])
    shared = effect_values(("table_tilt", "pusher_friction", "force_delay"))
    return FitProblem(records, replace(unknowns, shared=shared), noise=NoiseModel(discrepancy_modes=1)).beside_reference(1)


@pytest.mark.parametrize("make", [of_maps, cell_by_cell, with_measured_forces, seen_by_a_camera, with_shared_discrepancy, with_a_reference])
def test_gradient_of_a_fit(make) -> None:  # type: ignore[no-untyped-def]
    problem = make()
    x = 0.3 * np.random.default_rng(0).normal(size=problem.size)
    gradient, maps, scales = problem.evaluate(x).gradient, problem.unknowns.maps, problem.unknowns.slices["effects"].start
    for i in [*np.linspace(0, maps.stop - 1, 4).astype(int), *range(scales, problem.size)]:
        step = 1e-5 * np.eye(problem.size)[i]
        assert gradient[i] == pytest.approx((problem.cost(x + step) - problem.cost(x - step)) / 2e-5, rel=1e-3, abs=1e-2), i
    assert problem.cost(x) == pytest.approx(problem.evaluate(x).cost)


@pytest.mark.parametrize("feet", [0, 2, 3, 4], ids=["uneven load", "two feet", "three feet", "four feet"])
def test_derivatives_of_the_maps_and_of_the_body(feet: int) -> None:
    unknowns = UnknownsSpec.of(TRUTH.shape, Prior(max_modes=5, pressure_map_std=1.0, feet=feet))
    z, h = np.random.default_rng(feet).normal(size=unknowns.size), 1e-6
    (d_mass, d_friction), d_limit = log_derivatives_at(unknowns, z), mechanics_at(unknowns, z).limit_derivative
    for k, step in enumerate(h * np.eye(unknowns.size)):
        above, below = model_at(unknowns, z + step), model_at(unknowns, z - step)
        assert d_mass[:, k] == pytest.approx(np.log(above.mass / below.mass) / (2 * h), abs=1e-6)
        assert d_friction[:, k] == pytest.approx(np.log(above.friction / below.friction) / (2 * h), abs=1e-6)
        limit = [mechanics_at(unknowns, z + sign * step).body.limit for sign in (1.0, -1.0)]
        assert d_limit[:, k] == pytest.approx((limit[0] - limit[1]) / (2 * h), abs=1e-8)


def around_first_motion(record: PushRecord, seconds: float = 0.2) -> PushRecord:
    """The part of a push in which the object begins to move: the reference engine is slow."""
    poses = record.poses
    end = poses.time[np.argmax(np.linalg.norm(poses.pose[:, :2] - poses.pose[0, :2], axis=1) > 0.01)]
    return with_frames(record, *(np.abs(time - end + seconds / 2) <= seconds / 2 for time in (poses.time, record.pusher.time)))


def test_autograd_has_the_gradient_of_its_own_cost() -> None:
    problem = FitProblem([around_first_motion(RECORDS[0])], UnknownsSpec.of(TRUTH.shape, Prior(max_modes=4).without_pressure()))
    x = 0.2 * np.random.default_rng(0).normal(size=problem.size)
    unknowns, cost = reference_cost(problem, x)
    cost.backward()  # type: ignore[no-untyped-call]
    assert unknowns.grad is not None
    for i in (0, 5, problem.unknowns.size - 1, problem.size - 1):
        step = 1e-5 * np.eye(problem.size)[i]
        difference = float((reference_cost(problem, x + step)[1] - reference_cost(problem, x - step)[1]).detach()) / 2e-5
        assert abs(difference) > 0.1 and float(unknowns.grad[i]) == pytest.approx(difference, rel=2e-2, abs=1e-2)
