"""Adjoint gradients, quasi-static pushes, polygon pushers, and what the engine refuses."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import hammer, hammer_shape, random_push, square, straight_push, uniform
from push_ident.errors import InputError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import (
    GRAVITY,
    BodyParameters,
    SimulationSettings,
    body_of_cells,
    loss_gradient,
    simulate,
    simulate_body,
    simulate_body_with_pullback,
)
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

SETTINGS = {
    "circle": SimulationSettings(),
    "pyramid": SimulationSettings(friction_cone="pyramid"),
    "quasi-static": SimulationSettings(quasi_static=True),
}


def box_push(pusher: PusherPath, rng: np.random.Generator) -> PusherPath:
    """The same push with a box of 12 x 30 mm that stands up to 0.4 rad askew and turns by up to 0.5 rad on its way."""
    half_depth, half_width = 0.006, 0.015
    box = np.array([[-half_depth, -half_width], [half_depth, -half_width], [half_depth, half_width], [-half_depth, half_width]])
    along = pusher.position[-1] - pusher.position[0]
    along = along / np.linalg.norm(along)
    share = np.clip((pusher.time - 0.4) / (pusher.time[-1] - 0.8), 0.0, 1.0)
    yaw = np.arctan2(along[1], along[0]) + rng.uniform(-0.4, 0.4) + rng.uniform(-0.5, 0.5) * share
    return PusherPath(pusher.time, pusher.position - (half_depth + 0.012) * along, rng.choice([0.0, 0.003]), box, yaw)


def depth(model: ObjectModel, pusher: PusherPath, time: Float64Array, poses: Float64Array) -> Float64Array:
    """Least distance between pusher and outline at each time [m], shape (n_frames,); negative where they overlap."""
    at = np.column_stack([np.interp(time, pusher.time, pusher.position[:, axis]) for axis in (0, 1)])
    yaw = np.zeros(len(time)) if pusher.yaw is None else np.interp(time, pusher.time, pusher.yaw)
    core = np.zeros((1, 2)) if pusher.polygon is None else pusher.polygon
    least = []
    for pose, place, angle in zip(poses, at, yaw, strict=True):
        corners = transform_points(inverse(pose), transform_points(np.array([*place, angle]), core))
        gap = signed_distance(corners, model.shape.outline).min()
        if len(corners) > 2:
            gap = min(gap, signed_distance(model.shape.outline, corners).min())
        least.append(gap - pusher.radius)
    return np.array(least)


def random_case(seed: int, box: bool) -> tuple[ObjectModel, PusherPath, Float64Array]:
    """A hammer, and a push that starts clear of it."""
    rng = np.random.default_rng(seed)
    model = hammer(seed, pusher_friction=rng.uniform(0.05, 0.8))
    while True:
        pose = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-3, 3)])
        pusher = random_push(model.shape, pose, rng)
        pusher = box_push(pusher, rng) if box else pusher
        if depth(model, pusher, pusher.time[:1], pose[None])[0] > 0:
            return model, pusher, pose


@pytest.mark.parametrize("box", [False, True])
@pytest.mark.parametrize("mode", SETTINGS)
def test_adjoint_equals_jacobian(mode: str, box: bool) -> None:
    for seed in range(6):
        model, pusher, pose = random_case(seed, box)
        body = body_of_cells(model.shape, model.mass, model.friction)
        arguments = (model.shape, body, model.pusher_friction, PushScenario(pusher, pose, pusher.time[::7]))
        jacobian = simulate_body(*arguments, settings=SETTINGS[mode], jacobian=True).jacobian
        motion, pull_back = simulate_body_with_pullback(*arguments, settings=SETTINGS[mode])
        by_pose = np.random.default_rng(seed).normal(size=motion.pose.shape)
        expected = np.einsum("fi,fip->p", by_pose, jacobian)
        assert pull_back(by_pose) == pytest.approx(expected, rel=1e-10, abs=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("box", [False, True])
@pytest.mark.parametrize("mode", SETTINGS)
def test_every_derivative_equals_central_differences(mode: str, box: bool) -> None:
    # A perturbation that carries a switch of contact over a step makes the differences unreliable; two step lengths tell.
    errors, sure = [], []
    for seed in range(5):
        model, pusher, pose = random_case(seed, box)
        body = body_of_cells(model.shape, model.mass, model.friction)
        point = np.r_[pose, body.mass, body.centre, body.inertia, model.pusher_friction, body.limit]
        scale = np.r_[0.1, 0.1, 1.0, body.mass, 0.1, 0.1, body.inertia, 0.25, body.limit]
        time = np.linspace(pusher.time[0], pusher.time[-1], 7)

        def poses(q: Float64Array, model=model, pusher=pusher, time=time) -> Float64Array:
            body = BodyParameters(q[3], q[4:6], q[6], q[8:])
            return simulate_body(model.shape, body, q[7], PushScenario(pusher, q[:3], time), settings=SETTINGS[mode]).pose

        exact = (
            simulate_body(
                model.shape, body, model.pusher_friction, PushScenario(pusher, pose, time), settings=SETTINGS[mode], jacobian=True
            ).jacobian
            * scale
        )
        for column in [*range(8), 8, 31, 60, 77]:
            long, short = (
                (
                    poses(point + h * scale * (np.arange(len(point)) == column))
                    - poses(point - h * scale * (np.arange(len(point)) == column))
                )
                / (2 * h)
                for h in (6e-6, 3e-6)
            )
            size = max(np.abs(exact[:, :, column]).max(), 1e-3)
            errors.append(np.abs(exact[:, :, column] - (4 * short - long) / 3).max() / size)
            sure.append(np.abs(long - short).max() / size < 1e-6)
    assert np.mean(sure) > 0.6
    assert np.max(np.array(errors)[sure]) < 5e-6
    assert np.median(errors) < 1e-6


def test_gradient_reaches_the_cells() -> None:
    model, pusher, pose = random_case(3, False)
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


@pytest.mark.parametrize("box", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_pusher_and_object_never_overlap(seed: int, box: bool) -> None:
    model, pusher, pose = random_case(1000 + seed, box)
    time = np.arange(pusher.time[0], pusher.time[-1], 1 / 120)
    motion = simulate(model, PushScenario(pusher, pose, time))
    assert motion.status is SolveStatus.CONVERGED
    assert depth(model, pusher, time, motion.pose).min() > -1e-4


@pytest.mark.parametrize("mode", SETTINGS)
def test_object_does_not_drift_before_and_after_a_push(mode: str) -> None:
    model, pusher, pose = random_case(5, False)
    time = np.array([0.0, 0.02, pusher.time[-1] - 0.2, pusher.time[-1]])
    first, before, after, last = simulate(model, PushScenario(pusher, pose, time), settings=SETTINGS[mode]).pose
    assert np.array_equal(first, before)
    assert np.array_equal(after, last)


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
    model, pusher, pose = random_case(7, False)
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
    assert depth(model, face, time, motion.pose).min() > -1e-6
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


def test_cells_without_mass_or_with_negative_friction_are_refused() -> None:
    shape = hammer_shape()
    n = len(shape.cells)
    with pytest.raises(InputError, match="mass > 0"):
        body_of_cells(shape, np.zeros(n), np.full(n, 0.3))
    with pytest.raises(InputError, match="friction"):
        body_of_cells(shape, np.full(n, 0.01), np.full(n, -0.3))
    with pytest.raises(InputError, match="shape"):
        body_of_cells(shape, np.full(n - 1, 0.01), np.full(n, 0.3))


def test_outline_without_area_or_away_from_the_cells_is_refused() -> None:
    shape = hammer_shape()
    with pytest.raises(InputError, match="area"):
        ObjectShape(shape.cells, np.array([[0.0, 0.0], [0.1, 0.1], [0.2, 0.2]]))
    elsewhere = ObjectShape(shape.cells, shape.outline + 1.0)
    n = len(shape.cells)
    model = ObjectModel(elsewhere, np.full(n, 0.01), np.full(n, 0.3), 0.3)
    pusher = straight_push((0.5, 0.5), 0.0)
    with pytest.raises(InputError, match="inside the outline"):
        simulate(model, PushScenario(pusher, np.zeros(3), pusher.time))
