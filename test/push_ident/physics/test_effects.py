"""Effects beside the base model: nothing at their null values, exact derivatives elsewhere, and the signature that each must leave."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from helpers.differences import compare_columns, ridders
from helpers.objects import straight_push
from helpers.random_pushes import ENGINES, Case, random_case, steps_of
from push_ident.errors import InputError
from push_ident.geometry.outline import outline_of_cells
from push_ident.physics.effect import EffectParameter
from push_ident.physics.effect_values import EffectValues, driven_path, effect_values
from push_ident.physics.effects import EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import (
    GRAVITY,
    BodyParameters,
    Motion,
    SimulationSettings,
    loss_gradient,
    simulate,
    simulate_body,
    simulate_body_with_pullback,
)
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

CATALOGUE = {
    "table_anisotropy", "base_anisotropy", "speed_dependent_friction", "stribeck_friction", "position_dependent_friction", "table_tilt",
    "pusher_friction", "push_height", "moving_contents", "tether", "restitution", "outline_error", "pusher_lag", "pusher_speed_scale",
    "pose_latency", "tool_offset", "camera_translation", "camera_rotation", "camera_scale", "wear",
}  # fmt: skip
ORDER = 3.0
FINE = SimulationSettings(step=1 / 8000, smoothing_speed=1e-6)
FAR = PusherPath(np.array([0.0, 0.5]), np.full((2, 2), 5.0), 0.01)
"""A pusher that stands out of reach."""


def plate(n: int = 5, size: float = 0.02, mass: float = 0.5, friction: float = 0.3, pusher_friction: float = 0.3) -> ObjectModel:
    """A square of n x n equal cells about the origin."""
    centres = size * (np.array([(i, j) for i in range(n) for j in range(n)]) - (n - 1) / 2)
    shape = ObjectShape(CellGrid(centres, size), outline_of_cells(centres, size))
    return ObjectModel(shape, np.full(n * n, mass / n**2), np.full(n * n, friction), pusher_friction)


def some_values(names: tuple[str, ...], rng: np.random.Generator) -> EffectValues:
    """Values of about the typical size, off their null values and within their ranges; a latency shorter than these short pushes."""
    values = []
    for name in names:
        for p in EFFECTS[name].parameters:
            size = 0.2 * p.typical if name == "pose_latency" else p.typical
            sign = 1.0 if p.low == 0.0 else rng.choice([-1.0, 1.0])
            values.append(p.nominal + sign * size * rng.uniform(0.3, 0.7))
    return effect_values(names).with_values(values)


def push(case: Case, effects: EffectValues | tuple[str, ...], mode: str, *, jacobian: bool = False) -> Motion:
    return simulate_body(
        case.model.shape,
        case.body,
        case.model.pusher_friction,
        PushScenario(case.pusher, case.pose, case.pusher.time, ORDER),
        settings=ENGINES[mode],
        effects=effects,
        jacobian=jacobian,
    )


def test_the_catalogue_is_whole() -> None:
    assert {name for name, effect in EFFECTS.items() if not effect.needs_forces} == CATALOGUE
    assert {name for name, effect in EFFECTS.items() if effect.needs_forces} == {"force_delay", "force_offset", "force_scale"}


@pytest.mark.parametrize("name", [*sorted(EFFECTS), "all"])
def test_an_effect_at_its_null_value_changes_no_bit(name: str) -> None:
    names = tuple(sorted(CATALOGUE)) if name == "all" else (name,)
    for seed in range(4):
        case = random_case(seed, 9 + seed, seed % 2 == 1, 40)
        assert np.array_equal(push(case, names, "circle").pose, case.simulate(ENGINES["circle"]).pose)


def compare(case: Case, effects: EffectValues, mode: str) -> tuple[set[str], Float64Array, Float64Array, Float64Array]:
    """Kinds of contact; relative error of each column of the Jacobian, its uncertainty, and the error of the adjoint.

    As `test_proof_derivatives.compare`, with effects: a column is measured against a hundredth of the motion at least.
    """
    motion = push(case, effects, mode, jacobian=True)
    assert motion.status is not SolveStatus.SIMULATION_FAILED
    _, pull_back = simulate_body_with_pullback(
        case.model.shape,
        case.body,
        case.model.pusher_friction,
        PushScenario(case.pusher, case.pose, case.pusher.time, ORDER),
        settings=ENGINES[mode],
        effects=effects,
    )
    by_pose = np.random.default_rng(1).normal(size=motion.pose.shape)
    terms = np.abs(by_pose[:, :, None] * motion.jacobian).sum(axis=(0, 1))
    adjoint = np.abs(pull_back(by_pose) - np.einsum("fi,fip->p", by_pose, motion.jacobian)) / (terms + 1e-6 * terms.max())

    body, n_cells = case.body, len(case.body.limit)
    point = np.r_[case.pose, body.mass, body.centre, body.inertia, case.model.pusher_friction, body.limit, effects.values]
    typical = [p.typical for p in effects.parameters]
    scale = np.r_[0.05, 0.05, 1.0, body.mass, 0.05, 0.05, body.inertia, 0.5, np.full(n_cells, body.limit.mean()), typical]

    def poses(q: Float64Array) -> Float64Array:
        moved = BodyParameters(q[3], q[4:6], q[6], q[8 : 8 + n_cells])
        scenario = PushScenario(case.pusher, q[:3], case.pusher.time, ORDER)
        acting = effects.with_values(q[8 + n_cells :])
        return simulate_body(case.model.shape, moved, q[7], scenario, settings=ENGINES[mode], effects=acting).pose

    travel = float(np.abs(motion.pose - case.pose).max())
    errors, doubts = compare_columns(poses, motion.jacobian, point, scale, n_body=8 + n_cells, whole=travel)
    return {step.kind for step in steps_of(case, motion)}, errors, doubts, adjoint


def check_derivatives(names: tuple[str, ...], mode: str, seeds: range) -> Counter[str]:
    """Compare all columns; returns how many columns of effects were compared, by what the contact did."""
    compared: Counter[str] = Counter()
    worst = worst_adjoint = 0.0
    doubtful = total = 0
    for seed in seeds:
        case = random_case(seed, 9 + seed % 7, seed % 2 == 1, 5)
        effects = some_values(names, np.random.default_rng(seed))
        kinds, errors, doubts, adjoint = compare(case, effects, mode)
        # Differences that straddle a switch of the contact prove nothing; they are few, and counted.
        sure = doubts < 1e-7
        worst, worst_adjoint = max(worst, float(errors[sure].max())), max(worst_adjoint, float(adjoint.max()))
        doubtful, total = doubtful + int(np.sum(~sure)), total + len(sure)
        own = sure[-len(effects) :]
        for kind in kinds:
            compared[kind] += int(np.sum(own))
    print(f"{names}, {mode}: error {worst:.1e}, adjoint {worst_adjoint:.1e}, {total - doubtful} of {total} columns, {dict(compared)}")
    assert worst <= 1e-6
    # Rounding: the largest of 24 seeds was 1.2e-10. A cell of the pyramid that sticks costs more digits, with effects and without.
    assert worst_adjoint <= (1e-8 if mode == "pyramid" else 1e-10)
    assert doubtful <= 0.1 * total
    return compared


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_all_derivatives_are_exact_while_an_effect_acts(name: str) -> None:
    compared = check_derivatives((name,), "circle", range(4))
    assert compared["sticking"] and compared["sliding"]


@pytest.mark.parametrize("mode", ["circle", "quasi-static", "pyramid"])
def test_all_derivatives_are_exact_while_all_effects_act_at_once(mode: str) -> None:
    on_table = {name for name in CATALOGUE if type(EFFECTS[name].acts).__name__ == "OnTable"}
    left_out = {"circle": set(), "quasi-static": {"restitution"}, "pyramid": on_table}[mode]
    check_derivatives(tuple(sorted(CATALOGUE - left_out)), mode, range(3))


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_derivatives_are_exact_at_the_null_value_where_absence_is_tested(name: str) -> None:
    null = effect_values((name,))
    compared = 0
    for seed in range(4):
        case = random_case(seed, 9 + seed, seed % 2 == 1, 5)
        # Frames between the steps' ends: there, a latency meets no kink.
        time = case.pusher.time[:-1] + 0.4 * (case.pusher.time[1] - case.pusher.time[0])

        def simulated(effects: EffectValues, jacobian: bool = False, case: Case = case, time: Float64Array = time) -> Motion:
            return simulate_body(
                case.model.shape,
                case.body,
                case.model.pusher_friction,
                PushScenario(case.pusher, case.pose, time, ORDER),
                settings=ENGINES["circle"],
                effects=effects,
                jacobian=jacobian,
            )

        exact = simulated(null, jacobian=True)
        for k, p in enumerate(null.parameters):

            def poses(h: float, k: int = k, p: EffectParameter = p) -> Float64Array:
                return simulated(null.with_values(null.values + h * p.typical * np.eye(len(null))[k])).pose

            # A small friction coefficient of the pusher leaves no room below it.
            one_sided = p.low == p.nominal or (name == "pusher_friction" and case.model.pusher_friction < 1e-3)
            estimate, uncertain = ridders(poses, 1e-3, one_sided=one_sided)
            column = exact.jacobian[:, :, 8 + len(case.body.limit) + k] * p.typical
            size = max(float(np.abs(column).max()), 1e-2 * float(np.abs(exact.pose - case.pose).max()), 1e-9)
            if uncertain < 1e-7 * size:
                compared += 1
                assert np.abs(column - estimate).max() <= 1e-6 * size
    assert compared >= 3


# Signatures ----------------------------------------------------------------------------------------------------------------------


SLOPE, FRICTION = 0.3, 0.1


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
    # x'' = g (slope - friction factor(x, x')), on a single body that does not turn; integrated here on its own.
    model = plate(friction=FRICTION)
    effects = {"table_tilt": [SLOPE, 0.0]} | ({name: values} if values else {})
    time = np.linspace(0.0, 0.5, 6)
    motion = simulate(model, PushScenario(FAR, np.zeros(3), time, ORDER), settings=FINE, effects=effects)
    x = v = 0.0
    expected, dt = [0.0], 1e-5
    for n in range(50000):
        v += dt * GRAVITY * (SLOPE - FRICTION * factor(x, v))
        x += dt * v
        if (n + 1) % 10000 == 0:
            expected.append(x)
    assert motion.pose[:, 0] == pytest.approx(np.array(expected), rel=2e-3, abs=1e-6)
    assert np.abs(motion.pose[:, 1:]).max() < 1e-9


def test_a_tilt_below_the_friction_moves_nothing() -> None:
    motion = simulate(plate(friction=0.3), PushScenario(FAR, np.zeros(3), np.array([2.0])), effects={"table_tilt": [0.2, 0.1]})
    assert np.abs(motion.pose).max() < 2e-4
    # Far below it, nothing even creeps, and none of it is computed.
    held = simulate(
        plate(friction=0.3), PushScenario(FAR, np.zeros(3), np.array([2.0])), effects={"table_tilt": [0.1, 0.05]}, jacobian=True
    )
    assert not np.any(held.pose) and np.all(np.isfinite(held.jacobian))


def test_friction_across_the_grain_is_not_along_the_motion() -> None:
    # With E = [[0, b], [b, 0]] a body that slides along x is held back along y as well; a slope of friction times b makes up for that.
    effects = {"table_tilt": [SLOPE, FRICTION * 0.4], "table_anisotropy": [0.0, 0.4]}
    motion = simulate(plate(friction=FRICTION), PushScenario(FAR, np.zeros(3), np.array([0.5])), settings=FINE, effects=effects)
    assert motion.pose[-1] == pytest.approx([0.5 * GRAVITY * (SLOPE - FRICTION) * 0.25, 0.0, 0.0], rel=5e-3, abs=1e-6)


def turned_push(angle: float, effects: dict[str, list[float]]) -> Float64Array:
    """End of an oblique push whose whole scene is turned by `angle` about the table's origin, turned back."""
    model = plate()
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    straight = straight_push((-0.07, 0.02), 0.3)
    pusher = replace(straight, position=straight.position @ turn.T)
    end = simulate(model, PushScenario(pusher, np.array([0.0, 0.0, angle]), pusher.time[-1:]), effects=effects).pose[-1]
    return np.r_[turn.T @ end[:2], end[2] - angle]


