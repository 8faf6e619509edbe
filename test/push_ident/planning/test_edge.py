"""Goals at the edge of the table: what holds the object, the pre-grasp pose, refusals, and pushes that keep it on the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.se2 import compose, inverse, transform_points
from push_ident.geometry.table import Table
from push_ident.identification.results.posterior import prior_posterior
from push_ident.physics.batch import BatchPush, rollouts
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.planning.edge_goal import EdgeGoal, edge_target, edges_of, held_target, pregrasp
from push_ident.planning.goal import CERTAIN, EdgeHold, Goal, GoalCode, GoalRefusedError
from push_ident.planning.goal_session import push_on_table
from push_ident.planning.library import BATCH_STEP, path_of
from push_ident.planning.obstacle import RISK
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


def between(x: float, first: float, last: float) -> TableEdge:
    """The edge at x from y = first to y = last [m], with the table on the side of smaller x."""
    return TableEdge.between(np.array([x, first]), np.array([x, last]))


def test_margin_is_the_distance_from_the_border_of_the_support() -> None:
    for x in (0.1, 0.28, 0.3, 0.33, 0.36):
        pose = np.array([x, 0.0, 0.7])
        on = CELLS[EDGE.beyond(transform_points(pose, CELLS)) <= 0.0]
        equations = ConvexHull(on).equations
        exact = -float(np.max(equations[:, :2] @ CENTRE + equations[:, 2]))
        found = float(EdgeHold(EDGE).margins(CELLS, CENTRE, pose))
        assert found == pytest.approx(exact, rel=0.01, abs=3e-4) if exact > 0 else found < 0
    # It is the same seen from another frame.
    frame, pose = np.array([0.05, -0.08, 0.6]), np.array([0.29, 0.02, 1.1])
    here, there = EdgeHold(EDGE), EdgeHold(EDGE).in_frame(frame)
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
        (replace(GOAL, edge=None), KNOWN, GoalCode.EDGE_UNKNOWN, "edge is not known"),
        (replace(GOAL, edge=TableEdge(np.array([1.0, 0.0]), 0.9)), KNOWN, GoalCode.OUTSIDE_WORKSPACE, "widen the workspace"),
        (replace(GOAL, edge=between(0.3, 0.0, 0.1)), KNOWN, GoalCode.OUTSIDE_WORKSPACE, "ends of the edge"),
        (replace(GOAL, overhang=0.13), KNOWN, GoalCode.NOT_HELD, "less overhang"),
        (replace(GOAL, held=0.05), Belief.of(prior_posterior(MODEL.shape)), GoalCode.NOT_HELD, "few times more"),
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
    for numbers, word in (((np.nan,), "held by"), ((0.01, 0.0), "more than 0 and at most")):
        with pytest.raises(InputError, match=word):
            EdgeHold(EDGE, *numbers)
    for points in (((0.0, 0.0), (0.0, 0.005)), ((0.0, np.nan), (0.0, 0.5))):
        with pytest.raises(InputError, match="two finite points"):
            TableEdge.between(*np.array(points))


def test_known_object_is_pushed_out_over_the_edge_as_expected_and_held_on_the_way() -> None:
    known = Belief.certain(MODEL, {"table_anisotropy": [0.25, 0.15]})
    goal, hold = pregrasp(GOAL, known, START, SETTINGS)
    planner, pose = GoalPlanner(MODEL.shape, SETTINGS), START
    for _ in range(8):
        plan = planner.plan(known, pose, SURE, goal, hold=hold)
        if plan.plan is None:
            break
        assert plan.risk <= RISK
        path = path_of(plan.plan.tool_at_contact, plan.plan.heading, plan.plan.distance, plan.plan.speed, SETTINGS)
        push = [BatchPush(path, pose, np.linspace(0.0, path.time[-1], 20))]
        way = rollouts(MODEL.shape, known.models(0, np.random.default_rng(0)), push, step=BATCH_STEP, edge=EDGE)[0, 0]
        assert float(np.min(hold.margins(CELLS, CENTRE, way))) > 0.8 * hold.margin
        pose = way[-1]
        np.testing.assert_allclose(pose, plan.end, atol=1e-6)
    assert plan.status is PlanStatus.ARRIVED and goal.relative_error(pose) <= 1.0
    assert float(np.max(EDGE.beyond(transform_points(pose, MODEL.shape.outline)))) > 0.02


def test_object_stays_between_the_ends_of_the_edge_at_the_nearest_edge_that_can_be() -> None:
    assert between(0.3, -0.2, 0.2).beyond(np.array([0.35, 0.0])) == pytest.approx(0.05)
    ended = edge_target(replace(GOAL, edge=between(0.3, -0.4, -0.02)), [], KNOWN, START, SETTINGS)
    assert float(np.max(transform_points(ended.goal.pose, MODEL.shape.outline)[:, 1])) <= -0.02 + 1e-9
    # The nearest one is out of reach, the next nearest is taken.
    table = Table.rectangle(np.array([-0.4, 0.3, -0.9, 0.06]))
    target = edge_target(replace(GOAL, edge=None), edges_of(table), KNOWN, START, replace(SETTINGS, workspace=(-0.4, 0.4, -0.4, -0.1)))
    assert target.hold is not None
    np.testing.assert_allclose(target.hold.edge.ends, [[0.3, -0.9], [0.3, 0.06]], atol=1e-12)
    with pytest.raises(GoalRefusedError, match="edge is not known"):
        edge_target(replace(GOAL, edge=None), [], KNOWN, START, SETTINGS)


def test_object_is_there_only_where_it_is_held() -> None:
    goal, hold = pregrasp(GOAL, KNOWN, START, SETTINGS)
    there, further = goal.pose, goal.pose + np.array([0.009, 0.0, 0.0])
    strict = replace(hold, margin=float(hold.margins(CELLS, CENTRE, there)) - 0.003)
    target = held_target(goal, strict, KNOWN)
    assert target.is_reached(there, SURE) and not target.is_reached(further, SURE)
    blurred = np.diag([8e-3, 8e-3, 3e-3]) ** 2
    assert goal.chance(there, blurred) > CERTAIN and not target.is_reached(there, blurred), "the covariance counts"
    assert target.margin(there) == pytest.approx(strict.margin + 0.003)
    assert target.overhang(transform_points(there, MODEL.shape.outline)) == pytest.approx(GOAL.overhang)
    plan = GoalPlanner(MODEL.shape, SETTINGS).plan(KNOWN, further, SURE, goal, hold=strict)
    assert plan.status is not PlanStatus.ARRIVED, "the planner and the session agree"


def test_exploring_pushes_keep_the_object_on_the_table() -> None:
    edge, near = between(0.3, -0.5, 0.5), np.array([0.21, 0.0, 0.4])
    for pose in (START, near, near + np.array([0.06, 0.0, 0.0])):
        outline = transform_points(pose, MODEL.shape.outline)
        for seed in range(3):
            push = push_on_table(MODEL.shape, pose, seed, SETTINGS, [edge])
            after = float(np.max(edge.beyond(outline + push.distance * push.heading)))
            assert after < max(-0.009, float(np.max(edge.beyond(outline))) - 0.009)
    with pytest.raises(PlanningError, match="keeps the object on the table"):
        push_on_table(MODEL.shape, START, 0, SETTINGS, [between(0.0, -0.5, 0.5), TableEdge(np.array([-1.0, 0.0]), 0.0)])


def test_what_is_not_known_is_not_risked() -> None:
    """From the same place a known object is pushed to its goal, and an unknown one nowhere near."""
    goal = Goal(pregrasp(GOAL, KNOWN, START, SETTINGS)[0].pose, 0.005, 0.1)
    hold, start = EdgeHold(EDGE, 0.03), goal.pose - [0.03, 0.0, 0.0]
    planner = GoalPlanner(MODEL.shape, SETTINGS)
    known, unknown = (planner.plan(belief, start, SURE, goal, hold=hold) for belief in (KNOWN, Belief.of(prior_posterior(MODEL.shape))))
    assert known.status is PlanStatus.PUSH and known.chance > 0.8 and known.risk <= RISK
    assert unknown.plan is None or (unknown.chance < 0.1 and unknown.risk <= RISK)
