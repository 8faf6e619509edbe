"""Batched rollouts give the poses of single ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.se2 import compose
from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.physics.effect import OnForces, OnForceTimes, OnPoses, OnTimes
from push_ident.physics.effect_values import EffectsLike, effect_values
from push_ident.physics.effects import EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, body_of_cells, simulate_body
from push_ident.planning.library import moved
from push_ident.types import Float64Array, ObjectModel, PusherPath
from push_ident_sim.studies.common.objects import random_object

OF_MOTION = [name for name, effect in EFFECTS.items() if not isinstance(effect.acts, OnTimes | OnPoses | OnForces | OnForceTimes)]
POSE = np.array([0.1, -0.2, 2.0])
"""Pose of an object that effects of the table see from another side."""
FIRST = random_object(np.random.default_rng(3))
OTHER = ObjectModel(FIRST.shape, FIRST.mass[::-1].copy(), FIRST.friction, 0.1)


def of_batch(model: ObjectModel, **fields: Any) -> BatchModel:
    return BatchModel(body_of_cells(model.shape, model.mass, model.friction), model.pusher_friction, **fields)


def single(model: ObjectModel, push: BatchPush, beside: Float64Array | None = None, effects: EffectsLike | None = None, **law: Any) -> Any:
    """Poses by one simulation; `beside`: where the object lies in its observed pose."""
    first = push.pose_object_in_table if beside is None else compose(push.pose_object_in_table, beside)
    body, numerics = body_of_cells(model.shape, model.mass, model.friction), SimulationSettings(resolve_events=True, **law)
    scenario = PushScenario(push.pusher, first, push.time)
    return simulate_body(model.shape, body, model.pusher_friction, scenario, settings=numerics, effects=effects).pose


def pushes_of(seed: int, n: int, pose: Float64Array | None = None) -> list[BatchPush]:
    """Straight pushes through the middle from all sides, of different lengths and speeds."""
    rng, pose, pushes = np.random.default_rng(seed), np.zeros(3) if pose is None else pose, []
    for _ in range(n):
        angle, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.08, 0.2)
        heading = np.array([np.cos(angle), np.sin(angle)])
        path = np.outer([-0.14, rng.uniform(-0.05, 0.05)], heading) + rng.uniform(-0.02, 0.02, 2)
        time = np.array([0.0, np.linalg.norm(path[1] - path[0]) / speed])
        pushes.append(BatchPush(moved(pose, PusherPath(time, path, 0.008)), pose, np.array([0.6, 1.0]) * time[1]))
    return pushes


@pytest.mark.parametrize("law", [{}, {"smoothing_speed": 0.5, "quasi_static": True}], ids=["fast", "slow"])
def test_batch_equals_single_simulations_with_any_number_of_threads(law: dict[str, Any]) -> None:
    both, pushes = [FIRST, OTHER], pushes_of(0, 70)
    found = [rollouts(FIRST.shape, [of_batch(m) for m in both], pushes, step=1 / 120, n_threads=n, **law) for n in (1, 3)]
    np.testing.assert_array_equal(found[0], [[single(m, push, step=1 / 120, **law) for push in pushes] for m in both])
    np.testing.assert_array_equal(found[0], found[1])


def curved_push(seed: int) -> BatchPush:
    """Along an arc that begins in front of the object."""
    rng, time = np.random.default_rng(seed), np.linspace(0.0, 1.2, 73)
    angle = rng.uniform(-np.pi, np.pi) + 1.2 * time * rng.choice([-1.0, 1.0])
    steps = np.diff(time)[:, None] * 0.1 * np.column_stack([np.cos(angle), np.sin(angle)])[1:]
    path = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    return BatchPush(PusherPath(time, path - path[40] * 1.6, 0.008), np.zeros(3), np.array([0.5, 0.8, 1.2]))


def test_curved_paths_of_the_tool_move_the_object_as_in_single_simulations() -> None:
    pushes = [curved_push(k) for k in range(8)]
    found = rollouts(FIRST.shape, [of_batch(FIRST)], pushes, step=1 / 60)[0]
    expected = np.array([single(FIRST, push, step=1 / 240) for push in pushes])
    assert np.median(np.abs(expected)) > 5e-3
    np.testing.assert_allclose(found[..., :2], expected[..., :2], atol=6e-4)
    np.testing.assert_allclose(found[..., 2], expected[..., 2], atol=0.01)


def test_push_that_begins_in_motion_goes_on_as_the_whole_one() -> None:
    own, step = [of_batch(FIRST)], 1 / 240
    for seed in range(4):
        whole = curved_push(seed)
        time, cut = whole.pusher.time, 50
        ends = np.array([time[cut] - step, time[cut], time[-1]])
        before, first, end = rollouts(FIRST.shape, own, [BatchPush(whole.pusher, whole.pose_object_in_table, ends)], step=step)[0, 0]
        path = PusherPath(time[cut:], whole.pusher.position[cut:], 0.008)
        rest = [BatchPush(path, first, time[-1:], velocity) for velocity in ((first - before) / step, None)]
        again = rollouts(FIRST.shape, own, rest, step=step)[0, :, 0]
        assert np.linalg.norm(first - before) > 1e-4
        np.testing.assert_allclose(again[0], end, atol=2e-5)
        assert np.max(np.abs(again[1] - end)) > 4e-5


def test_displaced_objects_and_surfaces_are_pushed_where_they_are() -> None:
    beside, pushes = np.array([2e-3, 1e-3, 0.03]), pushes_of(4, 6, POSE)
    batch = [of_batch(FIRST, displacement=beside), of_batch(FIRST, surface=1.5e-3), of_batch(FIRST, surface=-1.5e-3)]
    found = rollouts(FIRST.shape, batch, pushes, step=1 / 240)
    singles = [{"beside": beside}, *({"effects": {"outline_error": [offset]}} for offset in (1.5e-3, -1.5e-3))]
    for poses, fields in zip(found, singles, strict=True):
        np.testing.assert_allclose(poses, [single(FIRST, push, step=1 / 240, **fields) for push in pushes], atol=1e-9)


def test_nothing_to_simulate_and_different_pushers_are_refused() -> None:
    (one,) = pushes_of(0, 1)
    other = BatchPush(PusherPath(one.pusher.time, one.pusher.position, 0.01), *one[1:])
    for pushes, word in (([], "no pushes"), ([one, other], "differ in their pusher")):
        with pytest.raises(InputError, match=word):
            rollouts(FIRST.shape, [of_batch(FIRST)], pushes, step=1 / 80)


@pytest.mark.parametrize("name", OF_MOTION)
def test_effects_act_as_in_single_simulations(name: str) -> None:
    pushes, parameters = pushes_of(5, 3, POSE), EFFECTS[name].parameters
    sizes = [effect_values({name: [scale * p.typical + p.nominal for p in parameters]}) for scale in (0.5, 1.0)]
    found = rollouts(FIRST.shape, [of_batch(FIRST, effects=own) for own in sizes], pushes, step=1 / 120)
    np.testing.assert_array_equal(found, [[single(FIRST, push, effects=own, step=1 / 120) for push in pushes] for own in sizes])
