"""Paths: what is refused, where a pose is on a path, and a known object that follows one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.physics.batch import BatchPush, rollouts
from push_ident.planning.belief import Belief
from push_ident.planning.goal import GoalCode, GoalRefusedError
from push_ident.planning.library import path_of
from push_ident.planning.path_goal import PathGoal, check_path, read_path
from push_ident.planning.path_planner import PathPlanner, PathStatus
from push_ident.planning.path_steps import PathSteps
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array
from push_ident_sim.studies.common.objects import plate, random_object

SETTINGS = PushSettings(workspace=(-0.4, 0.4, -0.4, 0.4), pusher_radius=0.008, clearance=0.02)
MODEL = random_object(np.random.default_rng(7))
KNOWN = Belief.certain(MODEL)
LINE = PathGoal(np.array([[-0.1, 0.0, 0.4], [0.1, 0.05, 0.4]]), speed=0.1)
PLANNER = PathPlanner(MODEL.shape, SETTINGS, LINE.speed)


def after(pose: Float64Array, plan: PushPlan2D) -> Float64Array:
    path = path_of(plan.tool_at_contact, plan.heading, plan.distance, plan.speed, SETTINGS)
    push = [BatchPush(path, pose, np.linspace(0.0, path.time[-1], 30))]
    return rollouts(MODEL.shape, KNOWN.models(0, np.random.default_rng(0)), push, step=1 / 480)[0, 0]


def test_known_object_follows_a_line_in_few_contacts_and_stays_near_it() -> None:
    pose, done, way = LINE.poses[0], 0.0, []
    for _ in range(8):
        plan = PLANNER.plan(KNOWN, pose, LINE, done)
        if plan.plan is None:
            break
        assert plan.plan.speed == LINE.speed and plan.expected_done > plan.done >= done
        poses = after(pose, plan.plan)
        pose, done = poses[-1], plan.done
        way.append(poses)
    assert plan.status is PathStatus.ARRIVED and 1 < len(way) <= 7
    _, error = LINE.error(np.concatenate(way), 0.0, LINE.length)
    assert np.sqrt(np.mean(error[:, 0] ** 2)) < 0.006 and np.sqrt(np.mean(error[:, 1] ** 2)) < np.radians(6.0)


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["left", "right"])
def test_object_far_beside_its_path_is_brought_back_before_it_goes_on(side: float) -> None:
    middle = LINE.at(LINE.length / 2)
    across = float(LINE.direction(LINE.length / 2)) + side * np.pi / 2
    pose, done = middle + np.array([0.04 * np.cos(across), 0.04 * np.sin(across), side * 0.117]), LINE.length / 2
    for _ in range(2):
        plan = PLANNER.plan(KNOWN, pose, LINE, done)
        assert plan.plan is not None
        pose, done = after(pose, plan.plan)[-1], plan.done
    place, error = LINE.error(pose, done, 0.1)
    assert error[0] < 0.006 and error[1] < np.radians(5.0)
    # A part of the way that pushes along the path would have taken.
    assert place < LINE.length / 2 + 0.04


def test_failed_pushes_are_not_repeated_and_none_is_proposed_out_of_reach() -> None:
    first = PLANNER.plan(KNOWN, LINE.poses[0], LINE, 0.0).plan
    assert first is not None
    second = PLANNER.plan(KNOWN, LINE.poses[0], LINE, 0.0, failed=[first]).plan
    assert second is not None and np.linalg.norm(second.contact_point - first.contact_point) > 0.003
    away = PathPlanner(MODEL.shape, replace(SETTINGS, workspace=(1.0, 2.0, 1.0, 2.0)), LINE.speed)
    assert away.plan(KNOWN, LINE.poses[0], LINE, 0.0).status is PathStatus.UNREACHABLE


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
    settings, belief = PushSettings(workspace=(-0.5, 0.5, -0.5, 0.5), pusher_radius=0.008, clearance=0.02), Belief.certain(model)
    steps = PathSteps(model.shape, settings, 0.06)
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
