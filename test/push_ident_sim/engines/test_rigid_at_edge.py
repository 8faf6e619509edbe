"""An object that may fall from its table: a rigid body in Bullet, what the loads of `physics/overhang.py` are proved by, and its cell."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import overhung_loads
from helpers.sim_objects import CAMERA
from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.physics.batch import BatchPush, rollouts
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.pushing.sampling import sample_push
from push_ident.types import Float64Array, PusherPath
from push_ident_sim.cell.camera import DepthCamera
from push_ident_sim.cell.world import CellWorld, WorldConfig
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import TruthSettings, path_of_plan, true_model

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
AWAY = (9.0, 9.0, 0.0)


def test_object_stands_over_the_end_of_its_table_or_falls_out_of_view() -> None:
    sim_object = make_object("toolbox", 1)
    centre = sim_object.mass @ sim_object.cells / sim_object.mass.sum()
    world = CellWorld(sim_object, WorldConfig(table=BOUNDS), pose=(END - 0.03 - centre[0], 0.0, 0.0))
    camera = DepthCamera(sim_object, CAMERA)
    whole = camera.render(AWAY, {})
    camera.set_table(BOUNDS)
    empty = camera.render(AWAY, {})
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
