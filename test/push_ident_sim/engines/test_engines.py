"""The planar engine and its laws of friction and contact, by closed forms; and a rigid body in Bullet that may fall from its table."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from helpers.objects import overhung_loads
from helpers.sim_objects import CAMERA, disc
from push_ident.errors import InputError, PushIdentError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.physics.batch import BatchPush, rollouts
from push_ident.physics.effect_values import EffectValues
from push_ident.physics.overhang import TableEdge
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, simulate
from push_ident.planning.belief import Belief
from push_ident.pushing.sampling import sample_push
from push_ident.types import Float64Array, ObjectModel, PusherPath
from push_ident_sim.cell.camera import DepthCamera
from push_ident_sim.cell.world import CellWorld, WorldConfig
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.engines.planar import OUTSIDE, PlanarWorld
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.injected import INJECTED, InjectedEffects
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import TruthSettings, make_pushes, path_of_plan, true_model
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


# --- at the edge of a table: a rigid body in Bullet, what the loads of `physics/overhang.py` are proved by, and its cell

EDGE = TableEdge(np.array([1.0, 0.0]), 0.8)
THING = make_object("toolbox", 1)
MODEL = true_model(THING)
CENTRE = MODEL.mass @ MODEL.shape.cells.centres / MODEL.total_mass
PUSHES = replace(TruthSettings().pushes, workspace=(-2.0, 2.0, -2.0, 2.0), distance_range=(0.05, 0.08))


@pytest.fixture(scope="module")
def world() -> Iterator[PushWorld]:
    # Pushed low, so that the push itself moves the load by little.
    with closing(PushWorld(THING, PUSHES.pusher_radius, rigid=True, pusher_height=0.004)) as world:
        yield world


def with_centre_inside(inside: float, yaw: float) -> Float64Array:
    return np.array([EDGE.offset - inside - transform_points(np.array([0.0, 0.0, yaw]), CENTRE[None])[0, 0], 0.05, yaw])


def test_a_rigid_body_bears_its_weight_on_the_table_only_and_falls_where_the_model_says_so(world: PushWorld) -> None:
    still = PusherPath(np.array([0.0, 0.3]), np.full((2, 2), 0.2), PUSHES.pusher_radius)
    for yaw in (0.7, -2.6):
        for inside in (-0.01, -0.004, 0.018, 0.04):
            pose = with_centre_inside(inside, yaw)
            load = overhung_loads(EDGE, MODEL, pose)
            world.push(pose, still, longest_rest=0.7)
            assert world.has_fallen == (load is None), (yaw, inside)
            if load is not None:
                borne = world.cell_loads() / (9.81 * MODEL.total_mass)
                assert borne.sum() == pytest.approx(1.0, abs=0.02)
                np.testing.assert_allclose(borne @ (MODEL.shape.cells.centres - CENTRE), 0.0, atol=1e-3)


def test_pushes_at_the_edge_are_predicted_as_well_as_pushes_on_the_table(world: PushWorld) -> None:
    """Without the edge the model errs twice as much in the turn. Both engines share loads in their own way, on the table too."""
    rng, models = np.random.default_rng(0), Belief.certain(MODEL).models(0, np.random.default_rng(0))
    errors: dict[str, list[tuple[float, float]]] = {"table": [], "edge": [], "edge ignored": []}
    while len(errors["edge"]) < 10:
        yaw = rng.uniform(-np.pi, np.pi)
        for where, inside in (("table", 0.7), ("edge", rng.uniform(0.03, 0.05))):
            pose = with_centre_inside(inside, yaw)
            path = path_of_plan(sample_push(MODEL.shape, pose, rng, PUSHES), TruthSettings())
            push = [BatchPush(path, pose, path.time)]
            with_edge, without = (rollouts(MODEL.shape, models, push, step=1 / 240, edge=edge)[0, 0] for edge in (EDGE, None))
            centres = np.array([transform_points(p, CENTRE[None])[0, 0] for p in with_edge[::20]])
            # Near to falling the two do not agree on when a cell leaves the table.
            if where == "edge" and EDGE.offset - np.max(centres) < 0.02:
                continue
            end = world.push(pose, path).pose[-1]
            errors[where].append(error(with_edge[-1], end))
            if where == "edge":
                errors["edge ignored"].append(error(without[-1], end))
    mean = {where: np.mean(each, axis=0) for where, each in errors.items()}
    assert np.all(mean["edge"] < 1.3 * mean["table"] + [5e-4, 5e-3])
    assert np.all(mean["edge ignored"] > [1.1, 1.6] * mean["edge"])


def error(pose: Float64Array, other: Float64Array) -> tuple[float, float]:
    return float(np.linalg.norm((pose - other)[:2])), float(abs(wrap_angle(pose[2] - other[2])))


END = 0.1
BOUNDS = (-0.8, END, -0.7, 0.7)
OUT_OF_VIEW = (9.0, 9.0, 0.0)


def test_object_stands_over_the_end_of_its_table_or_falls_out_of_view() -> None:
    sim_object = make_object("toolbox", 1)
    centre = sim_object.mass @ sim_object.cells / sim_object.mass.sum()
    world = CellWorld(sim_object, WorldConfig(table=BOUNDS), pose=(END - 0.03 - centre[0], 0.0, 0.0))
    camera = DepthCamera(sim_object, CAMERA)
    whole = camera.render(OUT_OF_VIEW, {})
    camera.set_table(BOUNDS)
    empty = camera.render(OUT_OF_VIEW, {})
    beyond = np.isfinite(whole) & np.isnan(empty)
    assert beyond.any() and np.isfinite(empty).any(), "beside the table no surface is"
    try:
        for _ in range(60):
            world.step()
        assert not world.has_fallen and world.cell_loads().sum() == pytest.approx(9.81 * sim_object.mass.sum(), rel=0.05)
        np.testing.assert_allclose(world.object_pose(), [END - 0.03 - centre[0], 0.0, 0.0], atol=2e-3)
        assert np.isfinite(camera.render(world.object_transform(), {})[beyond]).any(), "what overhangs is seen"
        world.place_object((END + 0.012 - centre[0], 0.0, 0.0))
        fallen = []
        for _ in range(480):
            world.step()
            fallen.append(world.has_fallen)
        assert all(fallen[fallen.index(True) :]), "it tumbles, and stays fallen"
        seen = camera.render(world.object_transform(), {})
        np.testing.assert_array_equal(seen[np.isfinite(empty)], empty[np.isfinite(empty)], "nothing is left on the table")
    finally:
        world.close()
    with pytest.raises(InputError, match="table_tilt"):
        WorldConfig(table=BOUNDS, effects=InjectedEffects.of({"table_tilt": [0.01, 0.0]}))
