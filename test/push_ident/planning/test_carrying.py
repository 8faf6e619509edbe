"""Goals to which an object is carried with both ends of a tool: the reserve against inertia, where it ends, and what it keeps clear of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.identification.results.posterior import prior_posterior
from push_ident.physics.body import body_of_cells
from push_ident.physics.overhang import TableEdge
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.planning.belief import Belief
from push_ident.planning.carrying import carrying_pushes
from push_ident.planning.goal import EdgeHold, Goal
from push_ident.planning.library import Surroundings
from push_ident.planning.planner import GoalPlanner, GoalPush, PlanStatus
from push_ident.planning.stable import Drive, FaceContact, StableTurns, Support, contact_on_face, stable_margin, stable_pushes, stable_turns
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PusherPath

OUTLINE = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
SHAPE = ObjectShape(cells_in_outline(OUTLINE, 0.01), OUTLINE)
CENTRES, N = SHAPE.cells.centres, len(SHAPE.cells)
FINGERS = PushSettings(workspace=(-0.3, 0.3, -0.3, 0.3), pusher_radius=0.008, finger_distance=0.04, speed_range=(0.1, 0.1))
SURE = np.diag([5e-4, 5e-4, 2e-3]) ** 2


def model_of(table: float, pusher: float = 0.4, mass: Float64Array | None = None) -> ObjectModel:
    """A box of 0.5 kg on a table of a friction coefficient."""
    mass = np.full(N, 1.0 / N) if mass is None else mass / mass.sum()
    return ObjectModel(SHAPE, 0.5 * mass, np.full(N, table), pusher)


def support_of(model: ObjectModel) -> Support:
    return Support.of_bodies(CENTRES, [body_of_cells(SHAPE, model.mass, model.friction)])


def contact(face: int = 3) -> FaceContact:
    length = float(np.linalg.norm(OUTLINE[(face + 1) % 4] - OUTLINE[face]))
    found = contact_on_face(SHAPE, FINGERS.tool, face, 0.5 * length)
    assert found is not None
    return found


def turns_of(support: Support, speed: float) -> StableTurns:
    turns = stable_turns(contact(), support, 0.4, speed)
    assert turns is not None
    return turns


def slip(model: ObjectModel, path: PusherPath, first: Float64Array) -> float:
    """Most by which the object moves in the frame of the tool after the contact [m, rad], with its inertia."""
    motion = simulate(model, PushScenario(path, first, path.time), settings=SimulationSettings(step=1 / 960))
    assert path.yaw is not None
    in_tool = compose(inverse(np.column_stack([path.position, path.yaw])), motion.pose)[2:]
    in_tool[:, 2] = wrap_angle(in_tool[:, 2] - in_tool[0, 2])
    return float(np.abs(in_tool - in_tool[0]).max())


def exerted(touching: FaceContact, friction: float) -> Float64Array:
    """Edges of the cone of wrenches about the origin that both contacts exert, as columns, shape (3, 4)."""
    across = np.array([-touching.normal[1], touching.normal[0]])
    forces = [touching.normal + sign * friction * across for sign in (1.0, -1.0)]
    return np.array([[*f, p[0] * f[1] - p[1] * f[0]] for p in touching.points for f in forces]).T


@pytest.mark.parametrize("curvature", [0.0, 8.0])
def test_push_is_stable_at_a_speed_where_the_contacts_can_exert_what_newton_and_euler_ask_for(curvature: float) -> None:
    """The motion by differences of poses along a path whose curvature rises, or falls; the contacts by non-negative least squares."""
    depth, change, touching = 0.06, 60.0, contact()
    mass = np.where(CENTRES[:, 0] > 0.02, 4.0, 1.0)
    model = model_of(0.2, mass=mass * np.where(CENTRES[:, 1] > 0.0, 1.2, 1.0))
    body = body_of_cells(SHAPE, model.mass, model.friction)
    reference = compose(touching.tool_in_object, np.array([depth, 0.0, 0.0]))
    turning = compose(touching.tool_in_object, np.array([depth, 1.0 / curvature, 0.0]))[:2] if curvature else None

    def object_at(length: float, rise: float) -> Float64Array:
        along = np.linspace(0.0, length, 201)
        yaw = curvature * along + 0.5 * rise * along**2
        place = np.trapezoid(np.column_stack([np.cos(yaw), np.sin(yaw)]), along, axis=0)
        return compose(np.append(place, yaw[-1]), inverse(reference))

    def is_possible(speed: float) -> bool:
        d = 2e-4  # [s]
        for rise in (change, -change):
            poses = np.array([object_at(speed * k * d, rise) for k in (-1, 0, 1)])
            turn = inverse(np.array([0.0, 0.0, poses[1, 2]]))
            cells, centre = (transform_points(poses, points) for points in (CENTRES, body.centre[None]))
            sliding = transform_points(turn, cells[2] - cells[0])
            forces = body.limit[:, None] * sliding / np.linalg.norm(sliding, axis=1)[:, None]
            inertial = body.mass * transform_points(turn, (centre[0] - 2.0 * centre[1] + centre[2]) / d**2)[0]
            places, forces = np.vstack([CENTRES, body.centre]), np.vstack([forces, inertial])
            torque = np.sum(places[:, 0] * forces[:, 1] - places[:, 1] * forces[:, 0])
            torque += body.inertia * (poses[0, 2] - 2.0 * poses[1, 2] + poses[2, 2]) / d**2
            needed = np.array([*forces.sum(axis=0), torque])
            if nnls(exerted(touching, 0.4), needed)[1] > 1e-6 * np.linalg.norm(needed):
                return False
        return True

    speeds = np.linspace(0.02, 0.6, 30)
    by_motion = [is_possible(float(v)) for v in speeds]
    by_margin = [stable_margin(touching, support_of(model), 0.4, turning, 1, Drive(float(v), depth, change)) > 0.0 for v in speeds]
    assert by_margin == by_motion and any(by_motion) and not all(by_motion)


def test_arcs_with_the_reserve_hold_the_object_at_a_speed_at_which_those_without_do_not() -> None:
    """On a table on which a box slides far: 0.05 g."""
    model, speed = model_of(0.05), 0.25
    quick, slow = turns_of(support_of(model), speed), turns_of(support_of(model), 0.0)
    assert 0.0 < quick.curvature < 0.7 * slow.curvature and quick.blend == pytest.approx(0.04) and slow.blend == 0.0
    held = []
    for curvature in (quick.curvature, slow.curvature):
        turns = replace(quick, curvature=curvature)
        reference = turns.reference_in_object
        goal = compose(compose(reference, np.array([0.25, 0.12, 0.9])), inverse(reference))
        push = stable_pushes(turns, np.zeros(3), goal, FINGERS.tool, speed=speed, clearance=0.0)[0]
        held.append(slip(model, push.path, push.poses[0]))
    print(f"with the reserve {held[0]:.4f}, without {held[1]:.4f} m or rad")
    assert held[0] < 4e-3 and held[1] > 3.0 * held[0]


def test_reserve_vanishes_with_the_speed_and_grows_as_the_object_slides_farther() -> None:
    even = support_of(model_of(0.3))
    by_speed = [turns_of(even, v).curvature for v in (1e-4, 0.1, 0.3)]
    assert by_speed[0] == pytest.approx(turns_of(even, 0.0).curvature, rel=2e-3) and by_speed == sorted(by_speed, reverse=True)
    by_table = [turns_of(support_of(model_of(mu)), 0.2).curvature for mu in (0.5, 0.2, 0.05)]
    assert by_table == sorted(by_table, reverse=True) and by_table[2] < 0.8 * by_table[0]
    unknown = [turns_of(Support.unknown(SHAPE, np.zeros(2), a), 0.1).curvature for a in (np.inf, 1.0)]
    assert unknown[1] < unknown[0]
    for deceleration in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="decelerates"):
            Support.unknown(SHAPE, np.zeros(2), deceleration)


def test_blended_path_begins_and_ends_where_it_should_and_its_curvature_has_no_jump() -> None:
    turns, rng = replace(turns_of(support_of(model_of(0.3)), 0.1), depth=0.07), np.random.default_rng(0)
    for _ in range(10):
        start, goal = (np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(-3.0, 3.0)]) for _ in range(2))
        pushes = stable_pushes(turns, start, goal, FINGERS.tool, speed=0.1, clearance=0.03)
        assert [push.length for push in pushes] == sorted(push.length for push in pushes)
        for push in pushes:
            assert push.poses[1] == pytest.approx(start, abs=1e-9)
            assert push.poses[-1, :2] == pytest.approx(goal[:2], abs=1e-9) and np.cos(push.poses[-1, 2] - goal[2]) > 1.0 - 1e-12
            way = compose(push.poses[1:], turns.reference_in_object)
            way = way[:: max(1, round(0.004 / np.linalg.norm(way[1, :2] - way[0, :2])))]  # by steps of 4 mm
            step, turn = np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1), np.diff(np.unwrap(way[:, 2]))
            curvature = turn / step
            assert np.abs(curvature).max() < 1.003 * turns.curvature
            # On a mean over 0.04 m of arcs the tool goes 0.95 m and less for each metre of them.
            assert np.abs(np.diff(curvature)).max() / step.min() < 2.0 * turns.curvature / (0.95**2 * turns.blend)
            # The reference point goes straight ahead in the frame of the tool.
            ahead = np.arctan2(*np.diff(way[:, :2], axis=0).T[::-1]) - 0.5 * (way[1:, 2] + way[:-1, 2])
            assert np.abs(wrap_angle(ahead)).max() < 5e-3


KNOWN = model_of(0.3)
PLANNER, BELIEF = GoalPlanner(SHAPE, FINGERS), Belief.certain(KNOWN)
POSE, GOAL = np.array([-0.05, -0.03, 0.3]), Goal(np.array([0.08, 0.07, 1.5]), 0.004, 0.03)


def end_of(model: ObjectModel, pose: Float64Array, push: GoalPush) -> Float64Array:
    """Pose after a push that carries, by fine steps."""
    assert push.path is not None
    tool = FINGERS.tool
    path = PusherPath(push.path.time, push.path.position, tool.radius, tool.polygon, push.path.yaw, tool.fingers)
    return np.asarray(simulate(model, PushScenario(path, pose, path.time[-1:]), settings=SimulationSettings(step=1 / 960)).pose[-1])


def test_object_that_is_known_is_carried_to_its_goal_in_one_push_within_the_workspace() -> None:
    push = PLANNER.plan(BELIEF, POSE, SURE, GOAL)
    assert push.status is PlanStatus.PUSH and push.path is not None and push.plan is not None and push.chance > 0.9 and push.pushes < 1.2
    assert GOAL.relative_error(end_of(KNOWN, POSE, push)) < 0.5 and push.end == pytest.approx(GOAL.pose, abs=2e-3)
    assert FINGERS.excess(FINGERS.ends(push.path.poses).reshape(-1, 2)) == 0.0
    round_tool = GoalPlanner(SHAPE, replace(FINGERS, finger_distance=0.0)).plan(BELIEF, POSE, SURE, GOAL)
    assert round_tool.path is None and round_tool.pushes > 1.5


def test_carried_object_and_tool_keep_clear_of_an_obstacle_and_go_another_way_round() -> None:
    free = PLANNER.plan(BELIEF, POSE, SURE, GOAL)
    assert free.path is not None
    along = np.asarray(compose(free.path.poses, np.array([0.05, 0.0, 0.0])))[:, :2]
    middle = along[len(along) // 2]
    wall = middle + 0.01 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    push = PLANNER.plan(BELIEF, POSE, SURE, GOAL, [wall])
    assert push.path is not None and not np.array_equal(push.path.position, free.path.position), "another way round"
    tool = push.path.dense_poses(1e-3, 0.02)[1][:, :2]
    assert np.min(signed_distance(tool, wall)) >= FINGERS.tool.reach - 2e-4
    tool_shape = FINGERS.tool
    path = PusherPath(push.path.time, push.path.position, tool_shape.radius, None, push.path.yaw, tool_shape.fingers)
    poses = simulate(KNOWN, PushScenario(path, POSE, path.time)).pose
    assert min(float(np.min(signed_distance(wall, transform_points(pose, OUTLINE)))) for pose in poses) > 0.0


def test_nothing_is_carried_with_a_contact_that_failed_at_an_edge_or_where_nothing_is_known() -> None:
    first = PLANNER.plan(BELIEF, POSE, SURE, GOAL)
    assert first.plan is not None and first.path is not None
    again = PLANNER.plan(BELIEF, POSE, SURE, GOAL, failed=[first.plan])
    assert again.plan is not None and np.linalg.norm(again.plan.contact_point - first.plan.contact_point) > 0.004
    held = PLANNER.plan(BELIEF, POSE, SURE, GOAL, hold=EdgeHold(TableEdge(np.array([1.0, 0.0]), 0.29)))
    assert held.path is None
    unknown = PLANNER.plan(Belief.of(prior_posterior(SHAPE)), POSE, SURE, GOAL)
    assert unknown.path is None or unknown.chance < first.chance


def test_arcs_so_wide_that_no_push_is_as_long_offer_none() -> None:
    turns, around = turns_of(support_of(KNOWN), 0.1), Surroundings()
    anywhere = replace(FINGERS, workspace=(-90.0, 90.0, -90.0, 90.0))
    assert list(carrying_pushes(SHAPE, [turns], anywhere, POSE, GOAL.pose, around))
    assert not list(carrying_pushes(SHAPE, [replace(turns, curvature=0.05)], anywhere, POSE, GOAL.pose, around))
