"""The paper's engine: applied forces, batches, statuses. Its motions and derivatives: `test_proof_engines.py`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.objects import square, straight_push, uniform
from push_ident.errors import InputError
from push_ident.physics.lcp import LcpStatus
from push_ident.physics.reference import ReferenceModel, reference_rollout
from push_ident.physics.reference_step import StepProblem, reference_step
from push_ident.physics.simulation import GRAVITY
from push_ident.types import ObjectModel, SolveStatus

torch.set_num_threads(1)
DT = 1 / 240


def tensor(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def uneven_block(n: int = 2, size: float = 0.02, seed: int = 0) -> ObjectModel:
    """A square of cells of unlike mass and friction without any symmetry."""
    rng = np.random.default_rng(seed)
    return ObjectModel(square(n, size), rng.uniform(0.02, 0.05, n * n), rng.uniform(0.2, 0.5, n * n), 0.3)


def free_step(model: ObjectModel, force: Tensor) -> StepProblem:
    """Bodies at rest without a pusher, one for each row of the applied forces."""
    batch = len(force)
    mass, zeros = tensor(model.mass).expand(batch, -1), torch.zeros(batch, 2, 2).double()
    return StepProblem(
        mass=mass,
        inertia=mass * (model.shape.cells.size**2 / 6),
        cells=tensor(model.shape.cells.centres).expand(batch, -1, -1),
        twist=torch.zeros(batch, 3).double(),
        limit=mass * tensor(model.friction) * GRAVITY,
        normal=zeros,
        point=zeros,
        gap=zeros[:, 0],
        active=zeros[:, 0].bool(),
        pusher_velocity=zeros[:, 0],
        pusher_friction=torch.full((batch,), model.pusher_friction).double(),
        force=force,
        dt=DT,
    )


def test_applied_force_moves_the_block_once_it_exceeds_the_friction() -> None:
    """By (F - limit) dt / m, and its derivative by the force is dt / m where the block moves."""
    model = uniform(square(4, 0.02))
    limit = float(np.sum(model.mass * model.friction)) * GRAVITY
    forces = tensor([[0.9 * limit, 0.0, 0.0], [1.3 * limit, 0.0, 0.0], [0.0, -1.5 * limit, 0.0]]).requires_grad_()
    after = reference_step(free_step(model, forces)).twist
    unit = DT / model.total_mass
    assert torch.allclose(after, tensor([[0, 0, 0], [0.3 * limit * unit, 0, 0], [0, -0.5 * limit * unit, 0]]), rtol=0, atol=1e-8)
    (by_force,) = torch.autograd.grad(after[:, :2].sum(), forces)
    assert torch.allclose(by_force[[0, 1, 2], [0, 0, 1]], unit * tensor([0.0, 1.0, 1.0]), rtol=1e-6, atol=1e-6 * unit)
    # Without friction a torque turns it by torque / inertia.
    smooth = replace(free_step(model, tensor([[0.0, 0.0, 0.01]])), limit=torch.zeros(1, 16).double())
    inertia = np.sum(model.mass * (np.sum(model.shape.cells.centres**2, axis=1) + 0.02**2 / 6))
    assert reference_step(smooth).twist[0].tolist() == pytest.approx([0.0, 0.0, 0.01 * DT / inertia], abs=1e-6)


def test_pushes_of_unlike_length_and_model_equal_one_by_one() -> None:
    shape, models = square(2, 0.02), [ReferenceModel.of(uneven_block(seed=seed)) for seed in (1, 2)]
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
    model = uneven_block()
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
    step = free_step(model, tensor([[0.3, 0.2, 0.01]]))
    with pytest.raises(InputError, match=r"StepProblem\.gap has shape"):
        replace(step, gap=torch.zeros(60).double())
    result = reference_step(step, max_iterations=3)
    assert result.status == (LcpStatus.MAX_ITERATIONS,) and torch.all(torch.isnan(result.twist))
