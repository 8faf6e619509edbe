"""Mixed linear complementarity problems in batches, solved by an interior-point method, with their exact derivative.

The problem is Eq. 2 of Song & Boularias (2020), with the unknowns in the order of its columns:

    | 0 |   | M  G' A' | | alpha |   | -q |
    | s | + | G  F  0  | | gamma | = |  m |        s >= 0,  gamma >= 0,  s' gamma = 0
    | 0 |   | A  0  0  | | beta  |   |  0 |

M is diagonal and positive, and A has independent rows. F need not be symmetric; with friction it is not.

**Solution.** With N a basis of the null space of A, scaled so that N'MN = I, the motion is alpha = -N (N'q + H' gamma), H = G N. This
leaves a standard problem, s = b + (HH' - F) gamma with b = m + H N'q. Mehrotra's primal-dual predictor-corrector method solves it, in the
form of Mattingley & Boyd (2012) for embedded use. F is block diagonal (one block for each contact) and H has few columns (three for one
rigid body), so the linear system of an iteration costs one small factorisation for each block and one for all.

**Derivative.** Four equations define the solution implicitly: the three rows above and s o gamma = 0. For a loss with gradient
(g_alpha, g_gamma), the adjoint variables solve the *transposed* system

    | M  G'           A' | | u |   | g_alpha |
    | G  F' - S/Gamma 0  | | w | = | g_gamma |        dloss/dq = -u,  dloss/dm = w,  dloss/dF = -w gamma', ...
    | A  0            0  | | z |   | 0       |

The slack scaling S/Gamma is diagonal and so its own transpose; F is not. Some published differentiable engines use the system of the
forward solve, with F in place of F'. Their gradients are right while each contact sticks or is free, since then the rows in which F and
F' differ drop out. They are wrong, even in sign, when a contact slides.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from push_ident.errors import InputError


class _Method(NamedTuple):
    """Of the interior-point method and its adjoint; numbers without unit, near the rounding of double precision."""

    ratio_floor: float = 1e-11
    """Lower bound of the scaled s / gamma in the factorisation."""
    smallest_size: float = 1e-8
    """Lower bound of max(s) max(gamma), with which each s_i gamma_i is compared: at a solution it may be zero."""
    refined: float = 1e-15
    """Residual of a linear system, relative to its right-hand side, at which refinement ends."""
    max_refinements: int = 20
    """Of an adjoint system."""
    singular: float = 1e-8
    """Relative residual above which an adjoint system counts as singular."""
    starts: tuple[tuple[float, float], ...] = ((1.0, 1.0), (10.0, 10.0), (1.0, 10.0), (0.1, 0.1))
    """Starting points (gamma, s). If the problem is not monotone, the method may fail from one and converge from another."""


_METHOD: Final = _Method()


class LcpStatus(Enum):
    """Outcome of the solve of one problem; the value gives the cause and the remedy."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "not converged within the iterations allowed; allow more, or check that the problem has a solution"
    DEPENDENT_ROWS = "rows of A depend on each other; leave out the redundant ones"
    NOT_FINITE = "the problem contains values that are not finite"


