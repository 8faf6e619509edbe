"""Planar pushing against closed forms and finite differences: quasi-static pushes, polygon pushers, forces; and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, hammer_shape, square, straight_push, uniform
from push_ident.errors import InputError
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import (
    GRAVITY,
    BodyParameters,
    Motion,
    SimulationSettings,
    body_of_cells,
    simulate,
    simulate_body,
)
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus


def box(half_x: float, half_y: float) -> Float64Array:
    return np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])


def moved(model: ObjectModel, pusher: PusherPath, **settings: float | bool) -> Motion:
    """From the origin of the table, reported at the samples of the pusher."""
    return simulate(model, PushScenario(pusher, np.zeros(3), pusher.time), settings=SimulationSettings(**settings))  # type: ignore[arg-type]


def test_an_overlap_is_taken_back_without_throwing_the_object_away() -> None:
    """Noisy poses put the pusher 1 mm inside; it then stands still."""
    model = hammer(0)
    edge = float(model.shape.outline[:, 0].max())
    pose = moved(model, PusherPath(np.array([0.0, 0.5, 1.0]), np.full((3, 2), [edge + 0.007, 0.0]), 0.008)).pose
    assert pose[-1, 0] == pytest.approx(-1e-3, abs=1e-4)
    assert np.array_equal(pose[1], pose[2])


def test_quasi_static_push_is_the_limit_of_slow_pushes_and_ignores_the_mass() -> None:
    differences = []
    for speed in (0.1, 0.025):
        pusher = straight_push((0.05, -0.09), np.pi / 2, speed=speed)
        steps = {"step": 0.1 / 240 / speed, "smoothing_speed": 1e-4 * speed}
        dynamic, limit = (moved(hammer(4), pusher, quasi_static=q, **steps).pose for q in (False, True))
        differences.append(np.abs(dynamic[-1] - limit[-1]).max())
    assert differences[0] > 1e-5 and differences[1] < differences[0] / 4
    body = body_of_cells(hammer(4).shape, hammer(4).mass, hammer(4).friction)
    heavy = BodyParameters(5 * body.mass, body.centre, 3 * body.inertia, body.limit)
    settings = SimulationSettings(quasi_static=True, **steps)
    motion = simulate_body(hammer(4).shape, heavy, 0.25, PushScenario(pusher, np.zeros(3), pusher.time), settings=settings)
    assert motion.pose == pytest.approx(limit, abs=1e-9)


def test_force_of_a_steady_push_through_the_centre_is_the_friction_of_the_object() -> None:
    pusher = PusherPath(np.array([0.0, 1.0]), np.array([[-0.06, 0.0], [0.04, 0.0]]), 0.01)
    motion = simulate(uniform(square()), PushScenario(pusher, np.zeros(3), pusher.time, force_time=np.array([0.5, 0.8])))
    # At 0.1 m/s the smoothing speed of 1e-4 m/s takes half a millionth of the friction.
    assert (motion.impulse[1] - motion.impulse[0]) / 0.3 == pytest.approx([0.37 * 0.7 * GRAVITY, 0.0], rel=1e-5, abs=1e-5)


def test_flat_face_off_the_middle_pushes_an_object_without_turning_it() -> None:
    disc = straight_push((-0.07, 0.012), 0.0)
    motion = moved(uniform(square()), PusherPath(disc.time, disc.position, 0.0, box(0.008, 0.02)))
    assert abs(moved(uniform(square()), disc).pose[-1, 2]) > 0.1
    assert np.abs(motion.pose[:, 1:]).max() < 1e-6
    steady = (motion.force_time > 0.7) & (motion.force_time < 0.9)
    assert motion.force[steady, 0] == pytest.approx(0.37 * 0.7 * GRAVITY, rel=1e-4)


def test_turning_face_turns_the_object_with_it() -> None:
    """A wide face that swings about its own middle carries the object around: both ends stay in touch."""
    disc = straight_push((-0.09, 0.0), 0.0, travel=0.08)
    yaw = np.interp(disc.time, [disc.time[-1] - 0.6, disc.time[-1] - 0.4], [0.0, 0.1])
    face = PusherPath(disc.time, disc.position, 0.0, box(0.008, 0.04), yaw)
    end = simulate(uniform(square(), pusher_friction=0.5), PushScenario(face, np.zeros(3), np.array([disc.time[-1] - 0.4]))).pose[0]
    assert end[2] == pytest.approx(0.1, abs=1e-3)


def test_push_that_misses_has_a_status_and_a_late_force_prolongs_it() -> None:
    pusher = straight_push((0.5, 0.5), 0.0)
    motion = simulate(hammer(), PushScenario(pusher, np.zeros(3), pusher.time, force_time=np.array([0.1, 9.9])))
    assert motion.status is SolveStatus.NO_CONTACT and np.all(motion.pose == 0)
    assert motion.force_time[-1] > 9.89 and motion.impulse.shape == (2, 2) and motion.impulse_jacobian.shape == (2, 2, 0)


@pytest.mark.parametrize(
    ("polygon", "yaw"),
    [
        ([[0, 0], [0, 1], [1, 0]], None),
        ([[0, 0], [1, 0]], None),
        ([[0, 0], [2, 0], [1, 0.1], [2, 2]], None),
        ([[0, 0], [1, 0], [0, 1]], [0.0, np.nan]),
        ([[0, 0], [1, 0], [0, 1]], [0.0]),
    ],
)
def test_pusher_that_is_no_convex_polygon_is_refused(polygon: list[list[float]], yaw: list[float] | None) -> None:
    with pytest.raises(InputError, match=r"Pusher(Path|Shape)"):
        PusherPath(np.array([0.0, 1.0]), np.zeros((2, 2)), 0.0, np.array(polygon), None if yaw is None else np.array(yaw))


def test_what_cannot_be_simulated_is_refused() -> None:
    shape, pusher, ones = hammer_shape(), straight_push((0.5, 0.5), 0.0), np.ones(70)
    with pytest.raises(InputError, match="not finite"):
        PusherPath(np.array([0.0, 1.0]), np.array([[0.0, np.nan], [0.0, 0.0]]), 0.01)
    with pytest.raises(InputError, match="first pose"):
        simulate(hammer(), PushScenario(pusher, np.array([0.0, np.nan, 0.0]), np.array([1.0])))
    with pytest.raises(InputError, match="impulses must be finite and ascend"):
        PushScenario(pusher, np.zeros(3), np.array([0.2]), force_time=np.array([0.2, 0.1]))
    for mass, friction, word in ((0.0 * ones, ones, "mass > 0"), (ones, -ones, "friction"), (ones[1:], ones[1:], "shape")):
        with pytest.raises(InputError, match=word):
            body_of_cells(shape, mass, friction)
    with pytest.raises(InputError, match="area"):
        ObjectShape(shape.cells, np.array([[0.0, 0.0], [0.1, 0.1], [0.2, 0.2]]))
    with pytest.raises(InputError, match="inside the outline"):
        moved(replace(hammer(), shape=ObjectShape(shape.cells, shape.outline + 1.0)), pusher)
    with pytest.raises(InputError, match="no unique motion"):
        SimulationSettings(friction_cone="pyramid", quasi_static=True)
