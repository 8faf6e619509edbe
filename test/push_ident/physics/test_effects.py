"""Effects beside the base model: no change at their null values, and the signature that each must leave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, square, straight_push, uniform
from helpers.random_pushes import ENGINES, random_case
from push_ident.errors import InputError
from push_ident.physics.effect_values import EffectsLike, driven_path, effect_values
from push_ident.physics.effects import CAUSES, EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, SimulationSettings, cell_gradient, loss_gradient, simulate, simulate_body
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PusherPath

ORDER = 3.0
FINE = SimulationSettings(step=1 / 8000, smoothing_speed=1e-6)
FAR = PusherPath(np.array([0.0, 0.5]), np.full((2, 2), 5.0), 0.01)
"""A pusher that stands out of reach."""
PUSH, TIME = straight_push((-0.07, 0.02), 0.2), np.linspace(0.0, 1.4, 15)
"""Oblique, of a plate about the origin."""
SLOPE, FRICTION = 0.3, 0.1


def plate(friction: float = 0.3, mass: float = 0.5, pusher_friction: float = 0.3, n: int = 5) -> ObjectModel:
    """A square of n x n equal cells, 0.1 m wide, about the origin."""
    return uniform(square(n, 0.1 / n), mass, friction, pusher_friction)


def poses(
    model: ObjectModel,
    effects: EffectsLike | None = None,
    *,
    pusher: PusherPath = PUSH,
    first: object = (0.0, 0.0, 0.0),
    time: object = TIME,
) -> Float64Array:
    return simulate(model, PushScenario(pusher, np.array(first), np.array(time)), effects=effects).pose


def coasted(effects: EffectsLike, time: object, model: ObjectModel | None = None, first: object = (0.0, 0.0, 0.0)) -> Float64Array:
    """Poses of a body that nothing touches."""
    scenario = PushScenario(FAR, np.array(first), np.array(time), ORDER)
    return simulate(model or plate(FRICTION), scenario, settings=FINE, effects=effects).pose


@pytest.mark.parametrize("names", [*((name,) for name in EFFECTS), CAUSES])
def test_an_effect_at_its_null_value_changes_no_bit(names: tuple[str, ...]) -> None:
    for seed in range(4):
        case = random_case(seed, 9 + seed, seed % 2 == 1, 40)
        scenario = PushScenario(case.pusher, case.pose, case.pusher.time, ORDER)
        motion = simulate_body(case.model.shape, case.body, case.model.pusher_friction, scenario, settings=ENGINES["circle"], effects=names)
        assert np.array_equal(motion.pose, case.simulate(ENGINES["circle"]).pose)


@pytest.mark.parametrize(
    ("name", "values", "factor"),
    [
        ("table_tilt", [], lambda x, v: 1.0),
        ("wear", [0.1], lambda x, v: 1.0 + 0.1 * ORDER),
        ("position_dependent_friction", [2.0, 0.0], lambda x, v: 1.0 + 2.0 * x),
        ("speed_dependent_friction", [0.2], lambda x, v: 1.0 + 0.2 * np.log((v + 0.01) / 0.11)),
        ("stribeck_friction", [0.5, 0.1], lambda x, v: 1.0 + 0.5 * np.exp(-((v / 0.1) ** 2))),
        ("table_anisotropy", [0.4, 0.0], lambda x, v: 1.4),
    ],
)
def test_an_untouched_body_slides_downhill_against_the_friction_that_the_effect_leaves(
    name: str, values: list[float], factor: Callable[[float, float], float]
) -> None:
    """x'' = g (slope - friction factor(x, x')), on a single body that does not turn; integrated here on its own."""
    motion = coasted({"table_tilt": [SLOPE, 0.0]} | ({name: values} if values else {}), np.linspace(0.0, 0.5, 6))
    x = v = 0.0
    expected, dt = [0.0], 1e-4
    for n in range(5000):
        v += dt * GRAVITY * (SLOPE - FRICTION * factor(x, v))
        x += dt * v
        if (n + 1) % 1000 == 0:
            expected.append(x)
    assert motion[:, 0] == pytest.approx(np.array(expected), rel=2e-3, abs=1e-5)
    assert np.abs(motion[:, 1:]).max() < 1e-9


def test_a_tilt_below_the_friction_moves_nothing() -> None:
    assert np.abs(poses(plate(), {"table_tilt": [0.2, 0.1]}, pusher=FAR, time=[2.0])).max() < 2e-4
    # Far below it, nothing even creeps, and none of it is computed.
    scenario = PushScenario(FAR, np.zeros(3), np.array([2.0]))
    held = simulate(plate(), scenario, effects={"table_tilt": [0.1, 0.05]}, jacobian=True)
    assert not np.any(held.pose) and np.all(np.isfinite(held.jacobian))


def test_friction_across_the_grain_is_not_along_the_motion() -> None:
    """With E = [[0, b], [b, 0]] a body that slides along x is held back along y as well; a slope of friction times b makes up for that."""
    end = coasted({"table_tilt": [SLOPE, FRICTION * 0.4], "table_anisotropy": [0.0, 0.4]}, [0.5])[-1]
    assert end == pytest.approx([0.5 * GRAVITY * (SLOPE - FRICTION) * 0.25, 0.0, 0.0], rel=5e-3, abs=1e-6)


def turned_push(angle: float, effects: dict[str, list[float]]) -> Float64Array:
    """End of an oblique push whose whole scene is turned by `angle` about the table's origin, turned back."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    end = poses(plate(), effects, pusher=replace(PUSH, position=PUSH.position @ turn.T), first=(0.0, 0.0, angle))[-1]
    return np.r_[turn.T @ end[:2], end[2] - angle]


@pytest.mark.parametrize(
    ("name", "angle", "sign", "is_same"),
    [
        ("table_anisotropy", np.pi, 1.0, True),
        ("table_anisotropy", np.pi / 2, -1.0, True),
        ("table_anisotropy", np.pi / 2, 1.0, False),
        ("base_anisotropy", 0.7, 1.0, True),
        ("table_tilt", np.pi, -1.0, True),
        ("table_tilt", np.pi, 1.0, False),
    ],
)
def test_anisotropy_has_a_period_of_half_a_turn_and_a_tilt_of_a_whole_one(name: str, angle: float, sign: float, is_same: bool) -> None:
    values = np.array([0.02, 0.01] if name == "table_tilt" else [0.2, 0.1])
    difference = np.abs(turned_push(angle, {name: list(sign * values)}) - turned_push(0.0, {name: list(values)})).max()
    assert difference < 1e-9 if is_same else difference > 1e-3


def test_a_tether_makes_a_body_without_friction_swing() -> None:
    stiffness, time = 20.0, np.linspace(0.0, 0.5, 6)
    motion = coasted({"tether": {"stiffness": stiffness, "pull_x": 0.2}}, time, plate(0.0, mass=0.4), (0.05, -0.02, 0.4))
    swing = np.cos(np.sqrt(stiffness / 0.4) * time)
    assert motion[:, 0] == pytest.approx(0.01 + 0.04 * swing, abs=2e-4)
    assert motion[:, 1] == pytest.approx(-0.02 * swing, abs=2e-4)


def test_the_load_goes_ahead_of_the_motion_or_falls_behind_it_with_its_time_constant() -> None:
    """A plate slides along x and rubs to its left, so that a load that goes ahead turns it to its left."""
    slanted = {"table_tilt": [SLOPE, 0.0], "table_anisotropy": [0.0, -0.2]}
    x, _, yaw = coasted(slanted, [0.6])[-1]
    assert x > 0.02 and abs(yaw) < 1e-9
    assert coasted(slanted | {"push_height": [4e-3]}, [0.6])[-1, 2] > 0.01
    turns = [-coasted(slanted | {"moving_contents": [4e-3, tau]}, [0.6])[-1, 2] for tau in (1.0, 0.1, 0.01)]
    assert 0.0 < turns[0] < turns[1] < turns[2] and turns[1] > 0.01


def test_friction_of_the_pusher_and_an_outline_error_are_those_of_another_object() -> None:
    model = plate()
    np.testing.assert_allclose(poses(model, {"pusher_friction": [0.15]}), poses(plate(pusher_friction=0.45)), atol=1e-9)
    # No pusher is smoother than one without friction.
    np.testing.assert_array_equal(poses(model, {"pusher_friction": [-0.35]}), poses(plate(pusher_friction=0.0)))
    larger = replace(model, shape=ObjectShape(model.shape.cells, model.shape.outline * (1.0 + 1e-3 / 0.05)))
    np.testing.assert_allclose(poses(model, {"outline_error": [1e-3]}), poses(larger), atol=1e-9)
    assert np.abs(poses(larger) - poses(model)).max() > 5e-4


@pytest.mark.parametrize("gap", [0.0, 1e-4, 3.3e-4, 5.9e-4])
def test_after_a_head_on_impact_the_body_leaves_at_one_plus_e_times_the_speed(gap: float) -> None:
    pusher = PusherPath(np.array([0.0, 0.2]), np.array([[-0.06 - gap, 0.0], [-0.06 - gap + 0.2 * 0.15, 0.0]]), 0.01)
    struck, nearly, plain = (poses(plate(0.0), {"restitution": [e]} if e else None, pusher=pusher, time=[0.1, 0.2]) for e in (0.4, 1e-9, 0))
    assert (struck[1] - struck[0]) / 0.1 == pytest.approx([0.15 * 1.4, 0.0, 0.0], abs=1e-9)
    assert nearly == pytest.approx(plain, abs=1e-9)


def test_a_lag_is_the_speed_times_its_time_constant_and_fades_and_a_scale_grows_with_travel() -> None:
    dt, tau, speed = 1 / 240, 0.02, 0.15
    time = np.arange(241) * dt
    path = np.zeros((241, 3))
    path[:, 0] = speed * np.minimum(time, 0.5)
    driven, _ = driven_path(effect_values({"pusher_lag": [tau]}), dt, path)
    expected = np.where(time <= 0.5, speed * tau * (1 - np.exp(-time / tau)), speed * tau * np.exp(-(time - 0.5) / tau))
    assert path[:, 0] - driven[:, 0] == pytest.approx(expected, abs=1e-9)
    path = np.cumsum(np.random.default_rng(0).uniform(0, 1e-3, (50, 3)), axis=0)
    driven, _ = driven_path(effect_values({"pusher_speed_scale": [0.1]}), dt, path)
    assert driven[:, :2] - path[:, :2] == pytest.approx(0.1 * (path[:, :2] - path[0, :2]), abs=1e-12)


def test_a_drift_displaces_the_tool_by_as_much_with_every_push() -> None:
    path = np.cumsum(np.random.default_rng(0).uniform(0, 1e-3, (50, 3)), axis=0)
    for order in (0.0, 1.0, 7.0):
        driven, by_value = driven_path(effect_values({"tool_drift": [1e-4, -2e-4]}), 1 / 240, path, order)
        assert driven - path == pytest.approx(np.tile(order * np.array([1e-4, -2e-4, 0.0]), (50, 1)), abs=1e-15)
        assert by_value[:, :, :2] == pytest.approx(order * np.eye(2)[:, None] * np.ones((1, 50, 1)), abs=1e-12)


def test_latency_shows_the_pose_of_an_earlier_time() -> None:
    time = np.linspace(0.3, 1.4, 23)
    assert poses(plate(), {"pose_latency": [0.021]}, time=time) == pytest.approx(poses(plate(), time=time - 0.021), abs=1e-12)


def test_an_offset_of_the_tool_and_one_of_the_camera_are_exact_twins() -> None:
    """The first pose was displaced by the camera as well: the true one differs by as much."""
    first, offset = np.array([0.01, 0.0, 0.2]), [2e-3, -1e-3]
    tool = poses(plate(), {"tool_offset": offset}, first=first)
    assert tool == pytest.approx(poses(plate(), {"camera_translation": offset}, first=first - [*offset, 0.0]), abs=1e-9)


def test_a_turned_and_stretched_camera_reports_similar_positions() -> None:
    pusher, first, angle, kappa = straight_push((0.03, 0.12), 0.2), (0.1, 0.1, 0.2), 0.02, 0.03
    true = poses(plate(), pusher=pusher, first=first)
    reported = poses(plate(), {"camera_scale": [kappa], "camera_rotation": [angle]}, pusher=pusher, first=first)
    z = (true[:, 0] + 1j * true[:, 1]) * (1 + kappa) * np.exp(1j * angle)
    assert reported == pytest.approx(np.column_stack([z.real, z.imag, true[:, 2] + angle]), abs=1e-12)


def test_gradient_of_a_loss_reaches_the_cells_and_the_effects() -> None:
    scenario = PushScenario(PUSH, np.zeros(3), np.linspace(0.5, 1.4, 4))
    effects = effect_values({"table_tilt": {"y": 0.01}, "camera_scale": [0.01]})
    assert effects.labels == ("table_tilt.x", "table_tilt.y", "camera_scale.kappa")
    assert effects.slice_of("camera_scale") == slice(2, 3)
    model = hammer(3)
    gradient = loss_gradient(model, scenario, lambda pose: (0.5 * float(np.sum(pose**2)), pose), effects=effects)
    motion = simulate(model, scenario, effects=effects, jacobian=True)
    expected = np.einsum("fi,fip->p", motion.pose, motion.jacobian)
    by_mass, by_friction = cell_gradient(model.shape, model.mass, model.friction, expected[: 8 + len(model.mass)])
    assert gradient.loss == 0.5 * float(np.sum(motion.pose**2))
    for found, exact in ((gradient.mass, by_mass), (gradient.friction, by_friction), (gradient.effects, expected[-3:])):
        assert np.abs(exact).max() > 1e-4 and found == pytest.approx(exact, rel=1e-8, abs=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize(
    ("effects", "settings", "message"),
    [
        ({"table_tilted": [0.0]}, {}, "'table_tilted', expected some of base_anisotropy"),
        ({"table_tilt": {"z": 0.0}}, {}, "'z', expected some of x, y"),
        ({"table_tilt": [0.0]}, {}, "got 1 values, expected 2"),
        ({"pusher_lag": [-0.1]}, {}, r"pusher_lag\.tau is -0\.1 s, expected 0 to 0\.5"),
        ({"wear": [0.0]}, {"friction_cone": "pyramid"}, "wear needs the circular cone"),
        ({"restitution": [0.1]}, {"quasi_static": True}, "restitution has no meaning"),
    ],
)
def test_effects_that_cannot_be_are_refused(effects: dict[str, object], settings: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate(plate(), PushScenario(PUSH, np.zeros(3), TIME), settings=SimulationSettings(**settings), effects=effects)
