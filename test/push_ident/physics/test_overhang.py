"""An object that overhangs the edge of its table: equilibrium of the loads, falling, and the same motion as ever on the table."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points
from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.physics.overhang import TableEdge, overhung_loads
from push_ident.planning.belief import Belief
from push_ident.types import Float64Array, PusherPath
from push_ident_sim.studies.common.random_objects import random_object

MODEL = random_object(np.random.default_rng(4))
CELLS, MASS = MODEL.shape.cells.centres, MODEL.mass
CENTRE = MASS @ CELLS / MASS.sum()
EDGE = TableEdge(np.array([0.6, 0.8]), 0.2)


def at_edge(centre_inside: float, yaw: float) -> Float64Array:
    """Pose whose centre of mass is `centre_inside` [m] inside the edge."""
    turned = transform_points(np.array([0.0, 0.0, yaw]), CENTRE[None])[0]
    return np.array([*((EDGE.offset - centre_inside) * EDGE.outward - turned), yaw])


@pytest.mark.parametrize("inside", [0.004, 0.02, 0.04, 0.5])
def test_loads_hold_the_weight_at_the_centre_of_mass_and_none_is_beyond_the_edge(inside: float) -> None:
    for yaw in np.linspace(-3.0, 3.0, 7):
        pose = at_edge(inside, yaw)
        load = overhung_loads(EDGE, CELLS, MASS, pose)
        beyond = EDGE.beyond(transform_points(pose, CELLS)) > 0.0
        if load is None:
            continue
        assert np.all(load >= 0.0) and np.all(load[beyond] == 0.0)
        assert load.sum() == pytest.approx(1.0, abs=1e-6)
        np.testing.assert_allclose(load @ (CELLS - CENTRE), 0.0, atol=1e-7)
        if not np.any(beyond):
            np.testing.assert_allclose(load, MASS / MASS.sum(), rtol=1e-12)


def test_falls_exactly_where_no_pressure_on_the_table_is_in_equilibrium() -> None:
    """Whether such a pressure exists is a question of linear programming."""
    found = []
    for yaw in np.linspace(-3.0, 3.0, 13):
        for inside in (-0.003, 0.002, 0.006, 0.012, 0.03):
            pose = at_edge(inside, yaw)
            on = EDGE.beyond(transform_points(pose, CELLS)) <= 0.0
            arms = (CELLS - CENTRE)[on]
            equations = np.vstack([np.ones(len(arms)), arms.T])
            possible = linprog(np.zeros(len(arms)), A_eq=equations, b_eq=[1.0, 0.0, 0.0]).status == 0
            found.append(possible)
            assert (overhung_loads(EDGE, CELLS, MASS, pose) is not None) == possible
    assert 5 < sum(found) < len(found) - 5


def test_a_push_far_from_the_edge_is_the_same_to_the_last_bit_and_at_the_edge_it_is_another() -> None:
    models = Belief.certain(MODEL).models(0, np.random.default_rng(0))
    reach = float(np.min(MODEL.shape.outline[:, 0]))
    path = PusherPath(np.array([0.0, 1.0]), np.array([[reach - 0.03, 0.015], [reach + 0.06, 0.015]]), 0.008)
    push = [BatchPush(path, np.zeros(3), np.array([1.0]))]
    without = rollouts(MODEL.shape, models, push, step=1 / 240)
    far = rollouts(MODEL.shape, models, push, step=1 / 240, edge=TableEdge(np.array([1.0, 0.0]), 1.0))
    near = rollouts(MODEL.shape, models, push, step=1 / 240, edge=TableEdge(np.array([0.0, 1.0]), float(CENTRE[1]) + 0.005))
    np.testing.assert_array_equal(far, without)
    assert np.max(np.abs(near - without)) > 1e-3


def test_an_edge_needs_a_direction_and_models_with_weights() -> None:
    with pytest.raises(InputError, match="outward direction"):
        TableEdge(np.zeros(2), 0.0)
    with pytest.raises(InputError, match="outward direction"):
        TableEdge(np.array([1.0, 0.0]), np.nan)
    body = Belief.certain(MODEL).mean.body
    path = PusherPath(np.array([0.0, 0.1]), np.array([[-0.2, 0.0], [-0.19, 0.0]]), 0.008)
    with pytest.raises(InputError, match="weights"):
        rollouts(MODEL.shape, [BatchModel(body, 0.3)], [BatchPush(path, np.zeros(3), np.array([0.1]))], step=0.01, edge=EDGE)