def test_anisotropy_of_the_table_has_a_period_of_half_a_turn_and_that_of_the_base_follows_the_object() -> None:
    table = {"table_anisotropy": [0.2, 0.1]}
    base = turned_push(0.0, table)
    assert turned_push(np.pi, table) == pytest.approx(base, abs=1e-9)
    assert turned_push(np.pi / 2, {"table_anisotropy": [-0.2, -0.1]}) == pytest.approx(base, abs=1e-9)
    assert np.abs(turned_push(np.pi / 2, table) - base).max() > 1e-3
    assert turned_push(0.7, {"base_anisotropy": [0.2, 0.1]}) == pytest.approx(turned_push(0.0, {"base_anisotropy": [0.2, 0.1]}), abs=1e-9)


def test_a_tilt_has_a_period_of_a_whole_turn() -> None:
    tilt = {"table_tilt": [0.02, 0.01]}
    assert turned_push(np.pi, {"table_tilt": [-0.02, -0.01]}) == pytest.approx(turned_push(0.0, tilt), abs=1e-9)
    assert np.abs(turned_push(np.pi, tilt) - turned_push(0.0, tilt)).max() > 1e-3


def test_a_tether_makes_a_body_without_friction_swing() -> None:
    model, stiffness = plate(friction=0.0, mass=0.4), 20.0
    pose, time = np.array([0.05, -0.02, 0.4]), np.linspace(0.0, 0.5, 6)
    motion = simulate(model, PushScenario(FAR, pose, time), settings=FINE, effects={"tether": {"stiffness": stiffness, "pull_x": 0.2}})
    swing = np.cos(np.sqrt(stiffness / 0.4) * time)
    assert motion.pose[:, 0] == pytest.approx(0.01 + 0.04 * swing, abs=2e-4)
    assert motion.pose[:, 1] == pytest.approx(-0.02 * swing, abs=2e-4)


