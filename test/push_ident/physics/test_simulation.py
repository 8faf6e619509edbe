"""Planar pushing against closed forms, against finite differences, and for what must never happen."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import hammer, hammer_shape, random_push, square, straight_push, uniform
from push_ident.errors import InputError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, BodyParameters, SimulationSettings, body_of_cells, simulate, simulate_body
from push_ident.physics.support import support_friction
from push_ident.types import ObjectModel, PusherPath, SolveStatus

FINE = SimulationSettings(step=1 / 4000, smoothing_speed=1e-6)


def test_torque_of_a_spinning_disc() -> None:
    # A uniform disc that spins in place: 2/3 mu m g R.
    radius, mu, mass = 0.07, 0.37, 1.3
    grid = np.stack(np.meshgrid(np.linspace(-radius, radius, 401), np.linspace(-radius, radius, 401)), axis=-1).reshape(-1, 2)
    arms = grid[np.linalg.norm(grid, axis=1) < radius]
    limit = np.full(len(arms), mu * mass * GRAVITY / len(arms))
    gradient, hessian = np.empty(3), np.empty((3, 3))
    support_friction(np.array([0.0, 0.0, 2.3]), arms.T.copy(), limit, 1e-9, True, gradient, hessian)
    assert gradient[2] == pytest.approx(2 / 3 * mu * mass * GRAVITY * radius, rel=2e-3)
    assert gradient[:2] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_push_through_the_centre_needs_the_friction_force_and_does_not_turn() -> None:
    model = uniform(square())
    pusher = straight_push((-0.07, 0.0), 0.0, speed=0.13)
    motion = simulate(model, PushScenario(pusher, np.zeros(3), np.array([pusher.time[-1]])))
    middle = (motion.force_time > 0.7) & (motion.force_time < 0.9)
    assert motion.force[middle] == pytest.approx(np.tile([0.37 * 0.7 * GRAVITY, 0.0], (middle.sum(), 1)), rel=1e-4, abs=1e-6)
    assert motion.pose[-1, 1:] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_coasting_distance_after_the_pusher_stops() -> None:
    # v^2 / (2 mu g) beyond the pusher's own travel.
    speed, model = 0.3, uniform(square(), friction=0.21)
    pusher = straight_push((-0.045 - 0.008, 0.0), 0.0, speed=speed, travel=0.06, rate=1000)
    motion = simulate(model, PushScenario(pusher, np.zeros(3), np.array([pusher.time[-1]])), settings=FINE)
    assert motion.pose[-1, 0] - 0.06 == pytest.approx(speed**2 / (2 * 0.21 * GRAVITY), rel=5e-3)


def test_sliding_contact_drags_by_the_friction_of_the_pusher_and_so_does_its_derivative() -> None:
    # A body that cannot turn, without support friction, met by an oblique pusher: m u_n = l, m u_t = mu l, so u_t = mu u_n and
    # du_t/dmu = u_n, d/dm = 0. A backward pass with the transposed contact matrix gets 0 and the wrong sign.
    shape, mu, speed = square(), 0.23, np.array([0.4, 0.31])
    n = len(shape.cells)
    body = BodyParameters(0.7, np.zeros(2), 1e9, np.zeros(n))
    dt = 1 / 240
    start = np.array([-0.02, -0.045 - 0.008])
    pusher = PusherPath(np.array([0.0, dt]), np.array([start, start + dt * speed]), 0.008)
    motion = simulate_body(shape, body, mu, PushScenario(pusher, np.zeros(3), np.array([dt])), jacobian=True)
    assert motion.pose[0] / dt == pytest.approx([mu * speed[1], speed[1], 0.0], rel=1e-9, abs=1e-9)
    assert motion.jacobian[0, :, 7] / dt == pytest.approx([speed[1], 0.0, 0.0], rel=1e-9, abs=1e-9)
    assert motion.jacobian[0, :, 3] == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


def test_pusher_sticks_inside_its_friction_cone_and_slides_outside() -> None:
    shape = square()
    body = BodyParameters(0.7, np.zeros(2), 1e9, np.full(len(shape.cells), 0.01))
    for tangent, sticks in ((0.19, True), (0.21, False)):
        heading = np.pi / 2 - np.arctan(tangent)
        pusher = straight_push((-0.02, -0.0531), heading, speed=0.1, travel=0.05)
        early, late = simulate_body(shape, body, 0.2, PushScenario(pusher, np.zeros(3), np.array([0.6, 0.8])), settings=FINE).pose
        slip = 0.1 * 0.2 * np.cos(heading) - (late - early)[0]
        assert (abs(slip) < 1e-6) == sticks


def test_push_left_of_the_centre_of_friction_turns_the_object_clockwise() -> None:
    model = hammer(1)
    left = model.centre_of_friction[0] - 0.02
    pusher = straight_push((left, -0.04), np.pi / 2)
    end = simulate(model, PushScenario(pusher, np.zeros(3), pusher.time[-1:])).pose[-1]
    assert end[2] < -0.1


@pytest.mark.parametrize("seed", range(12))
def test_derivative_equals_central_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = hammer(seed)
    pose = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-3, 3)])
    pusher = random_push(model.shape, pose, rng)
    body = body_of_cells(model.shape, model.mass, model.friction)
    point = np.r_[pose, body.mass, body.centre, body.inertia, model.pusher_friction, body.limit]
    time = np.linspace(pusher.time[0], pusher.time[-1], 9)

    def poses(q: np.ndarray) -> np.ndarray:
        return simulate_body(model.shape, BodyParameters(q[3], q[4:6], q[6], q[8:]), q[7], PushScenario(pusher, q[:3], time)).pose

    exact = simulate_body(model.shape, body, model.pusher_friction, PushScenario(pusher, pose, time), jacobian=True).jacobian
    for column in [*range(8), 8, 31, 60, 77]:
        if column >= len(point):
            continue
        step = np.zeros_like(point)
        step[column] = 1e-7 if column in (4, 5) else 1e-6 * max(abs(point[column]), 0.01 if column < 3 else 0.0)
        differences = (poses(point + step) - poses(point - step)) / (2 * step[column])
        assert exact[:, :, column] == pytest.approx(differences, rel=1e-4, abs=2e-5 * max(1.0, np.abs(differences).max())), column


@pytest.mark.parametrize("seed", range(20))
def test_random_push_never_penetrates_nor_fails(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    model = hammer(seed, pusher_friction=rng.uniform(0.05, 0.8))
    pose = np.array([0.02, -0.03, rng.uniform(-3, 3)])
    pusher = random_push(model.shape, pose, rng)
    time = np.arange(pusher.time[0], pusher.time[-1], 1 / 240)
    motion = simulate(model, PushScenario(pusher, pose, time))
    assert motion.status is SolveStatus.CONVERGED
    at = np.column_stack([np.interp(time, pusher.time, pusher.position[:, axis]) for axis in (0, 1)])
    seen = np.concatenate([transform_points(inverse(p), a[None]) for p, a in zip(motion.pose, at, strict=True)])
    assert np.min(signed_distance(seen, model.shape.outline) - pusher.radius) > -1e-4


def test_kinetic_energy_never_rises_after_the_pusher_has_stopped() -> None:
    model = hammer(3)
    pusher = straight_push((-0.1, -0.04), np.pi / 2, speed=0.3)
    stop = 0.4 + 0.09 / 0.3
    time = np.arange(stop + 0.01, stop + 0.2, 1 / 240)
    motion = simulate(model, PushScenario(pusher, np.zeros(3), time))
    body = body_of_cells(model.shape, model.mass, model.friction)
    centre = np.concatenate([transform_points(p, body.centre[None]) for p in motion.pose])
    velocity = np.diff(np.column_stack([centre, motion.pose[:, 2]]), axis=0) * 240
    energy = 0.5 * velocity**2 @ [body.mass, body.mass, body.inertia]
    assert energy[0] > 1e-4
    assert np.all(np.diff(energy) <= 1e-9)


def test_motion_does_not_depend_on_the_total_mass() -> None:
    # Therefore poses without forces never determine it.
    model = hammer(5)
    heavy = ObjectModel(model.shape, 3.7 * model.mass, model.friction, model.pusher_friction)
    pusher = straight_push((0.05, -0.09), np.pi / 2 + 0.2)
    a, b = (simulate(m, PushScenario(pusher, np.zeros(3), pusher.time)) for m in (model, heavy))
    assert a.pose == pytest.approx(b.pose, abs=1e-9)
    assert b.force == pytest.approx(3.7 * a.force, rel=1e-5, abs=1e-6)


def test_push_that_misses_has_a_status() -> None:
    pusher = straight_push((0.5, 0.5), 0.0)
    motion = simulate(hammer(), PushScenario(pusher, np.zeros(3), pusher.time))
    assert motion.status is SolveStatus.NO_CONTACT
    assert np.all(motion.pose == 0)


def test_first_pose_that_is_not_finite_is_refused() -> None:
    with pytest.raises(InputError, match="first pose"):
        simulate(hammer(), PushScenario(straight_push((0.5, 0.5), 0.0), np.array([0.0, np.nan, 0.0]), np.array([1.0])))


def test_cells_carry_their_own_weight() -> None:
    shape = hammer_shape()
    mass = np.linspace(0.001, 0.01, len(shape.cells))
    body = body_of_cells(shape, mass, np.full(len(mass), 0.3))
    assert body.limit == pytest.approx(0.3 * mass * GRAVITY)
    assert body.centre == pytest.approx(mass @ shape.cells.centres / mass.sum())


def test_an_overlap_is_taken_back_without_throwing_the_object_away() -> None:
    model = hammer(0)
    edge = float(model.shape.outline[:, 0].max())
    # Noisy poses put the pusher 1 mm inside; it then stands still.
    pusher = PusherPath(np.array([0.0, 1.0]), np.array([[edge + 0.007, 0.0], [edge + 0.007, 0.0]]), 0.008)
    motion = simulate(model, PushScenario(pusher, np.zeros(3), np.array([0.0, 0.5, 1.0])))
    assert motion.pose[-1, 0] == pytest.approx(-1e-3, abs=1e-4)
    assert np.array_equal(motion.pose[1], motion.pose[2])
