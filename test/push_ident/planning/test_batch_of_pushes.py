"""Batched rollouts give the poses of single ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.se2 import compose, transform_points
from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.physics.effect import OnForces, OnForceTimes, OnPoses, OnTimes
from push_ident.physics.effect_values import effect_values
from push_ident.physics.effects import EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, body_of_cells, simulate_body
from push_ident.planning.library import moved
from push_ident.types import ObjectModel, PusherPath
from push_ident_sim.studies.common.objects import random_object

OF_MOTION = [name for name, effect in EFFECTS.items() if not isinstance(effect.acts, OnTimes | OnPoses | OnForces | OnForceTimes)]
POSE = np.array([0.1, -0.2, 2.0])
"""Pose of an object that effects of the table see from another side."""


def pushes_of(rng: np.random.Generator, n: int) -> list[BatchPush]:
    """Straight pushes through the middle from all sides, of different lengths and speeds."""
    pushes = []
    for _ in range(n):
        angle, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.08, 0.2)
        heading = np.array([np.cos(angle), np.sin(angle)])
        path = np.outer([-0.14, rng.uniform(-0.05, 0.05)], heading) + rng.uniform(-0.02, 0.02, 2)
        time = np.array([0.0, np.linalg.norm(path[1] - path[0]) / speed])
        pushes.append(BatchPush(PusherPath(time, path, 0.008), np.zeros(3), np.array([0.6, 1.0]) * time[1]))
    return pushes


def models() -> list[ObjectModel]:
    """One shape with different maps."""
    first = random_object(np.random.default_rng(3))
    return [first, ObjectModel(first.shape, first.mass[::-1].copy(), first.friction, 0.1)]


@pytest.mark.parametrize("law", [{}, {"smoothing_speed": 0.5, "quasi_static": True}], ids=["fast", "slow"])
def test_batch_equals_single_simulations(law: dict[str, Any]) -> None:
    both, pushes = models(), pushes_of(np.random.default_rng(0), 70)
    bodies = [body_of_cells(model.shape, model.mass, model.friction) for model in both]
    found = rollouts(
        both[0].shape, [BatchModel(b, m.pusher_friction) for b, m in zip(bodies, both, strict=True)], pushes, step=1 / 120, **law
    )
    numerics = SimulationSettings(step=1 / 120, resolve_events=True, **law)
    expected = [
        [
            simulate_body(
                model.shape, body, model.pusher_friction, PushScenario(p.pusher, p.pose_object_in_table, p.time), settings=numerics
            ).pose
            for p in pushes
        ]
        for model, body in zip(both, bodies, strict=True)
    ]
    np.testing.assert_array_equal(found, expected)


def curved_push(rng: np.random.Generator) -> BatchPush:
    """Along an arc that begins in front of the object."""
    time = np.linspace(0.0, 1.2, 73)
    angle = rng.uniform(-np.pi, np.pi) + 1.2 * time * rng.choice([-1.0, 1.0])
    steps = np.diff(time)[:, None] * 0.1 * np.column_stack([np.cos(angle), np.sin(angle)])[1:]
    path = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    return BatchPush(PusherPath(time, path - path[40] * 1.6, 0.008), np.zeros(3), np.array([0.5, 0.8, 1.2]))


def test_curved_paths_of_the_tool_move_the_object_as_in_single_simulations() -> None:
    model = models()[0]
    body, pushes = body_of_cells(model.shape, model.mass, model.friction), [curved_push(np.random.default_rng(k)) for k in range(8)]
    found = rollouts(model.shape, [BatchModel(body, model.pusher_friction)], pushes, step=1 / 60)[0]
    numerics = SimulationSettings(step=1 / 240)
    single = [
        simulate_body(model.shape, body, model.pusher_friction, PushScenario(p.pusher, np.zeros(3), p.time), settings=numerics).pose
        for p in pushes
    ]
    assert np.median(np.abs(single)) > 5e-3
    np.testing.assert_allclose(found[..., :2], np.array(single)[..., :2], atol=6e-4)
    np.testing.assert_allclose(found[..., 2], np.array(single)[..., 2], atol=0.01)


def test_push_that_begins_in_motion_goes_on_as_the_whole_one() -> None:
    model, step = models()[0], 1 / 240
    own = [BatchModel(body_of_cells(model.shape, model.mass, model.friction), model.pusher_friction)]
    for seed in range(4):
        whole = curved_push(np.random.default_rng(seed))
        time, cut = whole.pusher.time, 50
        ends = np.array([time[cut] - step, time[cut], time[-1]])
        before, first, end = rollouts(model.shape, own, [BatchPush(whole.pusher, whole.pose_object_in_table, ends)], step=step)[0, 0]
        path = PusherPath(time[cut:], whole.pusher.position[cut:], 0.008)
        rest = [BatchPush(path, first, time[-1:], velocity) for velocity in ((first - before) / step, None)]
        again = rollouts(model.shape, own, rest, step=step)[0, :, 0]
        assert np.linalg.norm(first - before) > 1e-4
        np.testing.assert_allclose(again[0], end, atol=2e-5)
        assert np.max(np.abs(again[1] - end)) > 4e-5


def test_object_that_lies_beside_its_observed_pose_is_pushed_there() -> None:
    model, pushes = models()[0], pushes_of(np.random.default_rng(4), 6)
    body, seen, beside = body_of_cells(model.shape, model.mass, model.friction), np.array([0.3, -0.2, 2.0]), np.array([2e-3, 1e-3, 0.03])
    moved = []
    for push in pushes:
        path = replace(push.pusher, position=transform_points(seen, push.pusher.position))
        moved.append(BatchPush(path, seen, push.time))
    found = rollouts(model.shape, [BatchModel(body, model.pusher_friction, displacement=beside)], moved, step=1 / 240)[0]
    numerics = SimulationSettings(step=1 / 240, resolve_events=True)
    for pose, push in zip(found, moved, strict=True):
        scenario = PushScenario(push.pusher, compose(seen, beside), push.time)
        single = simulate_body(model.shape, body, model.pusher_friction, scenario, settings=numerics)
        np.testing.assert_allclose(pose, single.pose, atol=1e-9)


def test_number_of_threads_does_not_matter() -> None:
    model, pushes = models()[0], pushes_of(np.random.default_rng(1), 150)
    arguments = (model.shape, [BatchModel(body_of_cells(model.shape, model.mass, model.friction), 0.2)], pushes)
    np.testing.assert_array_equal(rollouts(*arguments, step=1 / 80, n_threads=1), rollouts(*arguments, step=1 / 80, n_threads=3))


def test_nothing_to_simulate_and_different_pushers_are_refused() -> None:
    model = models()[0]
    whole = [BatchModel(body_of_cells(model.shape, model.mass, model.friction), 0.2)]
    one = pushes_of(np.random.default_rng(0), 1)
    with pytest.raises(InputError, match="no pushes"):
        rollouts(model.shape, whole, [], step=1 / 80)
    other = BatchPush(PusherPath(one[0].pusher.time, one[0].pusher.position, 0.01), *one[0][1:])
    with pytest.raises(InputError, match="differ in their pusher"):
        rollouts(model.shape, whole, [*one, other], step=1 / 80)


def test_a_surface_beside_its_outline_is_that_of_the_effect() -> None:
    model, pushes = models()[0], pushes_of(np.random.default_rng(2), 12)
    body, numerics = body_of_cells(model.shape, model.mass, model.friction), SimulationSettings(step=1 / 240, resolve_events=True)
    offsets = (1.5e-3, -1.5e-3)
    batch = [BatchModel(body, model.pusher_friction, offset) for offset in offsets]
    found = rollouts(model.shape, batch, pushes, step=1 / 240)
    for poses, offset in zip(found, offsets, strict=True):
        for pose, push in zip(poses, pushes, strict=True):
            scenario = PushScenario(push.pusher, push.pose_object_in_table, push.time)
            single = simulate_body(
                model.shape, body, model.pusher_friction, scenario, settings=numerics, effects={"outline_error": [offset]}
            )
            np.testing.assert_allclose(pose, single.pose, atol=1e-9)


@pytest.mark.parametrize("name", OF_MOTION)
def test_effects_act_as_in_single_simulations(name: str) -> None:
    model, rng = models()[0], np.random.default_rng(5)
    pushes = [BatchPush(moved(POSE, push.pusher), POSE, push.time) for push in pushes_of(rng, 5)]
    body, numerics = body_of_cells(model.shape, model.mass, model.friction), SimulationSettings(step=1 / 120, resolve_events=True)
    sizes = [effect_values({name: [scale * p.typical + p.nominal for p in EFFECTS[name].parameters]}) for scale in (0.5, 1.0)]
    batch = [BatchModel(body, model.pusher_friction, effects=own) for own in sizes]
    found = rollouts(model.shape, batch, pushes, step=1 / 120)
    for poses, own in zip(found, sizes, strict=True):
        for pose, push in zip(poses, pushes, strict=True):
            scenario = PushScenario(push.pusher, POSE, push.time)
            single = simulate_body(model.shape, body, model.pusher_friction, scenario, settings=numerics, effects=own)
            np.testing.assert_array_equal(pose, single.pose)