SLANTED = {"table_tilt": [SLOPE, 0.0], "table_anisotropy": [0.0, -0.2]}
"""A plate slides along x and rubs to its left, so that a load that goes ahead turns it to its left."""


@pytest.mark.parametrize("name", ["push_height", "moving_contents"])
def test_the_load_goes_ahead_of_the_motion_or_falls_behind_it(name: str) -> None:
    value = [4e-3] if name == "push_height" else [4e-3, 0.05]
    model, time = plate(friction=FRICTION), np.array([0.6])
    plain = simulate(model, PushScenario(FAR, np.zeros(3), time), settings=FINE, effects=SLANTED)
    motion = simulate(model, PushScenario(FAR, np.zeros(3), time), settings=FINE, effects=SLANTED | {name: value})
    assert plain.pose[-1, 0] > 0.02
    assert abs(plain.pose[-1, 2]) < 1e-9
    assert (1.0 if name == "push_height" else -1.0) * motion.pose[-1, 2] > 0.01


def test_a_shift_moves_the_centre_of_friction_of_any_map_along_the_motion() -> None:
    # Where nothing turns, friction at a centre that went ahead along the motion has the torque that it had.
    model, time = plate(15, 0.1 / 15, friction=FRICTION), np.array([0.6])
    x, y = model.shape.cells.centres.T
    weight = 1.0 + 0.9 * np.sign(x * y)
    model = replace(model, mass=0.5 * weight / np.sum(weight))
    plain = simulate(model, PushScenario(FAR, np.zeros(3), time), settings=FINE, effects={"table_tilt": [SLOPE, 0.0]})
    ahead = simulate(
        model, PushScenario(FAR, np.zeros(3), time), settings=FINE, effects={"table_tilt": [SLOPE, 0.0], "push_height": [4e-3]}
    )
    assert plain.pose[-1, 0] > 0.02
    # Cells have an extent of their own, which their centres do not show.
    assert ahead.pose[-1] == pytest.approx(plain.pose[-1], abs=5e-3)


