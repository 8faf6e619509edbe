"""Friction between the table and the cells (compiled).

Friction f phi(v) opposes the velocity v of a cell; f = mu_i m_i g is its limit. There are two laws, both smoothed forms of Coulomb's:

    circle    phi(v) = v / sqrt(|v|^2 + eps^2)
    diamond   phi(v) = 1/2 sum_{d = (1,1), (1,-1)} d s(d . v),      s(t) = t / (eps + sqrt(eps^2 + t^2)),  v in table axes

The diamond is the paper's friction pyramid (rows +-x, +-y; multipliers that sum to at most f). |phi_x| + |phi_y| <= 1 is a square, so
that it splits into two one-dimensional frictions of half the limit along its diagonals, with dissipation f max(|v_x|, |v_y|). For the
diamond, eps is the end of the central path of `pyramid.py`, far below any relevant speed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from push_ident.physics.kernel import fast_kernel
from push_ident.types import Float64Array

GRAVITY = 9.81
"""[m/s^2]"""


class Cone(NamedTuple):
    """Law of the support friction during one step."""

    diamond: bool
    """Whether the law is the paper's pyramid; else it is the circle."""
    eps: float
    """Smoothing speed [m/s]."""
    cos: float
    """Cosine of the object's yaw: the diamond is fixed in table axes."""
    sin: float


class SupportImpulse(NamedTuple):
    """Impulse of the support friction in a solved step, and its derivatives; object axes."""

    impulse: Float64Array
    """dt sum_i f_i J_i' phi_i [N s, N s, N m s], shape (3,)."""
    stiffness: Float64Array
    """Its derivative with respect to the twist, without R' R, shape (3, 3)."""
    by_yaw: Float64Array
    """Its derivative with respect to the yaw at a fixed twist in object axes, without R' s. Zero for the circular cone. Shape (3,)."""
    stuck: Float64Array
    """[R s] of the sticking cells of the pyramid: R' R is their derivative with respect to the twist, R' s that with respect to the yaw.
    Zero for the circular cone. Shape (3, 4)."""


@fast_kernel
def unit_friction(ux: float, uy: float, cone: Cone) -> tuple[float, float]:
    """phi(v) of a cell with velocity (ux, uy), both in object axes."""
    if not cone.diamond:
        q = 1.0 / math.sqrt(ux * ux + uy * uy + cone.eps * cone.eps)
        return q * ux, q * uy
    x, y = cone.cos * ux - cone.sin * uy, cone.sin * ux + cone.cos * uy
    a, b = x + y, x - y
    a /= cone.eps + math.sqrt(cone.eps * cone.eps + a * a)
    b /= cone.eps + math.sqrt(cone.eps * cone.eps + b * b)
    x, y = 0.5 * (a + b), 0.5 * (a - b)
    return cone.cos * x + cone.sin * y, -cone.sin * x + cone.cos * y


@fast_kernel
def support_friction(
    twist: Float64Array, arms: Float64Array, limit: Float64Array, eps: float, newton: bool, gradient: Float64Array, hessian: Float64Array
) -> None:
    """Friction of the table on all cells: sum_i f_i J_i' phi(J_i u) and its derivative with respect to u.

    Args:
        twist: twist of the centre of mass, object axes [m/s, m/s, rad/s], shape (3,).
        arms: cell centres from the centre of mass [m], shape (2, n_cells), object axes.
        limit: friction force of each cell when it slides [N], shape (n_cells,).
        eps: smoothing speed [m/s].
        newton: whether to compute the exact derivative; else that of the majoriser.
        gradient: filled [N, N, N m], shape (3,).
        hessian: filled, shape (3, 3).
    """
    vx, vy, w = twist[0], twist[1], twist[2]
    eps2 = eps * eps
    x, y = arms[0], arms[1]
    g0 = g1 = g2 = 0.0
    h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    turn = 1.0 if newton else 0.0
    for i in range(limit.shape[0]):
        rx, ry = x[i], y[i]
        ux, uy = vx - w * ry, vy + w * rx
        s = 1.0 / math.sqrt(ux * ux + uy * uy + eps2)
        fs = limit[i] * s
        px, py = fs * ux, fs * uy
        g0 += px
        g1 += py
        g2 += rx * py - ry * px
        q = turn * s * s
        kxx = fs - q * px * ux
        kxy = -q * px * uy
        kyy = fs - q * py * uy
        ax = kxy * rx - kxx * ry
        ay = kyy * rx - kxy * ry
        h00 += kxx
        h01 += kxy
        h11 += kyy
        h02 += ax
        h12 += ay
        h22 += rx * ay - ry * ax
    gradient[0], gradient[1], gradient[2] = g0, g1, g2
    hessian[0, 0], hessian[0, 1], hessian[0, 2] = h00, h01, h02
    hessian[1, 0], hessian[1, 1], hessian[1, 2] = h01, h11, h12
    hessian[2, 0], hessian[2, 1], hessian[2, 2] = h02, h12, h22


