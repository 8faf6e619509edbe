"""Gradient descent through the reference engine by automatic differentiation, the fourth baseline of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from push_ident.identification.parameters import MapParameters
from push_ident.identification.problem import TAILS, FitProblem
from push_ident.identification.solvers.descent import descend
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, SolveStatus

if TYPE_CHECKING:
    import torch

    from push_ident.physics.reference import ReferenceModel

__all__ = ["autograd", "reference_cost"]

_STEP = 0.01
"""Time step of the reference engine [s], as large as its authors' kind of engine is run."""


def autograd(problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
    """Gradient descent; cost and gradient come from the reference engine alone, with the paper's friction pyramid."""
    graph: dict[str, torch.Tensor] = {}

    def cost(x: Float64Array) -> float:
        graph["x"], graph["cost"] = reference_cost(problem, x)
        return float(graph["cost"].detach())

    def gradient(x: Float64Array, cost_at_x: float) -> Float64Array | None:
        # The last point whose cost was asked for is the one that was accepted.
        graph["cost"].backward()  # type: ignore[no-untyped-call]
        slope = graph["x"].grad
        return None if slope is None else slope.numpy()

    return descend(problem, x0, cost, gradient)


def reference_cost(problem: FitProblem, x: Float64Array) -> tuple[torch.Tensor, torch.Tensor]:
    """Unknowns that record what is done with them, and the cost of the problem at them."""
    import torch

    from push_ident.physics.reference import reference_rollout

    unknowns = torch.tensor(x, dtype=torch.float64, requires_grad=True)
    n_z = problem.parameters.size
    z = unknowns[:n_z]
    firsts = [
        torch.as_tensor(seen.pose[0]) + torch.as_tensor(scale) @ unknowns[n_z + 3 * push : n_z + 3 * push + 3]
        for push, (seen, scale) in enumerate(zip(problem.observations, problem.first_scale, strict=True))
    ]
    motion = reference_rollout(
        problem.parameters.shape,
        _model(problem.parameters, z),
        [record.pusher for record in problem.records],
        torch.stack(firsts),
        [seen.time for seen in problem.observations],
        settings=SimulationSettings(step=_STEP),
    )
    problem.meter.count(len(problem.records))
    cost = 0.5 * z @ z
    for poses, seen in zip(motion.poses, problem.observations, strict=True):
        residual = torch.einsum("fij,fj->fi", torch.as_tensor(seen.whitening), poses - torch.as_tensor(seen.pose))
        cost = cost + 0.5 * (TAILS + 3) * torch.log1p((residual**2).sum(dim=1) / TAILS).sum()
    return unknowns, torch.nan_to_num(cost, nan=torch.inf)


def _model(parameters: MapParameters, z: torch.Tensor) -> ReferenceModel:
    """`MapParameters.model` in torch."""
    import torch

    from push_ident.physics.reference import ReferenceModel

    n, prior, modes = parameters.n_modes, parameters.prior, torch.as_tensor(parameters.modes)
    weight = torch.softmax(prior.mass_map_std * (modes @ z[:n]), dim=0)
    roughness = torch.exp(prior.friction_map_std * (modes @ z[n : 2 * n]))
    return ReferenceModel(
        mass=prior.total_mass * weight,
        friction=prior.friction * torch.exp(prior.friction_std * z[-2]) * roughness / (weight @ roughness),
        pusher_friction=prior.pusher_friction * torch.exp(prior.pusher_friction_std * z[-1]),
    )