def test_contents_fall_behind_with_their_time_constant() -> None:
    def turn(tau: float) -> float:
        effects = SLANTED | {"moving_contents": [4e-3, tau]}
        return float(
            simulate(plate(friction=FRICTION), PushScenario(FAR, np.zeros(3), np.array([0.3])), settings=FINE, effects=effects).pose[-1, 2]
        )

    assert abs(turn(1.0)) < abs(turn(0.1)) < abs(turn(0.01))


def test_a_pusher_with_excess_friction_is_a_rougher_pusher() -> None:
    rough = plate(pusher_friction=0.45)
    pusher, time = straight_push((-0.07, 0.03), 0.4), np.linspace(0.0, 1.4, 15)
    seen = simulate(plate(pusher_friction=0.3), PushScenario(pusher, np.zeros(3), time), effects={"pusher_friction": [0.15]})
    assert seen.pose == pytest.approx(simulate(rough, PushScenario(pusher, np.zeros(3), time)).pose, abs=1e-9)


def test_no_pusher_is_smoother_than_one_without_friction() -> None:
    pusher, time = straight_push((-0.07, 0.03), 0.4), np.linspace(0.0, 1.4, 15)
    smooth = simulate(plate(pusher_friction=0.0), PushScenario(pusher, np.zeros(3), time))
    below = simulate(plate(pusher_friction=0.3), PushScenario(pusher, np.zeros(3), time), effects={"pusher_friction": [-0.35]})
    np.testing.assert_array_equal(below.pose, smooth.pose)