@fast_kernel
def add_skew(
    twist: Float64Array,
    arms: Float64Array,
    limit: Float64Array,
    skew: Float64Array,
    eps: float,
    newton: bool,
    gradient: Float64Array,
    hessian: Float64Array,
) -> None:
    """Add friction that depends on the direction of motion, f E phi(v), to the results of `support_friction`.

    E = [[a, b], [b, -a]] in object axes; `skew` is (a, b). The force is not the gradient of a potential: its derivative is unsymmetric.
    """
    vx, vy, w = twist[0], twist[1], twist[2]
    a, b = skew[0], skew[1]
    x, y = arms[0], arms[1]
    turn = 1.0 if newton else 0.0
    g0 = g1 = g2 = 0.0
    h00 = h01 = h02 = h10 = h11 = h12 = h20 = h21 = h22 = 0.0
    for i in range(limit.shape[0]):
        rx, ry = x[i], y[i]
        ux, uy = vx - w * ry, vy + w * rx
        s = 1.0 / math.sqrt(ux * ux + uy * uy + eps * eps)
        fs = limit[i] * s
        q = turn * fs * s * s
        kxx, kxy, kyy = fs - q * ux * ux, -q * ux * uy, fs - q * uy * uy
        px, py = fs * (a * ux + b * uy), fs * (b * ux - a * uy)
        exx, exy, eyx, eyy = a * kxx + b * kxy, a * kxy + b * kyy, b * kxx - a * kxy, b * kxy - a * kyy
        ex, ey = exy * rx - exx * ry, eyy * rx - eyx * ry
        g0 += px
        g1 += py
        g2 += rx * py - ry * px
        h00 += exx
        h01 += exy
        h02 += ex
        h10 += eyx
        h11 += eyy
        h12 += ey
        h20 += rx * eyx - ry * exx
        h21 += rx * eyy - ry * exy
        h22 += rx * ey - ry * ex
    gradient[0] += g0
    gradient[1] += g1
    gradient[2] += g2
    hessian[0, 0] += h00
    hessian[0, 1] += h01
    hessian[0, 2] += h02
    hessian[1, 0] += h10
    hessian[1, 1] += h11
    hessian[1, 2] += h12
    hessian[2, 0] += h20
    hessian[2, 1] += h21
    hessian[2, 2] += h22


@fast_kernel
def cell_friction(
    twist: Float64Array, arms: Float64Array, limit: Float64Array, skew: Float64Array, eps: float, force: Float64Array
) -> None:
    """Friction of each cell, f (I + E) phi(v) and its torque about the centre of mass: fills `force`, shape (3, n_cells)."""
    x, y = arms[0], arms[1]
    a, b = skew[0], skew[1]
    for i in range(limit.shape[0]):
        rx, ry = x[i], y[i]
        ux, uy = twist[0] - twist[2] * ry, twist[1] + twist[2] * rx
        fs = limit[i] / math.sqrt(ux * ux + uy * uy + eps * eps)
        px, py = fs * (ux + a * ux + b * uy), fs * (uy + b * ux - a * uy)
        force[0, i], force[1, i], force[2, i] = px, py, rx * py - ry * px