@dataclass(frozen=True, slots=True)
class Lcp:
    """A batch of problems. All tensors are float64 and may require gradients."""

    M: Tensor
    """Diagonal of M, > 0, shape (batch, n_alpha)."""
    q: Tensor
    """Shape (batch, n_alpha)."""
    G: Tensor
    """Shape (batch, n_gamma, n_alpha)."""
    F: Tensor
    """Diagonal blocks, shape (batch, n_blocks, size, size) with n_blocks * size = n_gamma; a full matrix is one block."""
    m: Tensor
    """Shape (batch, n_gamma)."""
    A: Tensor
    """Shape (batch, n_beta, n_alpha), rows independent; n_beta may be 0."""

    def __post_init__(self) -> None:
        if self.G.ndim != 3 or self.F.ndim != 4:
            raise InputError(f"Lcp.G has shape {tuple(self.G.shape)} and F {tuple(self.F.shape)}, expected three and four dimensions.")
        batch, n_gamma, n_alpha = self.G.shape
        n_blocks, size = self.F.shape[1:3]
        expected = {
            "M": (batch, n_alpha),
            "q": (batch, n_alpha),
            "F": (batch, n_blocks, size, size),
            "m": (batch, n_gamma),
            "A": (batch, *self.A.shape[1:2], n_alpha),
        }
        for name, shape in expected.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise InputError(f"Lcp.{name} has shape {got}, expected {shape} beside G of shape {(batch, n_gamma, n_alpha)}.")
        if self.A.shape[1] > n_alpha:
            raise InputError(f"Lcp.A has {self.A.shape[1]} rows, expected at most {n_alpha}, as many as there are velocities.")
        if n_blocks * size != n_gamma:
            raise InputError(f"Lcp.F has {n_blocks} blocks of {size} rows, expected {n_gamma} rows in all, as G has.")
        for name in ("M", "q", "G", "F", "m", "A"):
            dtype = getattr(self, name).dtype
            if dtype != torch.float64:
                raise InputError(f"Lcp.{name} is of {dtype}, expected torch.float64; single precision does not reach the tolerance.")
        if not bool(torch.all((self.M > 0) | ~torch.isfinite(self.M))):
            raise InputError(f"Lcp.M has {int((self.M <= 0).sum())} entries that are not > 0; every velocity needs a mass.")


@dataclass(frozen=True, slots=True)
class LcpSolution:
    """Solutions of a batch of problems; NaN where the status is not CONVERGED."""

    alpha: Tensor
    """Shape (batch, n_alpha); differentiable. A gradient is NaN where the adjoint system is singular."""
    gamma: Tensor
    """Shape (batch, n_gamma); differentiable where it is unique."""
    beta: Tensor
    """Shape (batch, n_beta); not differentiable."""
    s: Tensor
    """Shape (batch, n_gamma); not differentiable. Use m - G alpha - F gamma for gradients."""
    status: tuple[LcpStatus, ...]
    """One for each problem."""

    @property
    def converged(self) -> bool:
        """Whether every problem of the batch was solved."""
        return all(status is LcpStatus.CONVERGED for status in self.status)


def solve_lcp(problem: Lcp, *, tolerance: float = 1e-12, max_iterations: int = 60) -> LcpSolution:
    """Solve a batch of mixed linear complementarity problems.

    Args:
        problem: the batch.
        tolerance: bound on the residual of the second row, with rows and columns scaled so that the problem is of order one. The bound on
            each product s_i gamma_i is a hundredth of it, times the largest s and the largest gamma where their product is below one.
            Rounding prevents tolerances much below the default.
        max_iterations: of the interior-point method from each of its four starting points. Usually the first converges in about twelve.

    Returns:
        Solutions with their statuses. Where HH' - F is positive semidefinite (no friction at contacts of unknown load) the method
        finds a solution whenever one exists. Elsewhere it nearly always does; the status reports a failure.

    Raises:
        InputError: shapes that do not fit, tensors not in double precision, masses that are not positive.
    """
    outcome = _Outcome(tolerance, max_iterations)
    alpha, gamma, beta, s = _SolveLcp.apply(problem.M, problem.q, problem.G, problem.F, problem.m, problem.A, outcome)
    return LcpSolution(alpha, gamma, beta, s, outcome.status)


@dataclass(slots=True)
class _Outcome:
    """Settings and results of the autograd function that are not tensors."""

    tolerance: float
    max_iterations: int
    status: tuple[LcpStatus, ...] = ()


