"""The friction pyramid: each step proven optimal by its own conditions, and the motion it gives."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.objects import hammer, hammer_shape, random_push, square, straight_push, uniform
from push_ident.errors import InputError
from push_ident.physics.modes import MAX_CONTACTS, Mode, Row, StepContacts
from push_ident.physics.pyramid import new_pyramid_scratch, pyramid_step
from push_ident.physics.reference import ReferenceModel, reference_rollout
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, body_of_cells, cell_gradient, simulate, simulate_body
from push_ident.physics.step import new_step_scratch, step
from push_ident.physics.step_geometry import StepGeometry
from push_ident.physics.support import support_friction
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

PYRAMID = SimulationSettings(friction_cone="pyramid")


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


def check_contact_conditions(twist: Float64Array, rows: Float64Array, n_contacts: int, mu: float, impulse: Float64Array, code: int) -> None:
    """Contacts part or press, never pull; the tangent is inside its cone when it sticks, on it and against the slip when it slides."""
    gap_speed = rows[:n_contacts, :3] @ twist - rows[:n_contacts, 3]
    assert np.all(gap_speed > -1e-10)
    assert np.all(impulse[:n_contacts] >= 0)
    assert np.all(np.abs(gap_speed * impulse[:n_contacts]) < 1e-12)
    carried = mu * impulse[:n_contacts] @ rows[:n_contacts, 4]
    assert abs(impulse[-1]) <= carried + 1e-15
    pressing = [k for k in range(n_contacts) if (code >> (2 + k)) & 1 and rows[k, 4]]
    if pressing:
        tangent = rows[MAX_CONTACTS + pressing[0]]
        slip = tangent[:3] @ twist - tangent[3]
        if code % 4 == Mode.STICK:
            assert abs(slip) < 1e-10
        else:
            assert code % 4 in (Mode.SLIDE_PLUS, Mode.SLIDE_MINUS)
            assert slip * impulse[-1] <= 1e-15
            assert abs(impulse[-1]) == pytest.approx(carried)


def contact_impulse(rows: Float64Array, n_contacts: int, impulse: Float64Array, code: int) -> Float64Array:
    pressing = [k for k in range(n_contacts) if (code >> (2 + k)) & 1 and rows[k, 4]]
    tangent = rows[MAX_CONTACTS + (pressing[0] if pressing else 0), :3]
    return impulse[:n_contacts] @ rows[:n_contacts, :3] + impulse[-1] * tangent


@pytest.mark.parametrize("diamond", [False, True])
@pytest.mark.parametrize("n_contacts", [0, 1, 2])
def test_step_meets_its_optimality_conditions(diamond: bool, n_contacts: int) -> None:
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
        twist, impulse, cells = old.copy(), np.zeros(MAX_CONTACTS + 1), new_pyramid_scratch(n_cells)
        geometry = StepGeometry(arms, limit, inertia, 0.03, np.zeros(2), np.array([cos, sin]), dt)
        contacts, scratch = StepContacts(rows, n_contacts, mu), new_step_scratch()
        # Whatever the step before was like, from which the first guess comes.
        scratch.rate[:] = rng.normal(size=3) * [10.0, 10.0, 200.0] * rng.choice([0.0, 1.0])
        if diamond:
            code, _ = pyramid_step(twist, geometry, contacts, 0, impulse, scratch, cells)
        else:
            code, _ = step(twist, geometry, contacts, 1e-4, 0, impulse, scratch)
        assert code != Mode.NONE, seed
        check_contact_conditions(twist, rows, n_contacts, mu, impulse, code)
        if diamond:
            friction = np.zeros(3)
            lost = used = 0.0
            for e, d in enumerate(([1.0, 1.0], [1.0, -1.0])):
                dx, dy = cos * d[0] + sin * d[1], -sin * d[0] + cos * d[1]
                row = np.stack([np.full(n_cells, dx), np.full(n_cells, dy), arms[0] * dy - arms[1] * dx])
                q = 0.5 * (cells.z2[e] - cells.z1[e])
                slip = row.T @ twist
                assert np.all(np.abs(q) <= 1)
                lost += float(np.sum(limit * (np.abs(slip) - q * slip)))
                used += float(np.sum(limit * np.abs(slip)))
                friction += row @ (0.5 * dt * limit * q)
            # The friction of each cell takes as much power as any admissible force could.
            assert lost <= 1e-10 * max(used, 0.1)
        else:
            force, stiffness = np.zeros(3), np.zeros((3, 3))
            support_friction(twist, arms, limit, 1e-4, True, force, stiffness)
            friction = dt * force
        balance = inertia * (twist - old) + friction - contact_impulse(rows, n_contacts, impulse, code)
        assert np.abs(balance / [1, 1, 0.03]).max() <= 1e-10 * 0.6


def test_cell_dissipates_by_its_faster_axis() -> None:
    # Coasting along a table axis the pyramid brakes as the circle; along the diagonal with 1 / sqrt(2) of it.
    arms, limit, inertia, rows = (
        np.zeros((2, 1)),
        np.array([2.0]),
        np.array([0.5, 0.5, 1e-3]),
        np.zeros((2 * MAX_CONTACTS, Row.WIDTH)),
    )
    for yaw in (0.0, 0.7):
        for angle, brake in ((0.0, 1.0), (np.pi / 2, 1.0), (np.pi / 4, np.sqrt(0.5))):
            twist = np.array([0.3 * np.cos(angle - yaw), 0.3 * np.sin(angle - yaw), 0.0])
            geometry = StepGeometry(arms, limit, inertia, 0.03, np.zeros(2), np.array([np.cos(yaw), np.sin(yaw)]), 0.01)
            contacts, impulse = StepContacts(rows, 0, 0.3), np.zeros(MAX_CONTACTS + 1)
            pyramid_step(twist, geometry, contacts, 0, impulse, new_step_scratch(), new_pyramid_scratch(1))
            assert np.linalg.norm(twist[:2]) == pytest.approx(0.3 - brake * 2.0 / 0.5 * 0.01, rel=1e-9)


def test_pyramid_and_circle_agree_on_a_push_along_an_axis() -> None:
    model = uniform(square())
    pusher = straight_push((-0.07, 0.0), 0.0, speed=0.13)
    fine = SimulationSettings(smoothing_speed=1e-8)
    circle, pyramid = (simulate(model, PushScenario(pusher, np.zeros(3), pusher.time), settings=s).pose for s in (fine, PYRAMID))
    assert pyramid == pytest.approx(circle, abs=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_pyramid_equals_the_reference_engine_with_its_derivatives(seed: int) -> None:
    # The reference keeps the paper's 3k velocities, rigid joints and friction rows; the fast step has three velocities.
    rng = np.random.default_rng(seed)
    shape = hammer_shape(0.03)
    keep = ObjectShape(CellGrid(shape.cells.centres[::4], 0.03), shape.outline)
    n = len(keep.cells)
    model = ObjectModel(keep, rng.uniform(0.01, 0.08, n), rng.uniform(0.1, 0.5, n), 0.3)
    pose = np.array([0.02, -0.03, rng.uniform(-3, 3)])
    pusher = random_push(keep, pose, rng)
    # Start and end inside the motion: all is sliding then, and the reference is slow.
    pusher = PusherPath(pusher.time[24:48] - pusher.time[24], pusher.position[24:48], pusher.radius)
    time = pusher.time[::5]
    settings = SimulationSettings(step=1 / 120, friction_cone="pyramid")
    body = body_of_cells(keep, model.mass, model.friction)
    fast = simulate_body(keep, body, model.pusher_friction, PushScenario(pusher, pose, time), settings=settings, jacobian=True)
    by_mass, by_friction = cell_gradient(keep, model.mass, model.friction, fast.jacobian[-1])

    mass, friction, mu = (
        torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (model.mass, model.friction, model.pusher_friction)
    )
    result = reference_rollout(
        keep, ReferenceModel(mass, friction, mu), [pusher], torch.tensor(pose)[None], [time], settings=SimulationSettings(step=1 / 120)
    )  # fmt: skip
    end = result.poses[0]
    assert fast.pose == pytest.approx(end.detach().numpy(), abs=1e-8)
    assert np.abs(fast.pose[-1] - pose).max() > 5e-3
    for row in range(3):
        g_mass, g_friction, g_mu = torch.autograd.grad(end[-1, row], (mass, friction, mu), retain_graph=True)
        for exact, other in ((by_mass[row], g_mass), (by_friction[row], g_friction), (fast.jacobian[-1, row, 7], g_mu)):
            assert np.abs(exact - other.numpy()).max() < 5e-6 * np.abs(exact).max()


def test_resting_object_does_not_creep() -> None:
    # A slow side push below the friction of the pusher's cone leaves nothing behind: after the push nothing moves any more.
    model = uniform(square())
    pusher = straight_push((-0.07, 0.01), 0.3, speed=0.13, rest=0.6)
    late = np.array([pusher.time[-1] - 0.3, pusher.time[-1]])
    first, last = simulate(model, PushScenario(pusher, np.zeros(3), late), settings=PYRAMID).pose
    assert np.array_equal(first, last)


@pytest.mark.parametrize("seed", range(30))
def test_random_push_with_the_pyramid_converges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = hammer(seed, pusher_friction=rng.uniform(0.05, 0.8))
    pose = np.array([0.02, -0.03, rng.uniform(-3, 3)])
    pusher = random_push(model.shape, pose, rng)
    assert simulate(model, PushScenario(pusher, pose, pusher.time), settings=PYRAMID).status is SolveStatus.CONVERGED


def test_quasi_static_pyramid_is_refused() -> None:
    with pytest.raises(InputError, match="no unique motion"):
        SimulationSettings(friction_cone="pyramid", quasi_static=True)
