"""Gradient descent through the reference engine by automatic differentiation, the fourth baseline of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from push_ident.extras import need
from push_ident.identification.fitting.problem import TAILS, FitProblem
from push_ident.identification.fitting.solver import CellByCellSolver, descend
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, SolveStatus

if TYPE_CHECKING:
    import torch

    from push_ident.physics.reference import ReferenceModel


class Autograd(CellByCellSolver):
    """Gradient descent; cost and gradient come from the reference engine, with the paper's friction pyramid."""

    name: ClassVar[str] = "autograd"

    def solve(self, problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
        """As `CellByCellSolver.solve`; nothing is random."""
        need("torch")
        graph: dict[str, torch.Tensor] = {}

        def cost(x: Float64Array) -> float:
            graph["x"], graph["cost"] = reference_cost(problem, x)
            return float(graph["cost"].detach())

        def gradient(x: Float64Array, cost_at_x: float) -> Float64Array | None:
            # The last evaluated point is the one that was accepted.
            graph["cost"].backward()  # type: ignore[no-untyped-call]
            slope = graph["x"].grad
            return None if slope is None else slope.numpy()

        return descend(problem, x0, cost, gradient)


SOLVER = Autograd()


def reference_cost(problem: FitProblem, x: Float64Array) -> tuple[torch.Tensor, torch.Tensor]:
    """Unknowns that record operations on them, and the cost of the problem at them."""
    import torch

    from push_ident.physics.reference import reference_rollout

    unknowns = torch.tensor(x, dtype=torch.float64, requires_grad=True)
    z = unknowns[: problem.unknowns.size]
    firsts = [
        torch.as_tensor(observed.pose[0]) + torch.as_tensor(scale) @ unknowns[problem.slice_of_first_pose(push)]
        for push, (observed, scale) in enumerate(zip(problem.observations, problem.first_scale, strict=True))
    ]
    motion = reference_rollout(
        problem.unknowns.shape,
        _model(problem.unknowns, z),
        [record.pusher for record in problem.records],
        torch.stack(firsts),
        [observed.time for observed in problem.observations],
        settings=SimulationSettings(step=0.01),  # a usual one for differentiable engines of its kind [s]
    )
    problem.meter.count(len(problem.records))
    cost = 0.5 * z @ z
    for push, (poses, observed) in enumerate(zip(motion.poses, problem.observations, strict=True)):
        of_push = unknowns[problem.slice_of_push(push)][3:]
        displaced = poses + torch.as_tensor(observed.shared) @ of_push
        cost = cost + 0.5 * of_push @ of_push
        residual = torch.einsum("fij,fj->fi", torch.as_tensor(observed.whitening), displaced - torch.as_tensor(observed.pose))
        cost = cost + 0.5 * (TAILS + 3) * torch.log1p((residual**2).sum(dim=1) / TAILS).sum()
    return unknowns, torch.nan_to_num(cost, nan=torch.inf)


def _model(unknowns: UnknownsSpec, z: torch.Tensor) -> ReferenceModel:
    """`model_at` in torch."""
    import torch

    from push_ident.physics.reference import ReferenceModel

    prior, modes = unknowns.prior, torch.as_tensor(unknowns.modes)
    (friction_scale,) = z[unknowns.slices["friction_scale"]]
    (pusher_friction,) = z[unknowns.slices["pusher_friction"]]
    weight = torch.softmax(prior.mass_map_std * (modes @ z[unknowns.slices["mass_map"]]), dim=0)
    roughness = torch.exp(prior.friction_map_std * (modes @ z[unknowns.slices["friction_map"]]))
    return ReferenceModel(
        mass=prior.total_mass * weight,
        friction=prior.friction * torch.exp(prior.friction_std * friction_scale) * roughness / (weight @ roughness),
        pusher_friction=prior.pusher_friction * torch.exp(prior.pusher_friction_std * pusher_friction),
    )
