"""Pushes that curve: what the tool does, how it is improved, and how a path is followed in one contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, rotation, transform_points, wrap_angle
from push_ident.physics.batch import BatchModel, BatchPush, ModelBatch, rollouts
from push_ident.physics.effect_values import effect_values
from push_ident.planning.belief import Belief
from push_ident.planning.curved import N_SEGMENTS, CurvedPushes, Horizon, PushStart, face_of
from push_ident.planning.curved_planner import CurvedPathPlanner, CurvedPush
from push_ident.planning.path_follower import ContactTracker, FollowerOptions, FollowStatus, ModelWeights
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PathStatus
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.tool_path import Corridor
from push_ident.types import Float64Array, ObjectModel, PusherPath
from push_ident_sim.studies.common.objects import plate, random_object

SETTINGS = PushSettings(workspace=(-0.5, 0.5, -0.5, 0.5), pusher_radius=0.008, clearance=0.02)
MODEL = plate(8, 3)
KNOWN = Belief.certain(MODEL)
ANGLE = np.linspace(0.0, 2.2, 100)
CIRCLE = PathGoal(np.column_stack([0.15 * np.sin(ANGLE), -0.15 * np.cos(ANGLE), ANGLE]), 0.15, 0.003, float(np.radians(2.0)))
PERIOD = 1.0 / 30.0
FRAME = np.diag([1e-6, 1e-6, 1e-4])


def planner_of(settings: PushSettings = SETTINGS, half_width: float = 0.08) -> CurvedPathPlanner:
    return CurvedPathPlanner(MODEL.shape, settings, n_models=1, n_asked=1, half_width=half_width)


@pytest.fixture(scope="module")
def planner() -> CurvedPathPlanner:
    return planner_of()


@pytest.fixture(scope="module")
def plan(planner: CurvedPathPlanner) -> CurvedPush:
    """The first push along the circle."""
    return planner.plan(KNOWN, CIRCLE.poses[0], CIRCLE, 0.0)


def known() -> ModelBatch:
    return ModelBatch(MODEL.shape, KNOWN.models(0, np.random.default_rng(0)), SETTINGS.pusher_radius)


def seen_from(pose: Float64Array, tool: Float64Array) -> Float64Array:
    return transform_points(inverse(pose), tool[None])[0]


class World:
    """The engine itself as the world, with a tool that moves piece by piece."""

    def __init__(self, model: ObjectModel, pose: Float64Array) -> None:
        self.pose, self.velocity = np.array(pose), np.zeros(3)
        self._model, self._own = model, Belief.certain(model).models(0, np.random.default_rng(0))

    def lead(self, time: Float64Array, tool: Float64Array) -> None:
        step = 1.0 / 240.0
        push = BatchPush(PusherPath(time, tool, SETTINGS.pusher_radius), self.pose, time[-1] - np.array([step, 0.0]), self.velocity)
        before, self.pose = rollouts(self._model.shape, self._own, [push], step=step)[0, 0]
        self.velocity = (self.pose - before) / step

    def gap(self, tool: Float64Array) -> float:
        return float(signed_distance(seen_from(self.pose, tool)[None], self._model.shape.outline)[0]) - SETTINGS.pusher_radius


def start_of(plan: CurvedPush) -> PushStart:
    assert plan.tool is not None
    face, _ = face_of(MODEL.shape.outline, seen_from(CIRCLE.poses[0], plan.tool[1]))
    return PushStart(CIRCLE.poses[0], np.zeros(3), 0.0, plan.tool[:2], face)


def test_tool_without_unknowns_moves_as_if_fixed_to_the_object_on_its_path_and_with_them_turns_and_speeds_up(plan: CurvedPush) -> None:
    start, horizon = start_of(plan), Horizon.of(CIRCLE.speed, 0.08, np.array([-0.2, 0.0]))
    changed = np.zeros((1, 2, N_SEGMENTS, 2))
    changed[0, 1, 0] = 0.5, 0.3
    fixed, turned = CurvedPushes(SETTINGS, CIRCLE).roll(known(), horizon, [start], changed).tool[0]
    poses = CIRCLE.at(CIRCLE.speed * horizon.knots[2:])
    seen, beside = ([seen_from(pose, at) for pose, at in zip(poses, tool[2:], strict=True)] for tool in (fixed, turned))
    np.testing.assert_allclose(seen, np.broadcast_to(seen[0], (len(poses), 2)), atol=1e-9)
    np.testing.assert_array_equal(fixed[:2], start.lead)
    # Along and across the path the tool moves by 0.5 and 0.3 of its speed while the first segment lasts, then no further.
    turn = rotation(CIRCLE.direction(0.0) - CIRCLE.poses[0, 2])
    np.testing.assert_allclose(beside[-1] - seen[0], CIRCLE.speed * horizon.breaks[1] * turn @ [0.5, 0.3], atol=1e-9)


def test_tool_that_would_be_too_fast_keeps_its_headings_at_the_largest_speed() -> None:
    fast = PathGoal(CIRCLE.poses, 0.8 * SETTINGS.max_speed)
    plan = planner_of().plan(KNOWN, CIRCLE.poses[0], fast, 0.0)
    start, horizon = start_of(plan), Horizon.of(fast.speed, 0.08, np.array([-0.1, 0.0]))
    wanted = np.zeros((1, 3, N_SEGMENTS, 2))
    wanted[0, 1, 0], wanted[0, 2, 0] = [0.9, 0.0], [-0.3, 0.0]
    free = CurvedPushes(replace(SETTINGS, max_speed=10.0), fast).roll(known(), horizon, [start], wanted).tool[0]
    held = CurvedPushes(SETTINGS, fast).roll(known(), horizon, [start], wanted).tool[0]
    np.testing.assert_array_equal(held[[0, 2]], free[[0, 2]])
    steps = [np.diff(path[1], axis=0)[1:] for path in (free, held)]
    speed = [np.linalg.norm(step, axis=1) / np.diff(horizon.knots)[1:] for step in steps]
    assert speed[0].max() > 1.2 * SETTINGS.max_speed
    np.testing.assert_allclose(speed[1], np.minimum(speed[0], SETTINGS.max_speed), rtol=1e-9)
    angle = [np.arctan2(step[:, 1], step[:, 0]) for step in steps]
    np.testing.assert_allclose(wrap_angle(angle[0] - angle[1]), 0.0, atol=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.01, 0.2])
def test_unknowns_of_a_later_look_ahead_are_the_same_motion(delay: float) -> None:
    horizon = Horizon.of(0.1, 0.08, np.array([-PERIOD, 0.0]))
    unknowns = np.random.default_rng(0).normal(size=(N_SEGMENTS, 2))
    moved = horizon.later(unknowns, delay)

    def offset(own: Float64Array, time: float) -> Float64Array:
        return np.asarray(np.clip(time - horizon.breaks[:-1], 0.0, np.diff(horizon.breaks)) @ own)

    for end in horizon.breaks[1:]:
        np.testing.assert_allclose(offset(moved, end), offset(unknowns, end + delay) - offset(unknowns, delay), atol=1e-12)


def test_improved_push_is_what_the_engine_makes_of_it_and_costs_less(plan: CurvedPush) -> None:
    pushes, horizon = CurvedPushes(SETTINGS, CIRCLE), Horizon.of(CIRCLE.speed, 0.08, np.array([-0.2, 0.0]))
    start, beside, models = start_of(plan), np.array([0.004, -0.005, 0.06]), known()
    start = replace(start, pose=start.pose + beside, lead=start.lead + beside[:2])
    nothing = np.zeros((1, 1, N_SEGMENTS, 2))
    best, rolled = pushes.improve(models, horizon, [start], nothing, 4)
    assert rolled.cost[0, 0] < 0.7 * pushes.roll(models, horizon, [start], nothing).cost[0, 0]
    world = World(MODEL, start.pose)
    world.lead(horizon.knots, rolled.tool[0, 0])
    np.testing.assert_allclose(world.pose[:2], rolled.poses[0, 0, 0, -1, :2], atol=1e-3)
    assert abs(world.pose[2] - rolled.poses[0, 0, 0, -1, 2]) < 0.02
    # Nothing near it is better: the derivative led to a minimum.
    near = best[:, None] + 0.15 * np.random.default_rng(1).normal(size=(1, 12, N_SEGMENTS, 2))
    assert np.min(pushes.roll(models, horizon, [start], near).cost) > 0.9 * rolled.cost[0, 0]
    # A push that is due at once is the best guess, simulated once.
    guesses = 0.1 * np.random.default_rng(0).normal(size=(1, 3, N_SEGMENTS, 2))
    best, rolled = pushes.improve(models, horizon, [start], guesses, 3, lambda: True)
    assert np.any(np.all(best[0] == guesses[0], axis=(1, 2)))
    assert rolled.cost[0, 0] == np.min(pushes.roll(models, horizon, [start], guesses).cost)


def follow(
    world: World, plan: CurvedPush, noise: float, knock: Float64Array | None = None, late: int = 0
) -> tuple[FollowStatus, Float64Array, list[float]]:
    """Follow the circle in one contact: how it ends, poses at the frames, shape (n, 3), and gaps [m]; `late` of three frames are due."""
    assert plan.time is not None and plan.tool is not None and plan.corridor is not None
    rng = np.random.default_rng(2)
    follower = planner_of().follower(KNOWN, CIRCLE, plan.corridor, PERIOD)
    follower.begin(plan.time, plan.tool, world.pose, FRAME, 0.0, plan.expected_error)
    now, poses, gaps = float(plan.time[1]), [], []
    world.lead(plan.time[:2], plan.tool[:2])
    for k in range(400):
        seen = world.pose + noise * np.sqrt(np.diag(FRAME)) * rng.normal(size=3)
        correction = follower.correct(now, seen, FRAME, lambda k=k: k % 3 < late)
        if correction.status is not FollowStatus.GOING:
            break
        at = np.array([now, now + PERIOD])
        tool = np.column_stack([np.interp(at, correction.time, column) for column in correction.tool.T])
        world.lead(at, tool)
        now += PERIOD
        poses.append(world.pose)
        gaps.append(world.gap(tool[1]))
        assert np.linalg.norm(tool[1] - tool[0]) / PERIOD < 1.02 * SETTINGS.max_speed
        if k == 15 and knock is not None:
            world.pose = world.pose + knock
    return correction.status, np.array(poses), gaps


@pytest.mark.parametrize(("late", "metres", "degrees"), [(0, 0.003, 2.0), (2, 0.004, 3.0)], ids=["in time", "two of three due at once"])
def test_object_is_kept_on_a_circle_in_one_contact_that_is_never_lost(plan: CurvedPush, late: int, metres: float, degrees: float) -> None:
    status, poses, gaps = follow(World(MODEL, CIRCLE.poses[0]), plan, noise=1.0, late=late)
    _, error = CIRCLE.error(poses, 0.0, CIRCLE.length)
    assert status is FollowStatus.ARRIVED and max(gaps[3:]) < 1e-3
    assert np.sqrt(np.mean(error[:, 0] ** 2)) < metres and np.sqrt(np.mean(error[:, 1] ** 2)) < np.radians(degrees)


def test_object_that_was_displaced_on_its_way_is_brought_back_by_the_same_contact(plan: CurvedPush) -> None:
    along = CIRCLE.direction(0.0)
    aside = np.array([np.cos(along + 1.0), np.sin(along + 1.0), 0.0]) * 0.01 + [0.0, 0.0, 0.1]
    status, poses, _ = follow(World(MODEL, CIRCLE.poses[0]), plan, 0.0, aside)
    _, error = CIRCLE.error(poses, 0.0, CIRCLE.length)
    assert status is FollowStatus.ARRIVED and np.max(error[:, 0]) > 0.005 and np.max(error[-15:, 0]) < 0.004


def test_tool_that_would_leave_its_corridor_is_said_so(plan: CurvedPush) -> None:
    far = planner_of(half_width=0.002).plan(KNOWN, CIRCLE.poses[0] + np.array([0.02, -0.02, 0.2]), CIRCLE, 0.0)
    for push in (plan, far):
        assert push.tool is not None and push.corridor is not None and np.max(push.corridor.excess(push.tool)) == 0.0
    assert plan.tool is not None
    ahead = Corridor(plan.tool[1] + np.outer([-1.0, 1.0], plan.tool[1] - plan.tool[0]), 0.004)
    status, poses, _ = follow(World(MODEL, CIRCLE.poses[0]), replace(plan, corridor=ahead), 0.0)
    assert status is FollowStatus.LEAVES and len(poses) < 60
    assert Corridor(np.array([[0.0, 0.0], [0.1, 0.0]]), 0.01).excess(np.array([[0.05, 0.005], [0.13, 0.04]])) == pytest.approx([0.0, 0.04])
    with pytest.raises(InputError, match="corridor"):
        Corridor(np.zeros((2, 2)), 0.0)


def test_contacts_that_failed_and_paths_out_of_reach_are_not_planned(planner: CurvedPathPlanner, plan: CurvedPush) -> None:
    assert plan.status is PathStatus.PUSH and isinstance(plan.contact, PushPlan2D) and plan.expected_done > 0.05
    second = planner.plan(KNOWN, CIRCLE.poses[0], CIRCLE, 0.0, failed=[plan.contact])
    assert second.contact is None or np.linalg.norm(second.contact.contact_point - plan.contact.contact_point) > 0.003
    away = planner_of(replace(SETTINGS, workspace=(1.0, 2.0, 1.0, 2.0)))
    assert away.plan(KNOWN, CIRCLE.poses[0], CIRCLE, 0.0).status is PathStatus.UNREACHABLE
    assert planner.plan(KNOWN, CIRCLE.poses[-1], CIRCLE, CIRCLE.length - 0.1).status is PathStatus.ARRIVED


TOUCHING = np.array([float(MODEL.shape.outline[:, 0].min()) - SETTINGS.pusher_radius, 0.01])
"""Axis of a tool that touches the object at the origin from the left."""


def tracker_of(models: ModelBatch) -> ContactTracker:
    return ContactTracker(models, SETTINGS.pusher_radius, np.zeros(3), FRAME)


def test_one_strange_frame_is_ignored_and_two_are_believed() -> None:
    tracker, tool, strange = tracker_of(known()), np.array([-0.2, 0.0]), np.array([0.03, 0.02, -0.3])
    tracker.observe(strange, FRAME, tool)
    np.testing.assert_allclose(tracker.pose, 0.0)
    for pose in (np.zeros(3), strange, strange):
        tracker.observe(pose, FRAME, tool)
    np.testing.assert_allclose(tracker.pose, strange)


def test_tool_is_never_believed_inside_the_object_nor_just_in_front_of_it_and_is_where_a_diagnosed_offset_says() -> None:
    for depth in (-0.002, 0.0008):
        tracker = tracker_of(known())
        face = tracker.observe(np.zeros(3), FRAME, TOUCHING - [depth, 0.0])
        np.testing.assert_allclose(tracker.pose, [-depth, 0.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(face.normal, [-1.0, 0.0], atol=1e-9)
        assert tracker.gap == 0.0 and face.is_open == (True, True) and float(wrap_angle(tracker.pose[2])) == 0.0
    offset, (own,) = np.array([0.004, -0.002]), known().models
    displaced = BatchModel(own.body, own.pusher_friction, effects=effect_values({"tool_offset": offset}))
    for model, at in ((own, TOUCHING), (displaced, TOUCHING - offset)):
        tracker = tracker_of(ModelBatch(MODEL.shape, [model], SETTINGS.pusher_radius))
        tracker.observe(np.zeros(3), FRAME, at)
        assert tracker.gap == 0.0
        np.testing.assert_allclose(tracker.pose, 0.0, atol=1e-9)


def test_models_that_do_not_explain_the_push_lose_their_weight_and_a_stretch_that_was_broken_off_decides_nothing() -> None:
    right: BatchModel = KNOWN.models(0, np.random.default_rng(0))[0]
    tilt = MODEL.shape.cells.centres[:, 1] * 6.0
    wrong = [BatchModel(replace(right.body, limit=right.body.limit * (1.0 + sign * tilt)), 0.3) for sign in (-1, 1)]
    first = TOUCHING + np.array([0.0, 0.02])
    face, _ = face_of(MODEL.shape.outline, first)
    for breaks in (False, True):
        weights = ModelWeights(MODEL.shape, [wrong[0], right, wrong[1]], SETTINGS.pusher_radius)
        world, tool = World(MODEL, np.zeros(3)), first
        weights.observe(np.array([-PERIOD, 0.0]), np.array([tool, tool]), world.pose, world.velocity, face)
        for k in range(12):
            time, way = np.array([k, k + 1]) * PERIOD, tool + np.array([[0.0, 0.0], [0.1 * PERIOD, 0.0]])
            world.lead(time, way)
            tool = way[1]
            if breaks and k % 4 == 3:
                weights.restart()
            weights.observe(time, way, world.pose, world.velocity, face)
        weights.work(all_of_it=True)
        assert (weights.best(1).models[0] is right) is not breaks
        assert np.ptp(weights.log_weight) == 0.0 if breaks else weights.log_weight[1] > np.sort(weights.log_weight)[1] + 1.0


def test_contact_is_judged_as_far_as_corrections_look() -> None:
    # With the heading beside the line no face holds this object; over its first 30 mm a contact costs least for each metre.
    line = PathGoal(np.array([[-0.12, 0.0, 0.5], [0.12, 0.0, 0.5]]), 0.05, 0.003, 0.035)
    model = random_object(np.random.default_rng(2))
    push = CurvedPathPlanner(model.shape, SETTINGS).plan(Belief.certain(model), line.poses[0], line, 0.0)
    assert push.status is PathStatus.PUSH and push.expected_done > FollowerOptions().look_ahead and push.expected_error > 2.0