def test_an_outline_error_is_a_larger_object() -> None:
    model, pusher, time = plate(), straight_push((-0.075, 0.03), 0.4), np.linspace(0.0, 1.4, 15)
    larger = ObjectShape(model.shape.cells, model.shape.outline * (1.0 + 1e-3 / 0.05))
    seen = simulate(model, PushScenario(pusher, np.zeros(3), time), effects={"outline_error": [1e-3]})
    assert np.abs(seen.pose - simulate(model, PushScenario(pusher, np.zeros(3), time)).pose).max() > 5e-4
    assert seen.pose == pytest.approx(simulate(replace(model, shape=larger), PushScenario(pusher, np.zeros(3), time)).pose, abs=1e-9)


@pytest.mark.parametrize("gap", [0.0, 1e-4, 3.3e-4, 5.9e-4])
def test_after_a_head_on_impact_the_body_leaves_at_one_plus_e_times_the_speed(gap: float) -> None:
    model = plate(friction=0.0)
    pusher = PusherPath(np.array([0.0, 0.2]), np.array([[-0.06 - gap, 0.0], [-0.06 - gap + 0.2 * 0.15, 0.0]]), 0.01)
    time = np.array([0.1, 0.2])
    end = simulate(model, PushScenario(pusher, np.zeros(3), time), effects={"restitution": [0.4]}).pose
    assert (end[1] - end[0]) / 0.1 == pytest.approx([0.15 * 1.4, 0.0, 0.0], abs=1e-9)
    nearly = simulate(model, PushScenario(pusher, np.zeros(3), time), effects={"restitution": [1e-9]}).pose
    assert nearly == pytest.approx(simulate(model, PushScenario(pusher, np.zeros(3), time)).pose, abs=1e-9)


def test_a_lag_is_the_speed_times_its_time_constant_and_fades_at_the_stop() -> None:
    dt, tau, speed = 1 / 240, 0.02, 0.15
    way = np.zeros((241, 3))
    way[:, 0] = speed * np.minimum(np.arange(241) * dt, 0.5)
    driven, _ = driven_path(effect_values({"pusher_lag": [tau]}), dt, way)
    behind = way[:, 0] - driven[:, 0]
    time = np.arange(241) * dt
    expected = np.where(time <= 0.5, speed * tau * (1 - np.exp(-time / tau)), speed * tau * np.exp(-(time - 0.5) / tau))
    assert behind == pytest.approx(expected, abs=1e-9)


def test_latency_shows_the_pose_of_an_earlier_time() -> None:
    model, pusher = plate(), straight_push((-0.07, 0.02), 0.2)
    time = np.linspace(0.3, 1.4, 23)
    seen = simulate(model, PushScenario(pusher, np.zeros(3), time), effects={"pose_latency": [0.021]})
    assert seen.pose == pytest.approx(simulate(model, PushScenario(pusher, np.zeros(3), time - 0.021)).pose, abs=1e-12)


