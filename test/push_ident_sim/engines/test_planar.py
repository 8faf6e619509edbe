"""The planar engine: laws of friction and contact that only it has, and the closed forms that they must keep."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from helpers.sim_objects import disc
from push_ident.errors import InputError, PushIdentError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.se2 import transform_points
from push_ident.physics.effect_values import EffectValues
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, simulate
from push_ident.types import Float64Array, ObjectModel, PusherPath
from push_ident_sim.engines.planar import OUTSIDE, PlanarWorld
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.injected import INJECTED, InjectedEffects
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import TruthSettings, make_pushes, true_model
from push_ident_sim.studies.blind.scoring import true_values

RADIUS = 0.008
AWAY = PusherPath(np.array([0.0, 0.01]), np.full((2, 2), 5.0), RADIUS)
FEW = TruthSettings(n_train=3, n_test=0)


@cache
def pushes_of(name: str, **effects: tuple[float, ...]) -> list[TrueMotion]:
    sim_object, injected = make_object(name, 3), InjectedEffects.of(effects)
    return make_pushes(sim_object, [3, 1], replace(FEW, effects=injected), engine=PlanarWorld(sim_object, RADIUS, effects=injected))


def off(name: str, motions: list[TrueMotion], others: list[TrueMotion]) -> float:
    cells = true_model(make_object(name, 3)).shape.cells
    return float(np.mean([cell_error(cells, a.pose[-1], b.pose[-1]) for a, b in zip(motions, others, strict=True)]))


def test_thrown_disc_slides_spins_and_is_damped_by_its_closed_forms() -> None:
    sim_object, speed = disc(), 0.4
    world, expected = PlanarWorld(sim_object, RADIUS), speed**2 / (2 * 0.3 * GRAVITY)
    for angle in 2 * np.pi * np.arange(5) / 5 + 0.1:
        along = np.array([np.cos(angle), np.sin(angle)])
        way = world.push((0.0, 0.0, 0.7), AWAY, velocity=(*(speed * along), 0.0)).pose[-1] - [0.0, 0.0, 0.7]
        assert way[:2] @ along == pytest.approx(expected, rel=0.005)
        assert abs(way[0] * along[1] - way[1] * along[0]) < 2e-6 and abs(way[2]) < 1e-4
    # Spinning, with friction mu on cells at r and inertia about the centre: alpha = mu g sum r / sum (r^2 + size^2 / 6).
    spin, r = 12.0, np.hypot(*sim_object.cells.T)
    slow_down = 0.3 * GRAVITY * r.sum() / (r**2 + sim_object.cell_size**2 / 6).sum()
    turned = world.push((0.0, 0.0, 0.0), AWAY, velocity=(0.0, 0.0, spin)).pose[-1, 2]
    assert turned == pytest.approx(spin**2 / (2 * slow_down), rel=0.005)
    # In a film, m dv/dt = -mu m g - c v: distance = (m / c) (v - (mu m g / c) ln(1 + c v / (mu m g))).
    mass, damping = float(sim_object.mass.sum()), 3.0
    dry = 0.3 * mass * GRAVITY
    distance = mass / damping * (speed - dry / damping * np.log1p(damping * speed / dry))
    world = PlanarWorld(sim_object, RADIUS, effects=InjectedEffects.of({"viscous_film": damping}))
    assert world.push((0.0, 0.0, 0.0), AWAY, velocity=(speed, 0.0, 0.0)).pose[-1, 0] == pytest.approx(distance, rel=0.005)


def test_energy_never_grows_when_a_thrown_object_hits_a_resting_pusher() -> None:
    hammer = make_object("hammer", 1)
    centre = hammer.mass @ hammer.cells / hammer.mass.sum()
    radius = np.sqrt(hammer.mass @ np.sum((hammer.cells - centre) ** 2, axis=1) / hammer.mass.sum())
    post = PusherPath(np.array([0.0, 0.01]), np.array([[0.12, 0.06]] * 2), RADIUS)
    for bounce in (0.0, 0.8):
        world = PlanarWorld(hammer, RADIUS, effects=InjectedEffects.of({"restitution": bounce}))
        motion = world.push((-0.05, 0.0, 0.3), post, velocity=(0.9, 0.2, 1.0))
        at = np.array([transform_points(pose, centre[None])[0] for pose in motion.pose])
        rate = np.diff(np.column_stack([at, motion.pose[:, 2]]), axis=0) / motion.time[1]
        energy = 0.5 * (np.sum(rate[:, :2] ** 2, axis=1) + (radius * rate[:, 2]) ** 2)
        # While they touch, the spring between them holds energy, too.
        touch = np.abs(motion.force[1:]).max(axis=1) > 0.0
        free = ~(touch | np.roll(touch, 1) | np.roll(touch, -1))
        assert touch.any() and free[-1]
        # Bristles give back what they took up, a few micrometres times their limit.
        assert np.diff(energy[free]).max() < 1e-5 * energy[0]


def test_half_the_step_changes_ends_by_less_than_a_twentieth_of_a_millimetre() -> None:
    sim_object = make_object("hammer", 3)
    coarse, fine = (make_pushes(sim_object, [3, 1], FEW, engine=PlanarWorld(sim_object, RADIUS, inner_steps=n)) for n in (96, 192))
    assert off("hammer", coarse, fine) < 5e-5


def test_loads_bear_the_weight_under_the_centre_of_mass_and_none_pulls() -> None:
    sim_object = make_object("hammer", 3)
    load, centre = PlanarWorld(sim_object, RADIUS).cell_loads(), sim_object.mass @ sim_object.cells / sim_object.mass.sum()
    assert load.sum() == pytest.approx(sim_object.mass.sum() * GRAVITY, rel=1e-6)
    np.testing.assert_allclose(load @ sim_object.cells / load.sum(), centre, atol=1e-6)
    assert load.min() >= 0.0


def test_what_cannot_be_simulated_is_refused() -> None:
    sim_object = make_object("book", 3)
    with pytest.raises(InputError, match="magnet"):
        PlanarWorld(sim_object, RADIUS, outside={"ghost": 1.0}).push((0.0, 0.0, 0.0), AWAY)
    with pytest.raises(InputError, match="three finite numbers"):
        PlanarWorld(sim_object, RADIUS).push((0.0, np.nan, 0.0), AWAY)
    with pytest.raises(PushIdentError, match="tips over"):
        PlanarWorld(disc(0.0), RADIUS).push((0.0, 0.0, 0.0), AWAY)


LAWS = {
    "table_tilt": ((0.016, 0.012), 0.05),
    "table_anisotropy": ((0.12, 0.09), 0.05),
    "base_anisotropy": ((0.12, 0.09), 0.05),
    "position_dependent_friction": ((0.8, 0.6), 0.08),
    "speed_dependent_friction": ((0.2,), 0.1),
    "pusher_friction": ((0.1,), 0.08),
    "push_height": ((0.006,), 0.4),
    "moving_contents": ((0.01,), 0.3),
    "outline_error": ((1e-3,), 0.15),
    "pusher_speed_scale": ((0.02,), 0.05),
    "tool_offset": ((1.6e-3, 1.2e-3), 0.05),
}
"""Size of each effect, and share of what it does by which two engines may differ about it; those of loads that shift are approximations."""

OBJECTS = (("wrench", 11), ("hammer", 12))


@cache
def without_effects(which: str, seed: int) -> tuple[ObjectModel, list[tuple[PushScenario, Float64Array, Float64Array]]]:
    """Model of an object with the loads of the engine, and pushes of it without effects, each with its end in engine and model.

    The bed of springs loads cells otherwise than their own weight does; friction maps of the fit take this up.
    """
    sim_object = make_object(which, seed)
    world, model = PlanarWorld(sim_object, RADIUS), true_model(sim_object)
    model = replace(model, friction=model.friction * world.cell_loads() / (model.mass * GRAVITY))
    pushes = []
    for motion in make_pushes(sim_object, [seed, 6], FEW, engine=world):
        scenario = PushScenario(PusherPath(motion.time, motion.pusher, RADIUS), motion.pose[0], motion.time[-1:])
        pushes.append((scenario, motion.pose[-1], simulate(model, scenario).pose[-1]))
    return model, pushes


@pytest.mark.parametrize(("which", "seed"), OBJECTS)
def test_both_engines_agree_to_half_a_millimetre_where_the_loads_are_the_same(which: str, seed: int) -> None:
    model, pushes = without_effects(which, seed)
    assert 1e-6 < np.median([cell_error(model.shape.cells, predicted, end) for _, end, predicted in pushes]) < 5e-4


LAWLESS = [name for name, effect in INJECTED.items() if effect.acts_on in ("table", "object", "pusher") and name not in LAWS]


@pytest.mark.parametrize("name", [*LAWLESS, *OUTSIDE])
def test_effect_without_a_law_of_the_other_engine_changes_the_motion(name: str) -> None:
    if name in INJECTED:
        assert 1e-6 < off("book", pushes_of("book", **INJECTED[name].typical(0.3)), pushes_of("book")) < 0.05
        return
    book = make_object("book", 3)
    changed = make_pushes(book, [3, 1], FEW, engine=PlanarWorld(book, RADIUS, outside={name: OUTSIDE[name].parameters[0].typical}))
    assert off("book", changed, pushes_of("book")) > 1e-4


@pytest.mark.parametrize("name", LAWS)
def test_law_of_an_effect_moves_objects_as_the_other_engine_moves_them(name: str) -> None:
    size, allowed = LAWS[name]
    effects, wrong = InjectedEffects.of({name: size}), []
    for which, seed in OBJECTS:
        model, pushes = without_effects(which, seed)
        changed = PlanarWorld(make_object(which, seed), RADIUS, effects=effects)
        law = EffectValues((name,), true_values(effects, name, np.zeros(2)))
        for scenario, place, predicted in pushes:
            by_engine = changed.push(scenario.pose_object_in_table, scenario.pusher).pose[-1] - place
            by_law = simulate(model, scenario, effects=law).pose[-1] - predicted
            moved = cell_error(model.shape.cells, place, place + by_engine)
            wrong.append(cell_error(model.shape.cells, place + by_engine, place + by_law) / max(moved, 1e-5))
    assert np.median(wrong) < allowed, np.round(wrong, 3)
