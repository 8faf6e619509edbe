"""Planar pushing against closed forms, against finite differences, and for what must never happen."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import hammer, hammer_shape, straight_push
from push_ident.errors import InputError
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, body_of_cells, simulate
from push_ident.physics.support import support_friction
from push_ident.types import PusherPath, SolveStatus


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


def test_push_left_of_the_centre_of_friction_turns_the_object_clockwise() -> None:
    model = hammer(1)
    left = model.centre_of_friction[0] - 0.02
    pusher = straight_push((left, -0.04), np.pi / 2)
    end = simulate(model, PushScenario(pusher, np.zeros(3), pusher.time[-1:])).pose[-1]
    assert end[2] < -0.1


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
