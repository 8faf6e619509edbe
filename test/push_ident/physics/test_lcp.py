"""The complementarity solver: its conditions, its derivative against differences, its status when it fails."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from push_ident.errors import InputError
from push_ident.physics.lcp import Lcp, LcpSolution, LcpStatus, solve_lcp

torch.set_num_threads(1)


def random_lcp(
    seed: int, *, batch: int = 3, n_blocks: int = 4, size: int = 3, n_alpha: int = 8, n_beta: int = 3, monotone: bool = True
) -> Lcp:
    """Unsymmetric, as friction is: -F is skew plus a part that is positive semidefinite or else copositive. Masses differ widely."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=generator, dtype=torch.float64)

    skew, root = normal(n_blocks, size, size), normal(n_blocks, size, size)
    return Lcp(
        M=10 ** (0.7 * normal(n_alpha)),
        q=normal(n_alpha),
        G=normal(n_blocks * size, n_alpha),
        F=skew - skew.mT - (root @ root.mT if monotone else root.abs()),
        m=normal(n_blocks * size),
        A=normal(n_beta, n_alpha),
    )


def full(F: Tensor) -> Tensor:
    return torch.stack([torch.block_diag(*blocks) for blocks in F])


def select(problem: Lcp, index: slice) -> Lcp:
    return replace(problem, **{field.name: getattr(problem, field.name)[index] for field in fields(problem)})


def assert_solves(problem: Lcp, solution: LcpSolution) -> None:
    alpha, gamma, beta, s = (x[..., None] for x in (solution.alpha, solution.gamma, solution.beta, solution.s))
    motion = problem.M[..., None] * alpha + problem.G.mT @ gamma + problem.A.mT @ beta + problem.q[..., None]
    forces = problem.G.mT.abs() @ gamma + problem.A.mT.abs() @ beta.abs()
    assert torch.all(motion.abs() <= 1e-9 * forces.amax(dim=(1, 2), keepdim=True).clamp(min=1.0))
    slack = s + problem.G @ alpha + full(problem.F) @ gamma - problem.m[..., None]
    terms = (problem.G.abs() @ (problem.q / problem.M).abs()[..., None]).amax(dim=(1, 2), keepdim=True)  # the motion that contact stops
    assert torch.all(slack.abs() <= 1e-10 * terms.clamp(min=1.0))
    assert torch.all((problem.A @ alpha).abs() <= 1e-10 * alpha.abs().amax(dim=(1, 2), keepdim=True).clamp(min=1.0))
    assert torch.all(s >= 0) and torch.all(gamma >= 0)
    assert torch.all(s * gamma <= 1e-10 * terms.clamp(min=1.0) * gamma.amax(dim=(1, 2), keepdim=True).clamp(min=1.0))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    n_blocks=st.integers(1, 6),
    size=st.integers(1, 6),
    n_alpha=st.integers(1, 12),
    n_beta=st.integers(0, 5),
    monotone=st.booleans(),
)
# One row has a diagonal of 4e-8: scaled to one, it makes all other rows small, and their products with them.
@example(seed=6, n_blocks=6, size=1, n_alpha=1, n_beta=1, monotone=True)
def test_random_problems_meet_the_conditions(seed: int, n_blocks: int, size: int, n_alpha: int, n_beta: int, monotone: bool) -> None:
    problem = random_lcp(seed, n_blocks=n_blocks, size=size, n_alpha=n_alpha, n_beta=min(n_beta, n_alpha), monotone=monotone)
    solution = solve_lcp(problem)
    for i, status in enumerate(solution.status):
        one = replace(solution, **{name: getattr(solution, name)[i : i + 1] for name in ("alpha", "gamma", "beta", "s")})
        if status is LcpStatus.CONVERGED:
            assert_solves(select(problem, slice(i, i + 1)), one)
        else:  # not every solution of a problem that is merely copositive is found
            assert not monotone
            assert torch.all(torch.isnan(one.gamma))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["M", "q", "G", "F", "m", "A"])
def test_derivative_equals_central_differences(name: str, seed: int) -> None:
    problem = random_lcp(seed, batch=4, monotone=seed % 2 == 0)
    generator = torch.Generator().manual_seed(seed)
    value = getattr(problem, name)
    direction = torch.randn(value.shape, generator=generator, dtype=torch.float64) * value.abs()
    weights = [torch.randn(4, n, generator=generator, dtype=torch.float64) for n in (8, 12)]

    def loss(x: Tensor) -> Tensor:
        solution = solve_lcp(replace(problem, **{name: x}))
        assert solution.converged
        return (solution.alpha * weights[0]).sum(dim=1) + (solution.gamma * weights[1]).sum(dim=1)

    leaf = value.clone().requires_grad_()
    exact = (torch.autograd.grad(loss(leaf).sum(), leaf)[0] * direction).flatten(1).sum(dim=1)
    step = 1e-6
    differences = (loss(value + step * direction) - loss(value - step * direction)) / (2 * step)
    assert torch.allclose(exact, differences, rtol=1e-6, atol=1e-6 * float(differences.abs().max()))


def test_failures_are_reported_and_do_not_change_the_rest_of_the_batch() -> None:
    problem = random_lcp(3, batch=4)
    m, A, G, F = problem.m.clone(), problem.A.clone(), problem.G.clone(), problem.F.clone()
    m[0, 0] = torch.nan
    A[1, 2] = A[1, 0] - 0.5 * A[1, 1]
    G[2, :3], F[2, 0], m[2, :3] = 0.0, 0.0, -1.0  # s = -1 has no solution
    q = problem.q.clone().requires_grad_()
    solution = solve_lcp(replace(problem, q=q, m=m, A=A, G=G, F=F))
    assert solution.status == (LcpStatus.NOT_FINITE, LcpStatus.DEPENDENT_ROWS, LcpStatus.MAX_ITERATIONS, LcpStatus.CONVERGED)
    assert not solution.converged
    assert torch.all(torch.isnan(solution.alpha[:3])) and torch.all(torch.isnan(solution.gamma[:3]))
    good = select(problem, slice(3, 4))
    alone_q = good.q.clone().requires_grad_()
    alone = solve_lcp(replace(good, q=alone_q))
    (gradient,) = torch.autograd.grad(solution.alpha[3].sum(), q)
    (expected,) = torch.autograd.grad(alone.alpha.sum(), alone_q)
    assert torch.all(gradient[:3] == 0)
    assert torch.allclose(gradient[3], expected[0], rtol=1e-9, atol=1e-12)


def test_input_that_does_not_fit_is_refused() -> None:
    problem = random_lcp(0)
    for changed, text in (
        ({"q": problem.q[:, :7]}, r"Lcp\.q has shape \(3, 7\), expected \(3, 8\)"),
        ({"G": problem.G[:, :11], "m": problem.m[:, :11]}, "4 blocks of 3 rows, expected 11"),
        ({"A": torch.ones(3, 9, 8).double()}, "A has 9 rows, expected at most 8"),
        ({"m": problem.m.float()}, "torch.float64"),
        ({"M": problem.M * torch.tensor([1, 1, 1, 1, 1, 1, 1, 0])}, "entries that are not > 0"),
    ):
        with pytest.raises(InputError, match=text):
            replace(problem, **changed)
