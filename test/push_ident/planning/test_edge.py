"""Goals at the edge of the table: what holds the object, the pre-grasp pose, refusals, and pushes that keep it on the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from push_ident.errors import InputError
from push_ident.geometry.se2 import compose, inverse, transform_points
from push_ident.identification.result import prior_posterior
from push_ident.physics.batch import BatchPush, rollouts
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.planning.edge_goal import EdgeGoal, pregrasp
from push_ident.planning.goal import Goal
from push_ident.planning.goal_code import GoalCode, GoalRefusedError
from push_ident.planning.hold import RISK, EdgeHold
from push_ident.planning.library import path_of
from push_ident.planning.planner import GoalPlanner, PlanStatus
from push_ident.pushing.push import PushSettings
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import true_model

SETTINGS = PushSettings(workspace=(-0.4, 0.5, -0.4, 0.4), pusher_radius=0.008, clearance=0.02)
MODEL = true_model(make_object("toolbox", 2))
CELLS = MODEL.shape.cells.centres
KNOWN = Belief.certain(MODEL)
CENTRE = KNOWN.mean.body.centre
EDGE = TableEdge(np.array([1.0, 0.0]), 0.3)
GOAL = EdgeGoal(EDGE)
SURE = np.diag([3e-4, 3e-4, 3e-3]) ** 2
START = np.array([0.1, 0.03, 2.0])


def test_margin_is_the_distance_from_the_border_of_the_support() -> None:
    for x in (0.1, 0.28, 0.3, 0.33, 0.36):
        pose = np.array([x, 0.0, 0.7])
        on = CELLS[EDGE.beyond(transform_points(pose, CELLS)) <= 0.0]
        equations = ConvexHull(on).equations
        exact = -float(np.max(equations[:, :2] @ CENTRE + equations[:, 2]))
        found = float(EdgeHold(EDGE).margins(CELLS, CENTRE, pose))
        assert found == pytest.approx(exact, rel=0.01, abs=3e-4) if exact > 0 else found < 0


def test_hold_is_the_same_seen_from_another_frame() -> None:
    frame, pose = np.array([0.05, -0.08, 0.6]), np.array([0.29, 0.02, 1.1])
    here, there = EdgeHold(EDGE), EdgeHold(EDGE).seen_from(frame)
    seen = compose(inverse(frame), pose)
    assert float(there.margins(CELLS, CENTRE, seen)) == pytest.approx(float(here.margins(CELLS, CENTRE, pose)), abs=1e-12)


def test_pregrasp_pose_overhangs_as_wanted_and_is_held() -> None:
    goal, hold = pregrasp(GOAL, KNOWN, START, SETTINGS)
    outline = transform_points(goal.pose, MODEL.shape.outline)
    assert float(np.max(EDGE.beyond(outline))) == pytest.approx(GOAL.overhang, abs=1e-9)
    assert float(hold.margins(CELLS, CENTRE, goal.pose)) >= GOAL.held
    assert (goal.position, goal.yaw) == (GOAL.position, GOAL.turn)
    turned, _ = pregrasp(replace(GOAL, yaw=0.4), KNOWN, START, SETTINGS)
    assert turned.pose[2] == 0.4


@pytest.mark.parametrize(
    ("goal", "belief", "code", "word"),
    [
        (replace(GOAL, edge=None), KNOWN, GoalCode.INVALID_GOAL, "edge is not known"),
        (replace(GOAL, edge=TableEdge(np.array([1.0, 0.0]), 0.9)), KNOWN, GoalCode.OUTSIDE_WORKSPACE, "widen the workspace"),
        (replace(GOAL, overhang=0.13), KNOWN, GoalCode.UNREACHABLE, "less overhang"),
        (replace(GOAL, held=0.05), Belief.of(prior_posterior(MODEL.shape)), GoalCode.UNREACHABLE, "few times more"),
    ],
)
def test_goals_at_the_edge_that_cannot_be_are_refused_with_a_code(goal: EdgeGoal, belief: Belief, code: GoalCode, word: str) -> None:
    with pytest.raises(GoalRefusedError, match=word) as refusal:
        pregrasp(goal, belief, START, SETTINGS)
    assert refusal.value.code is code


def test_numbers_of_the_goal_are_checked() -> None:
    for values in ({"overhang": np.nan}, {"overhang": 0.0}, {"held": -0.01}, {"yaw": np.inf}):
        with pytest.raises(InputError, match="at the edge"):
            EdgeGoal(EDGE, **values)
    with pytest.raises(InputError, match="held by"):
        EdgeHold(EDGE, np.nan)


def test_known_object_is_pushed_out_over_the_edge_and_held_on_the_way() -> None:
    goal, hold = pregrasp(GOAL, KNOWN, START, SETTINGS)
    planner, pose = GoalPlanner(MODEL.shape, SETTINGS), START
    for _ in range(8):
        plan = planner.plan(KNOWN, pose, SURE, goal, hold=hold)
        if plan.plan is None:
            break
        assert plan.risk <= RISK
        path = path_of(plan.plan.tool_at_contact, plan.plan.heading, plan.plan.distance, plan.plan.speed, SETTINGS)
        push = [BatchPush(path, pose, np.linspace(0.0, path.time[-1], 20))]
        way = rollouts(MODEL.shape, KNOWN.models(0, np.random.default_rng(0)), push, step=1 / 480, edge=EDGE)[0, 0]
        assert float(np.min(hold.margins(CELLS, CENTRE, way))) > 0.8 * hold.margin
        pose = way[-1]
    assert plan.status is PlanStatus.ARRIVED and goal.relative_error(pose) <= 1.0
    assert float(np.max(EDGE.beyond(transform_points(pose, MODEL.shape.outline)))) > 0.02


def test_what_is_not_known_is_not_risked() -> None:
    """From the same place a known object is pushed to its goal, and an unknown one nowhere near."""
    goal = Goal(pregrasp(GOAL, KNOWN, START, SETTINGS)[0].pose, 0.005, 0.1)
    hold, start = EdgeHold(EDGE, 0.03), goal.pose - [0.03, 0.0, 0.0]
    planner = GoalPlanner(MODEL.shape, SETTINGS)
    known, unknown = (planner.plan(belief, start, SURE, goal, hold=hold) for belief in (KNOWN, Belief.of(prior_posterior(MODEL.shape))))
    assert known.status is PlanStatus.PUSH and known.chance > 0.8 and known.risk <= RISK
    assert unknown.plan is None or (unknown.chance < 0.1 and unknown.risk <= RISK)


def test_who_looks_one_push_ahead_proposes_what_ends_nearest() -> None:
    goal = Goal(np.array([0.0, 0.1, -1.5]))
    greedy, planner = GoalPlanner(MODEL.shape, SETTINGS, greedy=True), GoalPlanner(MODEL.shape, SETTINGS)
    ends = [own.plan(KNOWN, START, SURE, goal).end for own in (greedy, planner)]
    left = [float(np.linalg.norm((goal.pose - end) / goal.tolerance)) for end in ends]
    assert left[0] <= left[1]
