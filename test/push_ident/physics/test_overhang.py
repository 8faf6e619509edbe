"""An object that overhangs the edge of its table: equilibrium of the loads, falling, and the same motion as ever on the table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from helpers.objects import overhung_loads
from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points
from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.physics.effect import OnTable
from push_ident.physics.effect_values import effect_values
from push_ident.physics.effects import EFFECTS
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.types import Float64Array, ObjectModel, PusherPath
from push_ident_sim.studies.common.objects import random_object

MODEL = random_object(np.random.default_rng(4))
CELLS, MASS = MODEL.shape.cells.centres, MODEL.mass
CENTRE = MASS @ CELLS / MASS.sum()
EDGE = TableEdge(np.array([0.6, 0.8]), 0.2)


def at_edge(centre_inside: float, yaw: float) -> Float64Array:
    """Pose whose centre of mass is `centre_inside` [m] inside the edge."""
    turned = transform_points(np.array([0.0, 0.0, yaw]), CENTRE[None])[0]
    return np.array([*((EDGE.offset - centre_inside) * EDGE.outward - turned), yaw])


def test_loads_hold_the_weight_at_the_centre_of_mass_on_the_table_and_it_falls_where_none_could() -> None:
    """Whether a pressure on the table is in equilibrium is a question of linear programming."""
    found = []
    for yaw, inside in product(np.linspace(-3.0, 3.0, 13), (-0.003, 0.002, 0.006, 0.012, 0.03, 0.5)):
        pose = at_edge(inside, yaw)
        load, on = overhung_loads(EDGE, MODEL, pose), EDGE.beyond(transform_points(pose, CELLS)) <= 0.0
        arms = (CELLS - CENTRE)[on]
        found.append(linprog(np.zeros(len(arms)), A_eq=np.vstack([np.ones(len(arms)), arms.T]), b_eq=[1.0, 0.0, 0.0]).status == 0)
        assert (load is not None) == found[-1]
        if load is not None:
            assert np.all(load >= 0.0) and np.all(load[~on] == 0.0)
            assert load.sum() == pytest.approx(1.0, abs=1e-6)
            np.testing.assert_allclose(load @ (CELLS - CENTRE), 0.0, atol=1e-7)
            if np.all(on):
                np.testing.assert_allclose(load, MASS / MASS.sum(), rtol=1e-12)
    assert 18 < sum(found) < len(found) - 5


MOVING = np.array([0.05, -0.03, 0.0])
"""Of the object [m/s, m/s, rad/s]."""


def coasted(model: BatchModel, pose: Float64Array, time: float, edge: TableEdge = EDGE) -> Float64Array:
    """Pose after a single step [s] of an object that nobody pushes."""
    away = PusherPath(np.array([0.0, time]), np.full((2, 2), 5.0), 0.008)
    push = BatchPush(away, pose, np.array([time]), MOVING)
    return rollouts(MODEL.shape, [model], [push], step=time, edge=edge)[0, 0, 0]


def model_of(model: ObjectModel = MODEL, **changes: Any) -> BatchModel:
    """For a batch, with some fields changed."""
    (certain,) = Belief.certain(model).models(0, np.random.default_rng(0))
    return BatchModel(**{name: getattr(certain, name) for name in BatchModel.__annotations__} | changes)


@pytest.mark.parametrize("name", [None, *(name for name, effect in EFFECTS.items() if isinstance(effect.acts, OnTable))])
def test_a_push_far_from_the_edge_ends_as_on_an_endless_table_to_the_last_bit_and_at_the_edge_elsewhere(name: str | None) -> None:
    effects = effect_values(name and {name: [p.typical + p.nominal for p in EFFECTS[name].parameters]})
    reach = float(np.min(MODEL.shape.outline[:, 0]))
    path = PusherPath(np.array([0.0, 1.0]), np.array([[reach - 0.03, 0.015], [reach + 0.06, 0.015]]), 0.008)
    edges = (None, TableEdge(np.array([1.0, 0.0]), 1.0), TableEdge(np.array([0.0, 1.0]), float(CENTRE[1]) + 0.005))
    without, far, near = (
        rollouts(MODEL.shape, [model_of(effects=effects)], [BatchPush(path, np.zeros(3), np.array([1.0]))], step=1 / 240, edge=edge)
        for edge in edges
    )
    np.testing.assert_array_equal(far, without)
    assert np.max(np.abs(near - without)) > 1e-3


def factor_of_leading_cells(place: Float64Array, borne: Float64Array) -> Float64Array:
    """Loads that are led by 4 mm: their sum stays, their centre moves by as much along the motion."""
    centre = borne @ place / borne.sum()
    covariance = (borne * (place - centre).T) @ (place - centre) / borne.sum() + MODEL.shape.cells.size**2 / 12 * np.eye(2)
    lead = 0.004 * MOVING[:2] / np.linalg.norm(MOVING[:2])
    return 1.0 + (place - centre) @ np.linalg.solve(covariance, lead)


@pytest.mark.parametrize(
    ("effects", "factor"),
    [
        ({"position_dependent_friction": [2.0, 0.0]}, lambda place, _: 1.0 + 2.0 * place[:, 0]),
        ({"push_height": [0.004]}, factor_of_leading_cells),
    ],
)
@pytest.mark.parametrize("inside", [0.01, 0.03])
def test_effects_at_the_edge_change_the_friction_of_the_cells_by_what_they_bear(
    effects: dict[str, list[float]], factor: Callable[[Float64Array, Float64Array], Float64Array], inside: float
) -> None:
    model, pose = model_of(), at_edge(inside, 0.7)
    load = overhung_loads(EDGE, MODEL, pose)
    assert load is not None
    place = transform_points(pose, CELLS)
    share = factor(place, load * MODEL.friction)
    assert np.all(share[load > 0.0] > 0.0), "each cell still bears a load"
    changed = model_of(body=replace(model.body, limit=model.body.limit * np.maximum(share, 0.0)))
    found = coasted(model_of(effects=effect_values(effects)), pose, 0.01)
    np.testing.assert_allclose(found, coasted(changed, pose, 0.01), rtol=0, atol=1e-8)
    assert np.max(np.abs(found - coasted(model, pose, 0.01))) > 1e-6


def test_tilt_slows_an_object_at_the_edge_by_its_weight_whatever_overhangs() -> None:
    """Friction is mu m g wherever the loads are, and they stay at the centre of mass: m a = -mu m g + tilt m g along the motion."""
    even = ObjectModel(MODEL.shape, MODEL.mass, np.full(len(MASS), 0.3), 0.2)
    direction, time = MOVING[:2] / np.linalg.norm(MOVING[:2]), 0.01
    for inside in (0.01, 0.03, 0.5):
        pose = at_edge(inside, 0.7)
        for tilt in (-0.05, 0.05):
            found = coasted(model_of(even, effects=effect_values({"table_tilt": list(tilt * direction)})), pose, time)
            expected = np.linalg.norm(MOVING[:2]) * time - 0.5 * 9.81 * (0.3 - tilt) * time**2
            assert (found - pose)[:2] @ direction == pytest.approx(expected, rel=3e-3)
            assert abs((found - pose)[2]) < 1e-6


def test_an_edge_needs_a_direction_and_models_with_weights() -> None:
    for outward, offset in ((np.zeros(2), 0.0), (np.array([1.0, 0.0]), np.nan)):
        with pytest.raises(InputError, match="outward direction"):
            TableEdge(outward, offset)
    path = PusherPath(np.array([0.0, 0.1]), np.array([[-0.2, 0.0], [-0.19, 0.0]]), 0.008)
    with pytest.raises(InputError, match="weights"):
        rollouts(MODEL.shape, [BatchModel(model_of().body, 0.3)], [BatchPush(path, np.zeros(3), np.array([0.1]))], step=0.01, edge=EDGE)