def test_error_of_a_speed_scale_grows_with_travel() -> None:
    dt, way = 1 / 240, np.cumsum(np.random.default_rng(0).uniform(0, 1e-3, (50, 3)), axis=0)
    driven, _ = driven_path(effect_values({"pusher_speed_scale": [0.1]}), dt, way)
    assert driven[:, :2] - way[:, :2] == pytest.approx(0.1 * (way[:, :2] - way[0, :2]), abs=1e-12)


def test_an_offset_of_the_tool_and_one_of_the_camera_are_exact_twins() -> None:
    model, pusher, offset = plate(), straight_push((-0.07, 0.02), 0.2), np.array([2e-3, -1e-3])
    time, first = pusher.time[::6], np.array([0.01, 0.0, 0.2])
    tool = simulate(model, PushScenario(pusher, first, time), effects={"tool_offset": offset})
    # The camera saw the first pose displaced as well: the true one is that much off.
    camera = simulate(model, PushScenario(pusher, first - [*offset, 0.0], time), effects={"camera_translation": offset})
    assert tool.pose == pytest.approx(camera.pose, abs=1e-9)


def test_a_turned_and_stretched_camera_reports_similar_positions() -> None:
    model, pusher = plate(), straight_push((0.03, 0.12), 0.2)
    time, first, angle, kappa = pusher.time[::6], np.array([0.1, 0.1, 0.2]), 0.02, 0.03
    true = simulate(model, PushScenario(pusher, first, time)).pose
    seen = simulate(model, PushScenario(pusher, first, time), effects={"camera_scale": [kappa], "camera_rotation": [angle]}).pose
    z = (true[:, 0] + 1j * true[:, 1]) * (1 + kappa) * np.exp(1j * angle)
    assert seen == pytest.approx(np.column_stack([z.real, z.imag, true[:, 2] + angle]), abs=1e-12)


# The Python face -----------------------------------------------------------------------------------------------------------------


def test_gradient_of_a_loss_has_the_effects() -> None:
    model, pusher, time = plate(), straight_push((-0.07, 0.02), 0.2), np.linspace(0.5, 1.4, 4)
    effects = effect_values({"table_tilt": {"y": 0.01}, "camera_scale": [0.01]})
    assert effects.labels == ("table_tilt.x", "table_tilt.y", "camera_scale.kappa")
    assert effects.slice_of("camera_scale") == slice(2, 3)
    gradient = loss_gradient(
        model, PushScenario(pusher, np.zeros(3), time), lambda pose: (float(pose.sum()), np.ones_like(pose)), effects=effects
    )
    motion = simulate(model, PushScenario(pusher, np.zeros(3), time), effects=effects, jacobian=True)
    assert gradient.effects == pytest.approx(motion.jacobian[:, :, -3:].sum(axis=(0, 1)), rel=1e-9)


@pytest.mark.parametrize(
    ("effects", "settings", "message"),
    [
        ({"table_tilted": [0.0]}, {}, "no effect 'table_tilted', expected some of base_anisotropy"),
        ({"table_tilt": {"z": 0.0}}, {}, "no parameter 'z', expected some of x, y"),
        ({"table_tilt": [0.0]}, {}, "got 1 values, expected 2"),
        ({"pusher_lag": [-0.1]}, {}, "pusher_lag.tau is -0.1 s, expected 0 to 0.5"),
        ({"wear": [0.0]}, {"friction_cone": "pyramid"}, "wear needs the circular cone"),
        ({"restitution": [0.1]}, {"quasi_static": True}, "restitution has no meaning without inertia"),
    ],
)
def test_effects_that_cannot_be_are_refused(effects: dict[str, object], settings: dict[str, object], message: str) -> None:
    model, pusher = plate(), straight_push((-0.07, 0.02), 0.2)
    with pytest.raises(InputError, match=message):
        simulate(model, PushScenario(pusher, np.zeros(3), pusher.time), settings=SimulationSettings(**settings), effects=effects)
