"""Pushes towards a goal: exact derivatives, goals that are reached in closed loop, and what the planner refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.se2 import compose, inverse, transform_points
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.effect_values import EffectsLike
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.planning.belief import Belief
from push_ident.planning.goal import Goal
from push_ident.planning.library import Library, path_of, strokes
from push_ident.planning.planner import GoalPlanner, PlanStatus
from push_ident.planning.refine import end_by_push, refine
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array, ObjectModel
from push_ident_sim.studies.common.objects import random_object

SETTINGS = PushSettings(workspace=(-0.6, 0.6, -0.6, 0.6), pusher_radius=0.008, clearance=0.02)
SURE = np.diag([2e-4, 2e-4, 1e-3]) ** 2
MODEL = random_object(np.random.default_rng(7))
PLANNER = GoalPlanner(MODEL.shape, SETTINGS)


def after(model: ObjectModel, pose: Float64Array, plan: PushPlan2D, effects: EffectsLike | None = None) -> Float64Array:
    """Pose after a push, by fine steps."""
    path = path_of(plan.tool_at_contact, plan.heading, plan.distance, plan.speed, SETTINGS)
    numerics = SimulationSettings(step=1 / 960, resolve_events=True)
    return simulate(model, PushScenario(path, pose, path.time[-1:]), settings=numerics, effects=effects).pose[-1]


def test_derivative_by_contact_and_direction_is_exact_in_sliding_contact() -> None:
    belief, own = Belief.certain(MODEL), strokes(MODEL.shape, SETTINGS)
    sliding = 0
    for number in range(0, len(own), len(own) // 12):
        stroke = own.picked(number)
        end, by_push = end_by_push(belief, stroke, 0.05, SETTINGS)
        assert end is not None and by_push is not None
        d = 2e-6
        for column, change in enumerate(((d, 0.0), (0.0, d))):
            ends = [end_by_push(belief, stroke.changed(*(sign * np.array(change))), 0.05, SETTINGS)[0] for sign in (1.0, -1.0)]
            difference = (ends[0] - ends[1]) / (2 * d)
            np.testing.assert_allclose(by_push[:, column], difference, rtol=2e-3, atol=2e-3)
        sliding += abs(stroke.direction_from_normal) > np.arctan(MODEL.pusher_friction)
    assert sliding >= 3


def test_refined_push_ends_nearer_to_the_goal() -> None:
    """Where neither the end of an edge nor the cone is in the way, the mean model ends at the goal."""
    belief, own = Belief.certain(MODEL), strokes(MODEL.shape, SETTINGS)
    left = []
    for number in range(5, len(own), len(own) // 8):
        end, _ = end_by_push(belief, own.picked(number), 0.06, SETTINGS)
        assert end is not None
        wanted = Goal(end + np.array([0.004, -0.003, 0.05]), 0.002, 0.02)
        better = refine(belief, own.picked(number), 0.06, wanted, SETTINGS)
        if better is not None:
            before, after = (np.linalg.norm((pose - wanted.pose) / wanted.tolerance) for pose in (end, better.motion))
            left.append(after / before)
    assert len(left) >= 6 and max(left) < 1.0
    assert np.sum(np.array(left) < 0.01) >= 2


@pytest.mark.parametrize("wanted", [(0.05, 0.02, 0.3), (-0.1, 0.12, 2.5), (0.0, 0.004, -0.2)])
def test_known_object_reaches_its_goal(wanted: tuple[float, float, float]) -> None:
    goal, pose, belief = Goal(np.array(wanted), 0.005, np.radians(2.0)), np.zeros(3), Belief.certain(MODEL)
    for _ in range(6):
        plan = PLANNER.plan(belief, pose, SURE, goal)
        if plan.plan is None:
            break
        pose = after(MODEL, pose, plan.plan)
        if plan.chance > 0.5:
            assert np.linalg.norm((pose - plan.end)[:2]) < 0.002
    assert plan.status is PlanStatus.ARRIVED and goal.relative_error(pose) <= 1.0


def test_unknown_object_expects_what_it_cannot_know() -> None:
    belief = Belief.of(prior_posterior(MODEL.shape))
    goal = Goal(np.array([0.08, 0.05, 0.6]), 0.005, np.radians(2.0))
    unknown, known = PLANNER.plan(belief, np.zeros(3), SURE, goal), PLANNER.plan(Belief.certain(MODEL), np.zeros(3), SURE, goal)
    assert unknown.status is known.status is PlanStatus.PUSH
    assert unknown.expected_pushes > known.expected_pushes
    assert np.std(unknown.ends[:, 2]) > 3 * np.std(known.ends[:, 2])


def test_error_of_the_pose_displaces_the_contact() -> None:
    """A known object whose heading is known too turns otherwise where the tool touches it elsewhere than planned."""
    goal = Goal(np.array([0.08, 0.05, 0.6]))
    plan = PLANNER.plan(Belief.certain(MODEL), np.zeros(3), np.diag([2e-3, 2e-3, 1e-5]) ** 2, goal)
    assert np.std(plan.ends[:, 2]) > 5e-3


def test_plan_turns_with_the_object() -> None:
    belief, pose = Belief.certain(MODEL), np.array([0.1, -0.05, 1.0])
    goal = Goal(np.array([0.05, 0.03, 0.4]), 0.01, 0.05)
    here = PLANNER.plan(belief, np.zeros(3), SURE, goal)
    # A covariance that is the same in all directions turns with the object too.
    there = PLANNER.plan(belief, pose, SURE, replace(goal, pose=compose(pose, goal.pose)))
    assert here.plan is not None and there.plan is not None
    np.testing.assert_allclose(compose(inverse(pose), there.end), here.end, atol=2e-3)


def test_goal_that_is_reached_and_pose_that_is_too_uncertain() -> None:
    belief, goal = Belief.certain(MODEL), Goal(np.array([0.001, 0.0, 0.0]), 0.005, 0.05)
    assert PLANNER.plan(belief, np.zeros(3), SURE, goal).status is PlanStatus.ARRIVED
    assert PLANNER.plan(belief, np.array([0.05, 0.0, 0.0]), SURE * 400, goal).status is PlanStatus.UNSURE


def test_pushes_stay_within_the_workspace_and_failed_ones_are_not_repeated() -> None:
    settings = replace(SETTINGS, workspace=(-0.2, 0.2, -0.2, 0.2))
    planner, belief = GoalPlanner(MODEL.shape, settings), Belief.certain(MODEL)
    pose, goal = np.array([0.1, 0.1, 0.3]), Goal(np.array([0.12, -0.12, -0.5]))
    failed: list[PushPlan2D] = []
    for _ in range(4):
        plan = planner.plan(belief, pose, SURE, goal, failed=failed).plan
        assert plan is not None
        assert settings.excess(np.array([plan.tool_start(settings.clearance), plan.tool_end])) == 0.0
        assert all(np.linalg.norm(plan.contact_point - other.contact_point) > 0.003 for other in failed)
        failed.append(plan)


def test_walled_in_object_is_unreachable() -> None:
    outline = transform_points(np.zeros(3), MODEL.shape.outline)
    low, high = outline.min(axis=0) - 0.012, outline.max(axis=0) + 0.012
    walls = [
        np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        for x0, y0, x1, y1 in (
            (low[0] - 0.05, low[1] - 0.05, low[0], high[1] + 0.05),
            (high[0], low[1] - 0.05, high[0] + 0.05, high[1] + 0.05),
            (low[0] - 0.05, low[1] - 0.05, high[0] + 0.05, low[1]),
            (low[0] - 0.05, high[1], high[0] + 0.05, high[1] + 0.05),
        )
    ]
    plan = PLANNER.plan(Belief.certain(MODEL), np.zeros(3), SURE, Goal(np.array([0.2, 0.0, 0.0])), obstacles=walls)
    assert plan.status is PlanStatus.UNREACHABLE and plan.plan is None


def test_goal_checks_its_numbers() -> None:
    with pytest.raises(InputError, match="three finite numbers"):
        Goal(np.array([0.0, np.nan, 0.0]))
    with pytest.raises(InputError, match="tolerance of the yaw"):
        Goal(np.zeros(3), yaw=0.0)


def test_chance_agrees_with_the_distribution() -> None:
    goal = Goal(np.array([0.0, 0.0, np.pi - 0.01]), 0.01, 0.05)
    drawn = np.random.default_rng(5).normal(size=(40_000, 3)) * [0.008, 0.004, 0.03] + [0.002, 0.0, np.pi + 0.01]
    covariance = np.diag([0.008, 0.004, 0.03]) ** 2
    assert goal.chance(np.array([0.002, 0.0, np.pi + 0.01]), covariance) == pytest.approx(
        np.mean(goal.relative_error(drawn) <= 1.0), abs=0.03
    )


def test_a_camera_elsewhere_changes_no_push_of_the_arm() -> None:
    camera, pose, goal = np.array([4e-3, -3e-3, 0.02]), np.array([0.02, -0.05, 1.0]), Goal(np.array([0.05, 0.03, 0.4]), 0.01, 0.05)
    sure = 1e-8 * np.eye(3)
    plain = PLANNER.plan(Belief.certain(MODEL), pose, sure, goal)
    displaced = replace(Belief.certain(MODEL), camera=camera)
    seen = PLANNER.plan(displaced, compose(camera, pose), sure, replace(goal, pose=compose(camera, goal.pose)))
    assert plain.plan is not None and seen.plan is not None
    np.testing.assert_allclose(seen.plan.contact_point, plain.plan.contact_point, atol=1e-6)
    np.testing.assert_allclose(seen.end, compose(camera, plain.end), atol=1e-6)


def test_what_pushes_show_of_the_camera_is_part_of_the_belief() -> None:
    prior = Prior(camera_position_std=2e-3, camera_heading_std=5e-3)
    posterior = prior_posterior(MODEL.shape, prior)
    z = posterior.z.copy()
    z[posterior.unknowns.slices["effects"]] = 1.0
    belief = Belief.of(replace(posterior, z=z))
    assert np.linalg.norm(belief.camera[:2]) == pytest.approx(np.hypot(2e-3, 2e-3)) and belief.camera[2] == pytest.approx(5e-3)
    assert belief.mean.effects.names == ()


def test_pushes_are_planned_with_the_effects_of_the_table() -> None:
    """Where the object lies, in its heading; after a turn the library is another one."""
    effects = {"table_tilt": [0.08, -0.05]}
    belief, pose, goal = Belief.certain(MODEL, effects), np.array([0.1, -0.05, 1.0]), Goal(np.array([0.14, -0.02, 1.3]), 0.005, 0.05)
    known, unknown = PLANNER.plan(belief, pose, SURE, goal), PLANNER.plan(Belief.certain(MODEL), pose, SURE, goal)
    assert known.plan is not None and unknown.plan is not None
    error = [float(goal.relative_error(after(MODEL, pose, plan, effects))) for plan in (known.plan, unknown.plan)]
    assert known.chance > 0.9 and error[0] < 0.5 and error[1] > 2 * error[0]
    library = Library.of(belief, strokes(MODEL.shape, SETTINGS).picked(0), SETTINGS, pose, 0, np.random.default_rng(0))
    near, turned = (pose + np.array([0.0, 0.0, turn]) for turn in (0.05, 0.5))
    assert library.holds_at(belief, near) and not library.holds_at(belief, turned)
    assert library.holds_at(Belief.certain(MODEL), turned)


def test_a_lag_that_is_over_at_rest_changes_no_plan() -> None:
    assert Belief.certain(MODEL, {"pusher_lag": [0.05]}).mean.effects.names == ()
    assert Belief.certain(MODEL, {"tool_offset": [2e-3, 0.0]}).mean.effects.names == ("tool_offset",)
