"""The paper's engine: mechanics against closed forms and laws, derivatives against differences, motion against the compiled engine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.objects import straight_push
from push_ident.errors import InputError
from push_ident.geometry.outline import outline_of_cells
from push_ident.physics.lcp import LcpStatus
from push_ident.physics.reference import ReferenceModel, reference_rollout
from push_ident.physics.reference_step import StepProblem, StepResult, reference_step
from push_ident.physics.simulation import GRAVITY
from push_ident.types import CellGrid, ObjectModel, ObjectShape, SolveStatus

torch.set_num_threads(1)
DT = 1 / 240


def tensor(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def block(n: int = 4, size: float = 0.02, seed: int = 0) -> ObjectModel:
    """A square of n x n cells of unlike mass and friction, the same on both sides of each of its middle lines."""
    rng = np.random.default_rng(seed)
    centres = (np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2) - (n - 1) / 2) * size
    quarter = rng.uniform(0.5, 2.0, (2, n, n))
    mass, friction = ((q + q[::-1] + q[:, ::-1] + q[::-1, ::-1]).ravel() / 4 for q in quarter)
    return ObjectModel(ObjectShape(CellGrid(centres, size), outline_of_cells(centres, size)), 0.03 * mass, 0.3 * friction, 0.25)


def uneven_block(n: int = 3, size: float = 0.02, seed: int = 0) -> ObjectModel:
    """A square of cells of unlike mass and friction without any symmetry."""
    rng = np.random.default_rng(seed)
    shape = block(n, size).shape
    return ObjectModel(shape, rng.uniform(0.02, 0.05, n * n), rng.uniform(0.2, 0.5, n * n), 0.3)


def free_step(model: ObjectModel, twist: Tensor) -> StepProblem:
    """Bodies without a pusher, one for each row of `twist`."""
    batch = len(twist)
    mass = tensor(model.mass).expand(batch, -1)
    return StepProblem(
        mass=mass,
        inertia=mass * (model.shape.cells.size**2 / 6),
        cells=tensor(model.shape.cells.centres).expand(batch, -1, -1),
        twist=twist,
        limit=mass * tensor(model.friction) * GRAVITY,
        normal=torch.zeros(batch, 2, 2).double(),
        point=torch.zeros(batch, 2, 2).double(),
        gap=torch.zeros(batch, 2).double(),
        active=torch.zeros(batch, 2, dtype=torch.bool),
        pusher_velocity=torch.zeros(batch, 2).double(),
        pusher_friction=torch.full((batch,), model.pusher_friction).double(),
        force=torch.zeros(batch, 3).double(),
        dt=DT,
    )


def touched(problem: StepProblem, point: tuple[float, float], normal: tuple[float, float], velocity: tuple[float, float]) -> StepProblem:
    """The same bodies with a pusher at `point`."""
    batch = len(problem.mass)
    return replace(
        problem,
        point=torch.cat([tensor(point).expand(batch, 1, 2), problem.point[:, 1:]], dim=1),
        normal=torch.cat([tensor(normal).expand(batch, 1, 2), problem.normal[:, 1:]], dim=1),
        active=tensor([True, False]).bool().expand(batch, 2),
        pusher_velocity=tensor(velocity).expand(batch, 2),
    )


def test_applied_force_moves_the_block_once_it_exceeds_the_friction() -> None:
    model = block()
    limit = float(np.sum(model.mass * model.friction)) * GRAVITY
    forces = tensor([[0.9 * limit, 0.0, 0.0], [1.3 * limit, 0.0, 0.0], [0.0, -1.5 * limit, 0.0]])
    after = reference_step(replace(free_step(model, torch.zeros(3, 3).double()), force=forces)).twist
    unit = limit * DT / model.total_mass
    assert torch.allclose(after, tensor([[0, 0, 0], [0.3 * unit, 0, 0], [0, -0.5 * unit, 0]]), rtol=0, atol=1e-8)
    # Without friction a torque turns it by torque / inertia.
    smooth = replace(free_step(model, torch.zeros(1, 3).double()), limit=torch.zeros(1, 16).double(), force=tensor([[0.0, 0.0, 0.01]]))
    arms = model.shape.cells.centres
    inertia = np.sum(model.mass * (np.sum(arms**2, axis=1) + 0.02**2 / 6))
    assert reference_step(smooth).twist[0].tolist() == pytest.approx([0.0, 0.0, 0.01 * DT / inertia], abs=1e-6)


CONTACTS: dict[str, Callable[[], StepProblem]] = {
    "sliding": lambda: touched(free_step(uneven_block(), tensor([[0.02, 0.01, 0.3]])), (-0.03, 0.004), (-1.0, 0.0), (0.15, 0.2)),
    "sticking": lambda: touched(free_step(uneven_block(), tensor([[0.02, 0.01, 0.3]])), (-0.03, 0.004), (-1.0, 0.0), (0.15, 0.02)),
    "separating": lambda: touched(free_step(uneven_block(), tensor([[0.3, 0.1, 0.9]])), (-0.03, 0.004), (-1.0, 0.0), (0.1, 0.05)),
}


def mode(problem: StepProblem, result: StepResult) -> str:
    if result.normal_impulse[0, 0] < 1e-9:
        return "separating"
    cone = problem.pusher_friction[0] * result.normal_impulse[0, 0]
    return "sliding" if result.tangential_impulse[0].abs() > cone * (1 - 1e-6) else "sticking"


@pytest.mark.parametrize("name", CONTACTS)
def test_derivative_of_a_step_equals_central_differences(name: str) -> None:
    problem = CONTACTS[name]()
    assert mode(problem, reference_step(problem)) == name
    inputs = ("mass", "inertia", "cells", "twist", "limit", "normal", "point", "gap", "pusher_velocity", "pusher_friction", "force")
    leaves = [getattr(problem, field) for field in inputs]

    def outcome(*values: Tensor) -> Tensor:
        result = reference_step(replace(problem, **dict(zip(inputs, values, strict=True))))
        return torch.cat([result.twist, result.normal_impulse[:, :1], result.tangential_impulse[:, None]], dim=1)[0]

    exact = torch.autograd.functional.jacobian(outcome, tuple(leaves))
    for i, field in enumerate(inputs):
        direction = torch.randn(leaves[i].shape, generator=torch.Generator().manual_seed(i), dtype=torch.float64)
        if field in ("mass", "inertia", "limit", "pusher_friction"):
            direction = direction * leaves[i]
        step = 1e-6
        plus, minus = ([x + (sign * direction if j == i else 0.0) for j, x in enumerate(leaves)] for sign in (step, -step))
        differences = (outcome(*plus) - outcome(*minus)) / (2 * step)
        along = (exact[i] * direction).flatten(1).sum(dim=1)
        assert along.tolist() == pytest.approx(differences.tolist(), rel=1e-5, abs=2e-7), field


# Whole pushes


def test_pushes_of_unlike_length_and_model_equal_one_by_one() -> None:
    shape, models = block(2).shape, [ReferenceModel.of(uneven_block(2, seed=seed)) for seed in (1, 2)]
    pushers = [straight_push((-0.030, 0.006), 0.1, travel=0.01, rest=0.02), straight_push((0.005, -0.030), 1.6, travel=0.015, rest=0.02)]
    times = [p.time[[0, 3, -1]] for p in pushers]
    first = tensor([[0.0, 0.0, 0.0], [0.001, 0.0, -0.1]])
    both = ReferenceModel(*(torch.stack([getattr(m, name) for m in models]) for name in ("mass", "friction", "pusher_friction")))
    together = reference_rollout(shape, both, pushers, first, times)
    for i, model in enumerate(models):
        alone = reference_rollout(shape, model, pushers[i : i + 1], first[i : i + 1], times[i : i + 1])
        assert torch.allclose(together.poses[i], alone.poses[0], rtol=0, atol=1e-9)
        assert float((alone.poses[0][-1] - first[i]).norm()) > 5e-3


def test_failures_of_a_push_are_statuses_and_input_that_does_not_fit_is_refused() -> None:
    model = uneven_block(2)
    pusher = straight_push((-0.030, 0.0), 0.0, travel=0.01, rest=0.02)
    away = straight_push((-0.2, 0.0), 0.0, travel=0.01, rest=0.02)
    first = torch.zeros(2, 3).double()
    reference = ReferenceModel.of(model)
    motion = reference_rollout(model.shape, reference, [pusher, away], first, [pusher.time] * 2, max_iterations=3)
    assert motion.status == (SolveStatus.SIMULATION_FAILED, SolveStatus.NO_CONTACT)
    assert torch.all(torch.isnan(motion.poses[0])) and torch.all(motion.poses[1] == 0)
    for changed, text in (
        ({"friction": reference.friction[:3]}, "`friction` has shape"),
        ({"mass": reference.mass.float()}, r"`mass` is of torch\.float32"),
        ({"mass": -reference.mass}, "negative or not finite"),
    ):
        with pytest.raises(InputError, match=text):
            reference_rollout(model.shape, replace(reference, **changed), [pusher], first[:1], [pusher.time])
    for poses, time, text in (
        (first[:1], pusher.time[::-1], "must be finite and ascend"),
        (first, pusher.time, r"\(2, 3\), expected \(1, 3\)"),
    ):
        with pytest.raises(InputError, match=text):
            reference_rollout(model.shape, reference, [pusher], poses, [time])
    step = CONTACTS["sliding"]()
    with pytest.raises(InputError, match=r"StepProblem\.gap has shape"):
        replace(step, gap=torch.zeros(60).double())
    result = reference_step(step, max_iterations=3)
    assert result.status == (LcpStatus.MAX_ITERATIONS,) and torch.all(torch.isnan(result.twist))