class _SolveLcp(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, M: Tensor, q: Tensor, G: Tensor, F: Tensor, m: Tensor, A: Tensor, outcome: _Outcome
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        finite = torch.stack([torch.isfinite(x).flatten(1).all(dim=1) for x in (M, q, G, F, m, A)]).all(dim=0)
        if not bool(finite.all()):
            M = torch.where(finite[:, None], M, 1.0)
            q, G, F, m, A = (torch.where(finite.view(-1, *[1] * (x.ndim - 1)), x, 0.0) for x in (q, G, F, m, A))
        N, R, independent = _null_space(M, A)
        H = G @ N
        d = _row_scale(H, F)
        free = _times(N.mT, q)
        gamma, s, solved = _solve_standard(*_scaled(d, H, F), d * (m + _times(H, free)), outcome.tolerance, outcome.max_iterations)
        gamma, s = gamma * d, s / d
        alpha = -_times(N, free + _times(H.mT, gamma))
        beta = -_normal_solve(R, _times(A, (q + _times(G.mT, gamma)) / M))

        good = finite & independent & solved
        outcome.status = tuple(map(_status, finite.tolist(), independent.tolist(), solved.tolist()))
        alpha, gamma, beta, s = (torch.where(good[:, None], x, torch.nan) for x in (alpha, gamma, beta, s))
        ctx.save_for_backward(M, G, F, A, N, R, d, alpha, gamma, beta, s, good)
        ctx.mark_non_differentiable(beta, s)
        return alpha, gamma, beta, s

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_alpha: Tensor, g_gamma: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        M, G, F, A, N, R, d, alpha, gamma, beta, s, good = ctx.saved_tensors
        # A problem that was not solved contributes no gradient.
        good = good[:, None]
        alpha, beta = torch.where(good, alpha, 0.0), torch.where(good, beta, 0.0)
        # In the limit a ratio is 0 or infinite. The third power brings the ratio of the last iteration close to that limit. It keeps
        # the ratio of pairs in which both are zero; their derivative lies between those of the two sides.
        gamma, ratio = torch.where(good, gamma, 0.0), torch.where(good, (d * d * s / gamma) ** 3, 1.0)
        g_alpha, g_gamma = torch.where(good, g_alpha, 0.0), torch.where(good, g_gamma, 0.0)

        g_motion = _times(N.mT, g_alpha)
        H, F_transposed = _scaled(d, G @ N, F.mT)
        w, left = _KktSolver(ratio, H, F_transposed).solve(_times(H, g_motion) - d * g_gamma, _METHOD.max_refinements)
        w = torch.where(left[:, None] <= _METHOD.singular, d * w, torch.nan)
        u = _times(N, g_motion - _times(N.mT, _times(G.mT, w)))

        need_M, need_q, need_G, need_F, need_m, need_A = ctx.needs_input_grad[:6]
        blocks = F.shape[:3]
        z = _normal_solve(R, _times(A, (g_alpha - _times(G.mT, w)) / M)) if need_A else None
        return (
            -u * alpha if need_M else None,
            -u if need_q else None,
            -(_outer(gamma, u) + _outer(w, alpha)) if need_G else None,
            -_outer(w.reshape(blocks), gamma.reshape(blocks)) if need_F else None,
            w if need_m else None,
            -(_outer(beta, u) + _outer(z, alpha)) if z is not None else None,
            None,
        )


def _status(finite: bool, independent: bool, solved: bool) -> LcpStatus:
    if not finite:
        return LcpStatus.NOT_FINITE
    if not independent:
        return LcpStatus.DEPENDENT_ROWS
    return LcpStatus.CONVERGED if solved else LcpStatus.MAX_ITERATIONS


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


def _times_blocks(blocks: Tensor, vector: Tensor) -> Tensor:
    return _times(blocks, vector.reshape(blocks.shape[:3])).reshape(vector.shape)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a[..., :, None] * b[..., None, :]


def _null_space(M: Tensor, A: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Basis N of the null space of A with N'MN = I, the factor R of A M^-1 A' = R'R, and whether the rows of A are independent."""
    n_beta = A.shape[1]
    root = torch.sqrt(M)[..., None]
    if n_beta == 0:
        return torch.diag_embed(1 / root[..., 0]), A.new_zeros(len(A), 0, 0), torch.ones(len(A), dtype=torch.bool)
    # Orthogonal factors keep the null space accurate where the masses of a row differ by orders of magnitude.
    Q, R = torch.linalg.qr(A.mT / root, mode="complete")
    R = R[:, :n_beta]
    pivots = R.diagonal(dim1=-2, dim2=-1).abs()
    return Q[..., n_beta:] / root, R, pivots.amin(dim=-1) > 1e-10 * pivots.amax(dim=-1)


def _normal_solve(R: Tensor, b: Tensor) -> Tensor:
    """Solve R'R x = b for x."""
    y = torch.linalg.solve_triangular(R.mT, b[..., None], upper=False)
    return torch.linalg.solve_triangular(R, y, upper=True)[..., 0]


class _KktSolver:
    """Solves (S/Gamma + HH' - F) x = r with one small factorisation for each block, and one with as many rows as H has columns.

    Near the solution the ratios of active rows are as small as rounding errors and vanish in the elimination of the blocks. So the system
    is factorised with a lower bound on the ratios; iterative refinement then removes its influence.

    Shapes: ratio (batch, n), H (batch, n, r), F (batch, n_blocks, size, size), n = n_blocks * size.
    """

    def __init__(self, ratio: Tensor, H: Tensor, F: Tensor) -> None:
        self._ratio, self._H, self._F = ratio, H, F
        floored = torch.clamp(ratio, min=_METHOD.ratio_floor).reshape(F.shape[:3])
        self._lu, self._pivots, _ = torch.linalg.lu_factor_ex(torch.diag_embed(floored) - F)
        self._block_H = self._solve_blocks(H)
        motion = H.mT @ self._block_H
        motion.diagonal(dim1=-2, dim2=-1).add_(1.0)
        self._motion_lu, self._motion_pivots, _ = torch.linalg.lu_factor_ex(motion)

    def _solve_blocks(self, b: Tensor) -> Tensor:
        return torch.linalg.lu_solve(self._lu, self._pivots, b.reshape(*self._F.shape[:3], b.shape[-1])).reshape(b.shape)

    def solve(self, r: Tensor, max_refinements: int) -> tuple[Tensor, Tensor]:
        """x, and the largest remaining residual of each problem relative to the largest entry of r, shape (batch,)."""
        size = torch.clamp(r.abs().amax(dim=1), min=1e-300)
        x, residual = torch.zeros_like(r), r
        for _ in range(1 + max_refinements):
            y = self._solve_blocks(residual[..., None])
            x = x + (y - self._block_H @ torch.linalg.lu_solve(self._motion_lu, self._motion_pivots, self._H.mT @ y))[..., 0]
            residual = r - self._ratio * x - _times(self._H, _times(self._H.mT, x)) + _times_blocks(self._F, x)
            left = residual.abs().amax(dim=1) / size
            if not bool((left > _METHOD.refined).any()):
                break
        return x, left


def _scaled(d: Tensor, H: Tensor, F: Tensor) -> tuple[Tensor, Tensor]:
    """H with its rows multiplied by d, and F with its rows and columns multiplied by d."""
    by_block = d.reshape(F.shape[:3])
    return d[..., None] * H, _outer(by_block, by_block) * F


def _row_scale(H: Tensor, F: Tensor) -> Tensor:
    """Positive d that brings the largest entry of each row and column of d (HH' - F) d near one, shape (batch, n)."""
    blocks = F.shape[:3]
    size = F.abs()
    motion = torch.sum(H * H, dim=-1).reshape(blocks)
    d = torch.ones_like(motion)
    for _ in range(8):
        scaled = d[..., :, None] * size * d[..., None, :]
        largest = torch.maximum(torch.maximum(scaled.amax(dim=-1), scaled.amax(dim=-2)), d * d * motion)
        d = d / torch.sqrt(torch.where(largest > 0, largest, 1.0))
    return d.reshape(H.shape[:2])


def _solve_standard(H: Tensor, F: Tensor, b: Tensor, tolerance: float, max_iterations: int) -> tuple[Tensor, Tensor, Tensor]:
    """gamma and s of s = b + (HH' - F) gamma, s, gamma >= 0, s'gamma = 0; whether each problem was solved.

    Shapes: H (batch, n, r), F (batch, n_blocks, size, size), b (batch, n).
    """
    # The solution is proportional to b.
    unit = b.abs().amax(dim=1, keepdim=True)
    unit = torch.where(unit > 0, unit, 1.0)
    b = b / unit
    gamma, s = torch.empty_like(b), torch.empty_like(b)
    solved = torch.zeros(len(b), dtype=torch.bool)
    left = torch.arange(len(b))
    for start in _METHOD.starts:
        gamma[left], s[left], solved[left] = _interior_point(H[left], F[left], b[left], start, tolerance, max_iterations)
        left = left[~solved[left]]
        if len(left) == 0:
            break
    return gamma * unit, s * unit, solved


def _interior_point(
    H: Tensor, F: Tensor, b: Tensor, start: tuple[float, float], tolerance: float, max_iterations: int
) -> tuple[Tensor, Tensor, Tensor]:
    """As `_solve_standard`, from one starting point (gamma, s) and with b of order one."""
    batch = len(b)
    gamma, s = torch.full_like(b, start[0]), torch.full_like(b, start[1])
    solved = torch.zeros(batch, dtype=torch.bool)
    active = torch.arange(batch)
    for iteration in range(max_iterations + 1):
        h, f, g, t = H[active], F[active], gamma[active], s[active]
        residual = t - b[active] - _times(h, _times(h.mT, g)) + _times_blocks(f, g)
        product = t * g
        # A row with hardly any diagonal is scaled up until its b dwarfs all others, whose s and gamma are then small beside one.
        negligible = 1e-2 * tolerance * torch.clamp(t.amax(dim=1, keepdim=True) * g.amax(dim=1, keepdim=True), _METHOD.smallest_size, 1.0)
        done = (residual.abs().amax(dim=1) <= tolerance) & (product <= negligible).all(dim=1)
        solved[active[done]] = True
        go = ~done & torch.isfinite(product).all(dim=1)
        if iteration == max_iterations or not bool(go.any()):
            break
        if not bool(go.all()):
            active, h, f, g, t, residual, product, negligible = (x[go] for x in (active, h, f, g, t, residual, product, negligible))

        kkt = _KktSolver(t / g, h, f)
        gap = product.mean(dim=1, keepdim=True)
        dg, dt = _newton(kkt, g, t, residual, product)
        step = torch.clamp(_step_to_boundary(g, dg, t, dt), max=1.0)
        centring = (((g + step * dg) * (t + step * dt)).mean(dim=1, keepdim=True) / gap) ** 3
        dg, dt = _newton(kkt, g, t, residual, product + dg * dt - torch.maximum(centring * gap, 0.1 * negligible))
        # Steps approach the boundary more closely as the gap decreases, so that the last iterations converge superlinearly.
        step = torch.clamp(torch.clamp(1.0 - gap, 0.99, 1.0 - 1e-6) * _step_to_boundary(g, dg, t, dt), max=1.0)
        gamma[active] = g + step * dg
        s[active] = t + step * dt
    return gamma, s, solved


def _newton(kkt: _KktSolver, gamma: Tensor, s: Tensor, residual: Tensor, product: Tensor) -> tuple[Tensor, Tensor]:
    """Newton step (d_gamma, d_s) that makes the linearised `residual` and `product` (s o gamma) zero."""
    d_gamma, _ = kkt.solve(residual - product / gamma, max_refinements=2)
    return d_gamma, -(product + s * d_gamma) / gamma


def _step_to_boundary(gamma: Tensor, d_gamma: Tensor, s: Tensor, d_s: Tensor) -> Tensor:
    """Largest step, at most 1000, that keeps gamma and s non-negative, shape (batch, 1)."""
    shrink = torch.maximum(-d_gamma / gamma, -d_s / s).amax(dim=1, keepdim=True)
    return 1.0 / torch.clamp(shrink, min=1e-3)
