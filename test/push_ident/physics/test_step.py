"""A step with several contacts, proven optimal by its own conditions; of the pyramid: against the LCP (`test_proof_engines.py`)."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.physics.modes import MAX_CONTACTS, N_IMPULSES, Mode, Row, StepContacts, StepGeometry
from push_ident.physics.step import new_step_scratch, step
from push_ident.physics.support import support_friction
from push_ident.types import Float64Array


def random_contacts(rng: np.random.Generator, n_contacts: int) -> Float64Array:
    """One contact; two on faces at right angles; or two on one flat face."""
    rows = np.zeros((2 * MAX_CONTACTS, Row.WIDTH))
    angle, corner = rng.uniform(-np.pi, np.pi), rng.uniform() < 0.5
    first = np.array([np.cos(angle), np.sin(angle)])
    velocity = -0.1 * first + 0.05 * rng.normal(size=2)
    for k in range(n_contacts):
        n = np.array([-first[1], first[0]]) if corner and k else first
        t = np.array([-n[1], n[0]])
        r = 0.04 * n + 0.02 * (rng.uniform(-1, 1) if corner or not n_contacts > 1 else (2 * k - 1)) * t
        rows[k, :4] = [-n[0], -n[1], -(r[0] * n[1] - r[1] * n[0]), -n @ velocity - rng.choice([0.0, 1e-4]) * 240]
        rows[MAX_CONTACTS + k, :4] = [t[0], t[1], r[0] * t[1] - r[1] * t[0], t @ velocity]
        rows[k, 4] = float(k == 0 or not corner)
    return rows


def checked_impulse(twist: Float64Array, rows: Float64Array, n_contacts: int, mu: float, impulse: Float64Array, code: int) -> Float64Array:
    """Of the contacts: they part or press, never pull; the tangent is inside its cone when it sticks, else on it against the slip."""
    gap_speed = rows[:n_contacts, :3] @ twist - rows[:n_contacts, 3]
    assert np.all(gap_speed > -1e-10)
    assert np.all(impulse[:n_contacts] >= 0)
    assert np.all(np.abs(gap_speed * impulse[:n_contacts]) < 1e-12)
    carried = mu * impulse[:n_contacts] @ rows[:n_contacts, 4]
    assert abs(impulse[MAX_CONTACTS]) <= carried + 1e-15
    pressing = [k for k in range(n_contacts) if (code >> (2 + k)) & 1 and rows[k, 4]]
    tangent = rows[MAX_CONTACTS + (pressing[0] if pressing else 0)]
    if pressing:
        slip = tangent[:3] @ twist - tangent[3]
        if code % 4 == Mode.STICK:
            assert abs(slip) < 1e-10
        else:
            assert code % 4 in (Mode.SLIDE_PLUS, Mode.SLIDE_MINUS)
            assert slip * impulse[MAX_CONTACTS] <= 1e-15
            assert abs(impulse[MAX_CONTACTS]) == pytest.approx(carried)
    return np.asarray(impulse[:n_contacts] @ rows[:n_contacts, :3] + impulse[MAX_CONTACTS] * tangent[:3])


@pytest.mark.parametrize("n_contacts", [0, 1, 2])
def test_step_meets_its_optimality_conditions(n_contacts: int) -> None:
    # The problem is convex (and monotone where the contact slides), so its conditions prove the solution.
    dt, mu = 1 / 240, 0.3
    for seed in range(60):
        rng = np.random.default_rng(seed)
        n_cells = int(rng.integers(1, 40))
        arms = 0.03 * rng.normal(size=(2, n_cells))
        limit = rng.uniform(0, 4 / n_cells, n_cells)
        inertia = np.array([0.6, 0.6, 6e-4])
        yaw = rng.uniform(-np.pi, np.pi)
        cos, sin = np.cos(yaw), np.sin(yaw)
        old = rng.normal(size=3) * [0.05, 0.05, 1.0] * rng.choice([0.0, 1.0])
        rows = random_contacts(rng, n_contacts)
        twist, impulse = old.copy(), np.zeros(N_IMPULSES)
        geometry = StepGeometry(arms, limit, inertia, 0.03, np.zeros(2), np.array([cos, sin]), dt)
        contacts, scratch = StepContacts(rows, n_contacts, mu), new_step_scratch()
        # Whatever the step before was like, from which the first guess comes.
        scratch.rate[:] = rng.normal(size=3) * [10.0, 10.0, 200.0] * rng.choice([0.0, 1.0])
        code, _ = step(twist, geometry, contacts, 1e-4, 0, impulse, scratch)
        assert code != Mode.NONE, seed
        pushed = checked_impulse(twist, rows, n_contacts, mu, impulse, code)
        friction, stiffness = np.zeros(3), np.zeros((3, 3))
        support_friction(twist, arms, limit, 1e-4, True, friction, stiffness)
        balance = inertia * (twist - old) + dt * friction - pushed
        assert np.abs(balance / [1, 1, 0.03]).max() <= 1e-10 * 0.6
