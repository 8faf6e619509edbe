"""Pushes towards a goal and along a path: exact derivatives, goals that are reached in closed loop, and what the planners refuse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import square, uniform
from push_ident.errors import InputError, PlanningError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import compose, transform_points
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.batch import BatchPush, rollouts
from push_ident.physics.effect_values import EffectsLike
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.planning.belief import Belief
from push_ident.planning.goal import Goal, GoalCode, GoalRefusedError
from push_ident.planning.keep_out import distance_between
from push_ident.planning.library import Library, path_of, strokes
from push_ident.planning.obstacle import RISK
from push_ident.planning.path_goal import PathGoal, check_path, read_path
from push_ident.planning.path_planner import PathPlanner, PathStatus
from push_ident.planning.path_steps import PathSteps
from push_ident.planning.planner import GoalPlanner, PlanStatus, end_by_push, refine
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array, ObjectModel, ObjectShape
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import true_model
from push_ident_sim.studies.common.objects import plate, random_object

SETTINGS = PushSettings(workspace=(-0.6, 0.6, -0.6, 0.6), pusher_radius=0.008, clearance=0.02)
SURE = np.diag([2e-4, 2e-4, 1e-3]) ** 2
MODEL = random_object(np.random.default_rng(7))
KNOWN = Belief.certain(MODEL)
PLANNER = GoalPlanner(MODEL.shape, SETTINGS)


def after(model: ObjectModel, pose: Float64Array, plan: PushPlan2D, effects: EffectsLike | None = None) -> Float64Array:
    """Pose after a push, by fine steps."""
    path = path_of(plan.tool_at_contact, plan.heading, plan.distance, plan.speed, SETTINGS)
    numerics = SimulationSettings(step=1 / 960, resolve_events=True)
    return simulate(model, PushScenario(path, pose, path.time[-1:]), settings=numerics, effects=effects).pose[-1]


def test_derivative_by_contact_and_direction_is_exact_in_sliding_contact() -> None:
    own = strokes(MODEL.shape, SETTINGS)
    sliding = 0
    for number in range(0, len(own), len(own) // 12):
        stroke = own.picked(number)
        end, by_push = end_by_push(KNOWN, stroke, 0.05, SETTINGS)
        assert end is not None and by_push is not None
        d = 2e-6
        for column, change in enumerate(((d, 0.0), (0.0, d))):
            ends = [end_by_push(KNOWN, stroke.changed(*(sign * np.array(change))), 0.05, SETTINGS)[0] for sign in (1.0, -1.0)]
            difference = (ends[0] - ends[1]) / (2 * d)
            np.testing.assert_allclose(by_push[:, column], difference, rtol=2e-3, atol=2e-3)
        sliding += abs(stroke.direction_from_normal) > np.arctan(MODEL.pusher_friction)
    assert sliding >= 3


def test_refined_push_ends_nearer_to_the_goal() -> None:
    """Where neither the end of an edge nor the cone is in the way, the mean model ends at the goal."""
    own = strokes(MODEL.shape, SETTINGS)
    left = []
    for number in range(5, len(own), len(own) // 8):
        end, _ = end_by_push(KNOWN, own.picked(number), 0.06, SETTINGS)
        assert end is not None
        wanted = Goal(end + np.array([0.004, -0.003, 0.05]), 0.002, 0.02)
        better = refine(KNOWN, own.picked(number), 0.06, wanted, SETTINGS)
        if better is not None:
            before, after = (np.linalg.norm((pose - wanted.pose) / wanted.tolerance) for pose in (end, better.motion))
            left.append(after / before)
    assert len(left) >= 6 and max(left) < 1.0
    assert np.sum(np.array(left) < 0.01) >= 2


@pytest.mark.parametrize("wanted", [(-0.1, 0.12, 2.5), (0.0, 0.004, -0.2)])
def test_known_object_reaches_its_goal(wanted: tuple[float, float, float]) -> None:
    goal, pose = Goal(np.array(wanted), 0.005, np.radians(2.0)), np.zeros(3)
    for _ in range(6):
        plan = PLANNER.plan(KNOWN, pose, SURE, goal)
        if plan.plan is None:
            break
        pose = after(MODEL, pose, plan.plan)
        if plan.chance > 0.5:
            assert np.linalg.norm((pose - plan.end)[:2]) < 0.002
    assert plan.status is PlanStatus.ARRIVED and goal.relative_error(pose) <= 1.0


def test_unknown_object_expects_what_it_cannot_know() -> None:
    goal = Goal(np.array([0.08, 0.05, 0.6]), 0.005, np.radians(2.0))
    unknown, known = (PLANNER.plan(belief, np.zeros(3), SURE, goal) for belief in (Belief.of(prior_posterior(MODEL.shape)), KNOWN))
    assert unknown.status is known.status is PlanStatus.PUSH
    assert np.std(unknown.ends[:, 2]) > 3 * np.std(known.ends[:, 2])

    # An error of the pose displaces the contact: a known object whose heading is known too turns otherwise.
    blurred = PLANNER.plan(KNOWN, np.zeros(3), np.diag([2e-3, 2e-3, 1e-5]) ** 2, goal)
    assert np.std(blurred.ends[:, 2]) > 5e-3


def test_pushes_stay_within_the_workspace_and_failed_ones_are_not_repeated() -> None:
    settings = replace(SETTINGS, workspace=(-0.2, 0.2, -0.2, 0.2))
    planner = GoalPlanner(MODEL.shape, settings)
    pose, goal = np.array([0.1, 0.1, 0.3]), Goal(np.array([0.12, -0.12, -0.5]))
    failed: list[PushPlan2D] = []
    for _ in range(3):
        plan = planner.plan(KNOWN, pose, SURE, goal, failed=failed).plan
        assert plan is not None
        assert settings.excess(np.array([plan.tool_start(settings.clearance), plan.tool_end])) == 0.0
        assert all(np.linalg.norm(plan.contact_point - other.contact_point) > 0.003 for other in failed)
        failed.append(plan)


def block(x0: float, y0: float, x1: float, y1: float) -> Float64Array:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def test_goals_that_are_reached_pose_that_is_too_uncertain_and_walls_have_a_status() -> None:
    near, far = Goal(np.array([0.001, 0.0, 0.0]), 0.005, 0.05), Goal(np.array([0.2, 0.0, 0.0]))
    assert PLANNER.plan(KNOWN, np.zeros(3), SURE, near).status is PlanStatus.ARRIVED
    assert PLANNER.plan(KNOWN, np.array([0.05, 0.0, 0.0]), SURE * 400, near).status is PlanStatus.UNSURE
    (x0, y0), (x1, y1) = MODEL.shape.outline.min(axis=0) - 0.012, MODEL.shape.outline.max(axis=0) + 0.012
    sides = ((x0 - 0.05, y0, x0, y1), (x1, y0, x1 + 0.05, y1), (x0 - 0.05, y0 - 0.05, x1 + 0.05, y0), (x0 - 0.05, y1, x1 + 0.05, y1 + 0.05))
    plan = PLANNER.plan(KNOWN, np.zeros(3), SURE, far, obstacles=[block(*side) for side in sides])
    assert plan.status is PlanStatus.BLOCKED and plan.plan is None


def test_object_is_pushed_around_a_block_in_its_way() -> None:
    """Tool and object stay clear of it, and what is shaped like a disc needs no turn for that."""
    around = np.linspace(0.0, 2 * np.pi, 17)[:-1]
    disc = uniform(square(5, 0.012), 0.5, 0.3)
    disc = replace(disc, shape=ObjectShape(disc.shape.cells, 0.034 * np.column_stack([np.cos(around), np.sin(around)])))
    planner, wall = GoalPlanner(disc.shape, SETTINGS), block(-0.01, -0.02, 0.01, 0.04)
    pose, goal, ways = np.array([-0.12, 0.0, 0.0]), Goal(np.array([0.12, 0.0, 0.0]), 0.01, np.pi), []
    for _ in range(8):
        plan = planner.plan(Belief.certain(disc), pose, SURE, goal, obstacles=[wall])
        if plan.plan is None:
            break
        assert np.min(signed_distance(np.linspace(plan.plan.tool_start(SETTINGS.clearance), plan.plan.tool_end, 30), wall)) > 0.0
        pose = after(disc, pose, plan.plan)
        ways.append(pose)
        assert np.min(signed_distance(transform_points(pose, disc.shape.outline), wall)) > 0.0
    assert plan.status is PlanStatus.ARRIVED and 2 <= len(ways) <= 7
    assert np.max(np.abs([way[1] for way in ways])) > 0.05


def test_object_is_brought_out_of_a_pocket_whose_bottom_is_before_the_goal() -> None:
    """The next push alone seems best against the bottom: only the way round leads back first."""
    around = np.linspace(0.0, 2 * np.pi, 17)[:-1]
    disc = uniform(square(5, 0.012), 0.5, 0.3)
    disc = replace(disc, shape=ObjectShape(disc.shape.cells, 0.034 * np.column_stack([np.cos(around), np.sin(around)])))
    planner, goal = GoalPlanner(disc.shape, SETTINGS), Goal(np.array([0.2, 0.0, 0.0]), 0.01, np.pi)
    pocket = [block(0.05, -0.16, 0.07, 0.16), block(-0.13, 0.14, 0.05, 0.16), block(-0.13, -0.16, 0.05, -0.14)]
    pose, ways = np.array([-0.02, 0.0, 0.0]), []
    for _ in range(10):
        plan = planner.plan(Belief.certain(disc), pose, SURE, goal, obstacles=pocket)
        if plan.plan is None:
            break
        pose = after(disc, pose, plan.plan)
        ways.append(pose)
        assert all(distance_between(transform_points(pose, disc.shape.outline), wall) > 0.0 for wall in pocket)
    assert plan.status is PlanStatus.ARRIVED and len(ways) <= 9
    assert min(way[0] for way in ways) < -0.1, "back out of it first"


def test_object_is_not_pushed_to_and_fro_where_each_push_out_seems_worse() -> None:
    """Between three blocks a push of 4 mm costs as much as any, and leaves what is expected: what it led to is remembered."""
    model = true_model(make_object("crimp", 300))
    planner, pose, goal = GoalPlanner(model.shape, SETTINGS), np.array([-0.08, -0.296, 3.123]), Goal(np.array([-0.104, -0.131, -2.223]))
    blocks = [
        np.array([[-0.011, -0.2], [0.058, -0.185], [0.045, -0.126], [-0.023, -0.141]]),
        np.array([[-0.021, 0.007], [0.028, -0.002], [0.037, 0.047], [-0.012, 0.056]]),
        np.array([[-0.235, -0.1], [-0.207, -0.047], [-0.233, -0.033], [-0.262, -0.086]]),
    ]
    lengths: list[float] = []
    for _ in range(8):
        plan = planner.plan(Belief.certain(model), pose, SURE, goal, blocks)
        if plan.plan is None:
            break
        pose = after(model, pose, plan.plan)
        lengths.append(plan.plan.distance)
    assert plan.status is PlanStatus.ARRIVED
    assert lengths[0] < 0.01, "the push that hardly moves it comes first: the case that this test is about"


def test_no_push_that_a_model_of_the_belief_leads_onto_an_obstacle_is_proposed() -> None:
    """What is known little needs more room: pushes beside a wall, simulated under models that the planner did not draw."""
    belief = Belief.of(prior_posterior(MODEL.shape))
    low, goal = float(MODEL.shape.outline[:, 1].min()), Goal(np.array([0.25, 0.0, 0.0]))
    wall, touched, n = block(-0.1, low - 0.05, 0.4, low - 0.02), 0, 0
    without, with_wall = (PLANNER.plan(belief, np.zeros(3), SURE, goal, outlines) for outlines in ((), [wall]))
    for plan, is_checked in ((without, False), (with_wall, True)):
        assert plan.plan is not None
        path = path_of(plan.plan.tool_at_contact, plan.plan.heading, plan.plan.distance, plan.plan.speed, SETTINGS)
        times = np.linspace(0.2, path.time[-1], 20)
        poses = rollouts(MODEL.shape, belief.models(100, np.random.default_rng(9)), [BatchPush(path, np.zeros(3), times)], step=0.01)
        gaps = [min(distance_between(transform_points(pose, MODEL.shape.outline), wall) for pose in ways) for ways in poses[:, 0]]
        touched, n = touched + is_checked * sum(gap < 0.0 for gap in gaps), n + is_checked * len(gaps)
        if not is_checked:
            assert min(gaps) < 0.0, "the wall is in the way of what is planned without it"
    assert n == 101 and touched <= 3  # 1 % are expected at most
    assert with_wall.touch <= RISK and without.touch == 0.0


def test_random_push_beside_an_obstacle_keeps_object_and_tool_clear_of_it() -> None:
    wall = block(0.09, -0.2, 0.12, 0.2)
    plans = [PLANNER.random_push(KNOWN, np.zeros(3), SURE, [wall], seed) for seed in range(6)]
    assert len({round(plan.direction, 3) for plan in plans}) > 3
    for plan in plans:
        line = np.linspace(plan.tool_start(SETTINGS.clearance), plan.tool_end, 30)
        assert np.min(signed_distance(line, wall)) > SETTINGS.pusher_radius - 1e-3
        assert distance_between(transform_points(after(MODEL, np.zeros(3), plan), MODEL.shape.outline), wall) > 0.0
        assert SETTINGS.distance_range[0] <= plan.distance <= SETTINGS.distance_range[1]
    (x0, y0), (x1, y1) = MODEL.shape.outline.min(axis=0) - 0.012, MODEL.shape.outline.max(axis=0) + 0.012
    ring = [block(x0 - 0.3, y0, x0, y1), block(x1, y0, x1 + 0.3, y1), block(x0, y0 - 0.3, x1, y0), block(x0, y1, x1, y1 + 0.3)]
    with pytest.raises(PlanningError, match="make room"):
        PLANNER.random_push(KNOWN, np.zeros(3), SURE, ring, 0)


def test_goal_checks_its_numbers_and_its_chance_agrees_with_the_distribution() -> None:
    with pytest.raises(InputError, match="three finite numbers"):
        Goal(np.array([0.0, np.nan, 0.0]))
    with pytest.raises(InputError, match="tolerance of the yaw"):
        Goal(np.zeros(3), yaw=0.0)
    goal, pose = Goal(np.array([0.0, 0.0, np.pi - 0.01]), 0.01, 0.05), np.array([0.002, 0.0, np.pi + 0.01])
    std = np.array([8e-3, 4e-3, 0.03])
    drawn = np.random.default_rng(5).normal(size=(40_000, 3)) * std + pose
    assert goal.chance(pose, np.diag(std) ** 2) == pytest.approx(np.mean(goal.relative_error(drawn) <= 1.0), abs=0.03)


def test_a_camera_elsewhere_changes_no_push_of_the_arm() -> None:
    camera, pose, goal = np.array([4e-3, -3e-3, 0.02]), np.array([0.02, -0.05, 1.0]), Goal(np.array([0.05, 0.03, 0.4]), 0.01, 0.05)
    sure = 1e-8 * np.eye(3)
    plain, displaced = PLANNER.plan(KNOWN, pose, sure, goal), replace(KNOWN, camera=camera)
    seen = PLANNER.plan(displaced, compose(camera, pose), sure, replace(goal, pose=compose(camera, goal.pose)))
    assert plain.plan is not None and seen.plan is not None
    np.testing.assert_allclose(seen.plan.contact_point, plain.plan.contact_point, atol=1e-6)
    np.testing.assert_allclose(seen.end, compose(camera, plain.end), atol=1e-6)
    # What pushes show of it is part of the belief.
    posterior = prior_posterior(MODEL.shape, Prior(camera_position_std=2e-3, camera_heading_std=5e-3))
    z = posterior.z.copy()
    z[posterior.unknowns.slices["effects"]] = 1.0
    belief = Belief.of(replace(posterior, z=z))
    assert np.linalg.norm(belief.camera[:2]) == pytest.approx(np.hypot(2e-3, 2e-3)) and belief.camera[2] == pytest.approx(5e-3)
    assert belief.mean.effects.names == ()


def test_pushes_are_planned_with_the_effects_of_the_table() -> None:
    """Where the object lies, in its heading; after a turn the library is another one."""
    effects = {"table_tilt": [0.08, -0.05]}
    belief, pose, goal = Belief.certain(MODEL, effects), np.array([0.1, -0.05, 1.0]), Goal(np.array([0.14, -0.02, 1.3]), 0.005, 0.05)
    known, unknown = PLANNER.plan(belief, pose, SURE, goal), PLANNER.plan(KNOWN, pose, SURE, goal)
    assert known.plan is not None and unknown.plan is not None
    error = [float(goal.relative_error(after(MODEL, pose, plan, effects))) for plan in (known.plan, unknown.plan)]
    assert known.chance > 0.9 and error[0] < 0.5 and error[1] > 2 * error[0]
    library = Library.of(belief, strokes(MODEL.shape, SETTINGS).picked(0), SETTINGS, pose, 0, np.random.default_rng(0))
    near, turned = (pose + np.array([0.0, 0.0, turn]) for turn in (0.05, 0.5))
    assert library.holds_at(belief, near) and not library.holds_at(belief, turned)
    assert library.holds_at(KNOWN, turned)
    # A lag that is over at rest changes no plan.
    assert Belief.certain(MODEL, {"pusher_lag": [0.05]}).mean.effects.names == ()
    assert Belief.certain(MODEL, {"tool_offset": [2e-3, 0.0]}).mean.effects.names == ("tool_offset",)


# --- along a path


LINE = PathGoal(np.array([[-0.1, 0.0, 0.4], [0.1, 0.05, 0.4]]), speed=0.1)
PATHS = PathPlanner(MODEL.shape, SETTINGS, LINE.speed)


def way_of(pose: Float64Array, plan: PushPlan2D) -> Float64Array:
    path = path_of(plan.tool_at_contact, plan.heading, plan.distance, plan.speed, SETTINGS)
    push = [BatchPush(path, pose, np.linspace(0.0, path.time[-1], 30))]
    return rollouts(MODEL.shape, KNOWN.models(0, np.random.default_rng(0)), push, step=1 / 480)[0, 0]


def test_known_object_follows_a_line_in_few_contacts_and_stays_near_it() -> None:
    pose, done, way = LINE.poses[0], 0.0, []
    for _ in range(8):
        plan = PATHS.plan(KNOWN, pose, LINE, done)
        if plan.plan is None:
            break
        assert plan.plan.speed == LINE.speed and plan.expected_done > plan.done >= done
        poses = way_of(pose, plan.plan)
        pose, done = poses[-1], plan.done
        way.append(poses)
    assert plan.status is PathStatus.ARRIVED and 1 < len(way) <= 7
    _, error = LINE.error(np.concatenate(way), 0.0, LINE.length)
    assert np.sqrt(np.mean(error[:, 0] ** 2)) < 0.006 and np.sqrt(np.mean(error[:, 1] ** 2)) < np.radians(6.0)


def test_object_far_beside_its_path_is_brought_back_before_it_goes_on() -> None:
    across, done = float(LINE.direction(LINE.length / 2)) + np.pi / 2, LINE.length / 2
    pose = LINE.at(done) + np.array([0.04 * np.cos(across), 0.04 * np.sin(across), 0.117])
    for _ in range(2):
        plan = PATHS.plan(KNOWN, pose, LINE, done)
        assert plan.plan is not None
        pose, done = way_of(pose, plan.plan)[-1], plan.done
    place, error = LINE.error(pose, done, 0.1)
    assert error[0] < 0.006 and error[1] < np.radians(5.0)
    # A part of the way that pushes along the path would have taken.
    assert place < LINE.length / 2 + 0.04


def test_place_on_a_path_that_crosses_itself_is_the_one_that_comes_next() -> None:
    angle = np.linspace(0.0, 2 * np.pi, 100)
    loop = 0.06 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    eight = PathGoal(np.vstack([np.column_stack([loop, angle]), np.column_stack([loop[1:] * [1, -1], -angle[1:]])]))
    for place in (0.0, 0.25, 0.5):
        k = int(np.searchsorted(eight.along, place * eight.length))
        found, error = eight.error(eight.poses[k], eight.along[k] - 0.01, 0.1)
        assert float(found) == pytest.approx(eight.along[k], abs=1e-6) and np.max(error) < 1e-9


def test_what_cannot_be_followed_is_refused_with_a_code_and_a_remedy() -> None:
    check_path(LINE, MODEL.shape, SETTINGS)
    with pytest.raises(GoalRefusedError, match="shrink the path") as refusal:
        check_path(LINE, MODEL.shape, replace(SETTINGS, workspace=(-0.1, 0.1, -0.1, 0.1)))
    assert refusal.value.code is GoalCode.OUTSIDE_WORKSPACE
    turning = PathGoal(np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 1.5]]), speed=0.2)
    with pytest.raises(GoalRefusedError, match="go at 0.* m/s or less") as refusal:
        check_path(turning, MODEL.shape, SETTINGS)
    assert refusal.value.code is GoalCode.INVALID_GOAL
    first = PATHS.plan(KNOWN, LINE.poses[0], LINE, 0.0).plan
    assert first is not None
    second = PATHS.plan(KNOWN, LINE.poses[0], LINE, 0.0, failed=[first]).plan
    assert second is not None and np.linalg.norm(second.contact_point - first.contact_point) > 0.003, "what failed is not repeated"
    away = PathPlanner(MODEL.shape, replace(SETTINGS, workspace=(1.0, 2.0, 1.0, 2.0)), LINE.speed)
    assert away.plan(KNOWN, LINE.poses[0], LINE, 0.0).status is PathStatus.UNREACHABLE


def test_numbers_and_files_of_paths_are_checked(tmp_path: Path) -> None:
    for poses in (np.zeros((1, 3)), np.zeros((2, 2)), np.zeros((3, 3)), np.full((2, 3), np.nan)):
        with pytest.raises(InputError, match="path"):
            PathGoal(poses)
    with pytest.raises(InputError, match="speed"):
        PathGoal(LINE.poses, speed=0.0)
    file = tmp_path / "path.csv"
    file.write_text("# x, y, yaw\n0.0, 0.0, 0.1\n\n0.1, 0.0, 0.1\n", encoding="utf-8")
    np.testing.assert_allclose(read_path(file, 0.1).poses[[0, -1]], [[0.0, 0.0, 0.1], [0.1, 0.0, 0.1]])
    for text, word in (("0, 0, 0\n1, 2\n", "Line 2"), ("0, 0, x\n", "Line 1"), ("0, 0, inf\n", "Line 1"), ("", "no path")):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=word):
            read_path(file, 0.1)
    with pytest.raises(InputError, match="Cannot read"):
        read_path(tmp_path / "none.csv", 0.1)


def test_steered_pushes_are_chosen_where_a_face_holds_the_line_and_straight_ones_where_none_does() -> None:
    model = plate(8, 3)
    belief, steps = Belief.certain(model), PathSteps(model.shape, replace(SETTINGS, workspace=(-0.5, 0.5, -0.5, 0.5)), 0.06)
    ahead = PathGoal(np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]), 0.05, 0.003, 0.035)
    step = steps.plan(belief, ahead.poses[0], ahead, 0.0)
    assert step.steered is not None and step.follower is not None and step.expected_done > 0.05
    only = steps.plan(belief, ahead.poses[0], ahead, 0.0, steers=False)
    assert only.steered is None and only.straight is not None and only.contact is only.straight.plan
    # Turned by 45 degrees, no face of a square is across the line.
    beside = replace(ahead, poses=ahead.poses + np.array([0.0, 0.0, np.pi / 4]))
    held = steps.plan(belief, beside.poses[0], beside, 0.0)
    assert held.straight is not None and held.steered is None
    end = steps.plan(belief, ahead.poses[-1], ahead, ahead.length - 0.1)
    assert end.status is PathStatus.ARRIVED and end.contact is None and np.isnan(end.expected_done)
