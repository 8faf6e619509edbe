"""Gradients by the cells, quasi-static pushes, polygon pushers, and what the engine refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, hammer_shape, random_push, square, straight_push, uniform
from push_ident.errors import InputError
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import (
    GRAVITY,
    BodyParameters,
    SimulationSettings,
    body_of_cells,
    loss_gradient,
    simulate,
    simulate_body,
)
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath

SETTINGS = {
    "circle": SimulationSettings(),
    "pyramid": SimulationSettings(friction_cone="pyramid"),
    "quasi-static": SimulationSettings(quasi_static=True),
}


def test_gradient_reaches_the_cells() -> None:
    rng = np.random.default_rng(3)
    model, pose = hammer(3), np.array([0.02, -0.05, 0.4])
    pusher = random_push(model.shape, pose, rng)
    time = pusher.time[::9]
    target = simulate(hammer(8), PushScenario(pusher, pose, time)).pose

    def loss(poses: Float64Array) -> tuple[float, Float64Array]:
        return 0.5 * float(np.sum((poses - target) ** 2)), poses - target

    def value(mass: Float64Array, friction: Float64Array) -> float:
        return loss(simulate(ObjectModel(model.shape, mass, friction, model.pusher_friction), PushScenario(pusher, pose, time)).pose)[0]

    gradient = loss_gradient(model, PushScenario(pusher, pose, time), loss)
    assert gradient.loss == value(model.mass, model.friction)
    for cell in (0, 20, 44, 69):
        for kind, exact in (("mass", gradient.mass), ("friction", gradient.friction)):
            values = []
            for sign in (1, -1):
                maps = {"mass": model.mass.copy(), "friction": model.friction.copy()}
                maps[kind][cell] *= 1 + 1e-5 * sign
                values.append(value(**maps))
            differences = (values[0] - values[1]) / (2e-5 * getattr(model, kind)[cell])
            assert exact[cell] == pytest.approx(differences, rel=1e-4, abs=1e-6 * np.abs(exact).max())


def test_quasi_static_push_is_the_limit_of_slow_pushes() -> None:
    model = hammer(4)
    differences = []
    for speed in (0.1, 0.025):
        pusher = straight_push((0.05, -0.09), np.pi / 2, speed=speed, travel=0.09)
        settings = {"step": 0.1 / 240 / speed, "smoothing_speed": 1e-4 * speed}
        dynamic, limit = (
            simulate(
                model, PushScenario(pusher, np.zeros(3), pusher.time[-1:]), settings=SimulationSettings(quasi_static=q, **settings)
            ).pose
            for q in (False, True)
        )
        differences.append(np.abs(dynamic - limit).max())
    assert differences[0] > 1e-5
    assert differences[1] < differences[0] / 4


def test_quasi_static_path_does_not_depend_on_the_speed() -> None:
    model = hammer(2)
    ends = []
    for speed in (0.1, 0.2):
        pusher = straight_push((0.05, -0.09), np.pi / 2, speed=speed, rest=0.04 / speed, rate=600 * speed)
        # Steps of the same length in space; the smoothing is a speed too.
        settings = SimulationSettings(step=0.1 / 240 / speed, smoothing_speed=1e-3 * speed, quasi_static=True)
        ends.append(simulate(model, PushScenario(pusher, np.zeros(3), pusher.time[-1:]), settings=settings).pose)
    assert ends[0] == pytest.approx(ends[1], abs=1e-8)


def test_quasi_static_motion_ignores_the_mass() -> None:
    model = hammer(2)
    body = body_of_cells(model.shape, model.mass, model.friction)
    heavy = BodyParameters(5 * body.mass, body.centre, 3 * body.inertia, body.limit)
    pusher = straight_push((0.05, -0.09), np.pi / 2)
    a, b = (
        simulate_body(model.shape, x, 0.3, PushScenario(pusher, np.zeros(3), pusher.time), settings=SETTINGS["quasi-static"])
        for x in (body, heavy)
    )
    assert a.pose == pytest.approx(b.pose, abs=1e-9)


def test_bar_on_two_feet_turns_about_the_far_one() -> None:
    # Pushed across at p from the middle, two equal feet at +-a: the far foot carries (a - p) / (a + p) of its limit and stays,
    # the near one slides. The bar turns at v / (a + p), and the push needs 2 a f / (a + p).
    a, p, f, speed = 0.05, 0.02, 0.7, 0.05
    shape = ObjectShape(
        CellGrid(np.array([[-a, 0.0], [a, 0.0]]), 0.01), np.array([[-0.06, -0.01], [0.06, -0.01], [0.06, 0.01], [-0.06, 0.01]])
    )
    body = BodyParameters(0.4, np.zeros(2), 1e-3, np.array([f, f]))
    start = np.array([p, -0.01])
    dt = 1e-3
    pusher = PusherPath(np.array([0.0, dt]), np.array([start, start + np.array([0.0, speed * dt])]), 0.0)
    settings = SimulationSettings(step=dt, smoothing_speed=1e-8, quasi_static=True)
    motion = simulate_body(shape, body, 0.0, PushScenario(pusher, np.zeros(3), np.array([dt])), settings=settings)
    assert motion.pose[0, 2] / dt == pytest.approx(speed / (a + p), rel=1e-6)
    assert motion.pose[0, 1] / dt == pytest.approx(speed / (a + p) * a, rel=1e-6)
    assert motion.force[0, 1] == pytest.approx(2 * a * f / (a + p), rel=1e-6)


def test_small_polygon_pushes_as_the_disc_it_rounds() -> None:
    model, pose = hammer(7), np.array([0.05, 0.02, -1.1])
    pusher = random_push(model.shape, pose, np.random.default_rng(7))
    angle = np.arange(6) * np.pi / 3
    core = 1e-7 * np.column_stack([np.cos(angle), np.sin(angle)])
    rounded = PusherPath(pusher.time, pusher.position, pusher.radius, core)
    disc, polygon = (simulate(model, PushScenario(p, pose, pusher.time)).pose for p in (pusher, rounded))
    assert polygon == pytest.approx(disc, abs=1e-5)


def test_flat_face_off_the_middle_pushes_an_object_without_turning_it() -> None:
    model = uniform(square())
    disc = straight_push((-0.07, 0.012), 0.0)
    box = np.array([[-0.008, -0.02], [0.008, -0.02], [0.008, 0.02], [-0.008, 0.02]])
    face = PusherPath(disc.time, disc.position, 0.0, box)
    time = disc.time
    turned = simulate(model, PushScenario(disc, np.zeros(3), time)).pose[-1, 2]
    motion = simulate(model, PushScenario(face, np.zeros(3), time))
    assert abs(turned) > 0.1
    assert np.abs(motion.pose[:, 1:]).max() < 1e-6
    steady = (motion.force_time > 0.7) & (motion.force_time < 0.9)
    assert motion.force[steady, 0] == pytest.approx(0.37 * 0.7 * GRAVITY, rel=1e-4)


def test_line_contact_slides_by_the_friction_of_both_ends() -> None:
    # As the closed form of a single contact: a body that cannot turn leaves with u_t = mu u_n, du_t / dmu = u_n.
    shape, mu, speed = square(), 0.23, np.array([0.4, 0.31])
    body = BodyParameters(0.7, np.zeros(2), 1e9, np.zeros(len(shape.cells)))
    dt = 1 / 240
    box = np.array([[-0.02, -0.01], [0.02, -0.01], [0.02, 0.01], [-0.02, 0.01]])
    start = np.array([0.003, -0.045 - 0.01])
    pusher = PusherPath(np.array([0.0, dt]), np.array([start, start + dt * speed]), 0.0, box)
    motion = simulate_body(shape, body, mu, PushScenario(pusher, np.zeros(3), np.array([dt])), jacobian=True)
    assert motion.pose[0] / dt == pytest.approx([mu * speed[1], speed[1], 0.0], rel=1e-9, abs=1e-9)
    assert motion.jacobian[0, :, 7] / dt == pytest.approx([speed[1], 0.0, 0.0], rel=1e-9, abs=1e-9)


def test_turning_face_turns_the_object_with_it() -> None:
    # A wide face that swings about its own middle carries the object around: both ends stay in touch.
    model = uniform(square(), pusher_friction=0.5)
    disc = straight_push((-0.09, 0.0), 0.0, travel=0.08)
    box = np.array([[-0.008, -0.04], [0.008, -0.04], [0.008, 0.04], [-0.008, 0.04]])
    yaw = np.interp(disc.time, [disc.time[-1] - 0.6, disc.time[-1] - 0.4], [0.0, 0.1])
    motion = simulate(
        model, PushScenario(PusherPath(disc.time, disc.position, 0.0, box, yaw), np.zeros(3), np.array([disc.time[-1] - 0.4]))
    )
    assert motion.pose[0, 2] == pytest.approx(0.1, abs=1e-3)


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
    with pytest.raises(InputError, match="PusherPath"):
        PusherPath(np.array([0.0, 1.0]), np.zeros((2, 2)), 0.0, np.array(polygon), None if yaw is None else np.array(yaw))


def test_path_that_is_not_finite_is_refused() -> None:
    with pytest.raises(InputError, match="not finite"):
        PusherPath(np.array([0.0, 1.0]), np.array([[0.0, np.nan], [0.0, 0.0]]), 0.01)


@pytest.mark.parametrize(
    ("n_less", "mass", "friction", "message"), [(0, 0.0, 0.3, "mass > 0"), (0, 0.01, -0.3, "friction"), (1, 0.01, 0.3, "shape")]
)
def test_cells_without_mass_or_with_negative_friction_are_refused(n_less: int, mass: float, friction: float, message: str) -> None:
    shape = hammer_shape()
    n = len(shape.cells) - n_less
    with pytest.raises(InputError, match=message):
        body_of_cells(shape, np.full(n, mass), np.full(n, friction))


def test_outline_without_area_or_away_from_the_cells_is_refused() -> None:
    shape = hammer_shape()
    with pytest.raises(InputError, match="area"):
        ObjectShape(shape.cells, np.array([[0.0, 0.0], [0.1, 0.1], [0.2, 0.2]]))
    elsewhere = replace(hammer(), shape=ObjectShape(shape.cells, shape.outline + 1.0))
    pusher = straight_push((0.5, 0.5), 0.0)
    with pytest.raises(InputError, match="inside the outline"):
        simulate(elsewhere, PushScenario(pusher, np.zeros(3), pusher.time))
