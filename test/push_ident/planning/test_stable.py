"""Stable pushes: closed forms, pressures of every kind in the engine, and paths that end at the goal."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.dubins import dubins_path
from push_ident.geometry.se2 import compose, inverse
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.planning.stable import (
    FaceContact,
    StablePush,
    StableTurns,
    Support,
    contact_on_face,
    shortest_stable_push,
    stable_margin,
    stable_pushes,
    stable_turns,
)
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PusherShape

OUTLINE = np.array([[-0.03, -0.025], [0.03, -0.025], [0.03, 0.025], [-0.03, 0.025]])
SHAPE = ObjectShape(cells_in_outline(OUTLINE, 0.006), OUTLINE)
TOOL = PusherShape(0.003, fingers=np.array([[0.0, 0.012], [0.0, -0.012]]))
FRICTION = 0.4
LEFT = 3  # face at x = -0.03


def contact() -> FaceContact:
    found = contact_on_face(SHAPE, TOOL, LEFT, 0.025)
    assert found is not None
    return found


def extreme_pressure(rng: np.random.Generator, centre: Float64Array) -> Float64Array:
    """Shares of three cells at most, with this centre: a vertex of all pressures that have it."""
    centres = SHAPE.cells.centres
    equal = np.vstack([np.ones(len(centres)), centres.T])
    return np.asarray(linprog(rng.normal(size=len(centres)), A_eq=equal, b_eq=[1.0, *centre], method="highs").x)


def drift(push: StablePush, friction: Float64Array) -> float:
    """Most by which the object moves in the frame of the tool [m, rad], from the pose in which both contacts touch."""
    n = len(SHAPE.cells)
    model = ObjectModel(SHAPE, np.full(n, 0.3 / n), n * friction * 0.3, FRICTION)
    motion = simulate(model, PushScenario(push.path, push.poses[0], push.path.time), settings=SimulationSettings(quasi_static=True))
    assert push.path.yaw is not None
    tool = np.column_stack([push.path.position, push.path.yaw])
    in_tool = compose(inverse(tool), motion.pose)
    return float(np.abs(in_tool - in_tool[0]).max())


def arc(turns: StableTurns, turn: int, *, curvature: float) -> StablePush:
    """Along an arc of 0.8 rad with this curvature."""
    goal = compose(inverse(turns.reference_in_object), np.zeros(3))
    angle = 0.8 * turn
    at = np.array([np.sin(abs(angle)) / curvature, turn * (1.0 - np.cos(angle)) / curvature, angle])
    end = compose(compose(compose(goal, turns.reference_in_object), at), inverse(turns.reference_in_object))
    sharp = StableTurns(turns.contact, turns.depth, curvature)
    push = stable_pushes(sharp, goal, end, TOOL, speed=0.02)[0]
    assert push.length == pytest.approx(0.8 / curvature, rel=1e-6)
    return push


def test_dubins_paths_end_where_they_should_and_none_is_shorter_than_a_known_one() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        start, end = (np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-7.0, 7.0)]) for _ in range(2))
        path = dubins_path(start, end, rng.uniform(0.05, 0.4))
        last = path.poses(0.01)[-1]
        assert last[:2] == pytest.approx(end[:2], abs=1e-12)
        assert np.cos(last[2] - end[2]) == pytest.approx(1.0, abs=1e-12)
        assert path.length >= np.hypot(*(end - start)[:2]) - 1e-12
        back = dubins_path(np.array([*end[:2], end[2] + np.pi]), np.array([*start[:2], start[2] + np.pi]), path.radius)
        assert back.length == pytest.approx(path.length, abs=1e-9)
    assert dubins_path(np.zeros(3), np.array([0.0, 0.4, np.pi]), 0.2).length == pytest.approx(0.2 * np.pi)
    assert dubins_path(np.zeros(3), np.array([0.7, 0.0, 0.0]), 0.2).length == pytest.approx(0.7)
    with pytest.raises(InputError, match="radius"):
        dubins_path(np.zeros(3), np.ones(3), 0.0)


@pytest.mark.parametrize("along", [-0.014, -0.010, 0.0, 0.010, 0.014])
def test_push_straight_ahead_is_stable_if_the_centre_lies_between_the_contacts_whatever_the_pressure_is(along: float) -> None:
    """Mason 1986: in a translation the friction of the table acts at its centre."""
    centre = np.array([0.002, along])
    margins = [stable_margin(contact(), Support.unknown(SHAPE, centre), FRICTION, None, 1)]
    rng = np.random.default_rng(3)
    margins += [
        stable_margin(contact(), Support.of_models(SHAPE.cells.centres, extreme_pressure(rng, centre)), FRICTION, None, 1) for _ in range(4)
    ]
    assert margins == pytest.approx([margins[0]] * 5, abs=1e-9)
    assert bool(margins[0] > 0.0) is bool(abs(along) < 0.012)


def test_load_at_a_single_point_bounds_the_angle_by_the_friction_cone() -> None:
    """All load at the centre of the block: the table then exerts a force through it, against its velocity."""
    centre = np.array([0.0, 0.0])
    single = Support(np.zeros((1, 2)), np.ones((1, 1)), centre, np.zeros((1, 4)))
    for angle in (0.99, 1.01):
        # The centre of rotation is so far away that the velocity at the block's centre is at this share of the cone's half-angle.
        heading = angle * np.arctan(FRICTION)
        far = centre + 10.0 * np.array([-np.sin(heading), np.cos(heading)])
        # The line of force through the centre crosses the face between the contacts: 0.03 tan(heading) < 0.012.
        margin = stable_margin(contact(), single, FRICTION, far, 1)
        assert bool(margin > 0.0) is bool(angle < 1.0 and 0.03 * np.tan(heading) < 0.012)


def test_arcs_that_are_stable_for_any_pressure_hold_the_object_under_each_and_sharper_ones_do_not_under_the_worst() -> None:
    centre = np.array([0.004, 0.003])
    turns = stable_turns(contact(), Support.unknown(SHAPE, centre), FRICTION)
    assert turns is not None and 5.0 < turns.curvature < 30.0
    rng = np.random.default_rng(1)
    pressures = [extreme_pressure(rng, centre) for _ in range(12)]
    held = [drift(arc(turns, turn, curvature=turns.curvature), p) for p in pressures for turn in (1, -1)]
    slipped = [drift(arc(turns, turn, curvature=2.5 * turns.curvature), p) for p in pressures for turn in (1, -1)]
    print(f"curvature {turns.curvature:.1f} 1/m: {max(held):.2e} m or rad; 2.5 times that: {max(slipped):.2e}")
    # The tool goes from knot to knot of its arc along chords.
    assert max(held) < 2e-4 and max(slipped) > 2e-2


def test_known_loads_allow_sharper_arcs_than_unknown_ones_and_more_friction_too() -> None:
    uniform = np.ones(len(SHAPE.cells))
    known = Support.of_models(SHAPE.cells.centres, uniform)
    unknown = Support.unknown(SHAPE, np.zeros(2))
    by = {(name, mu): stable_turns(contact(), support, mu) for name, support in (("k", known), ("u", unknown)) for mu in (0.2, 0.6)}
    curvature = {key: turns.curvature for key, turns in by.items() if turns is not None}
    assert curvature["k", 0.2] > 1.5 * curvature["u", 0.2] and curvature["k", 0.6] > 1.5 * curvature["u", 0.6]
    assert curvature["k", 0.6] > curvature["k", 0.2] and curvature["u", 0.6] > curvature["u", 0.2]
    # Of several models that with the least room counts.
    rim = np.where(np.abs(SHAPE.cells.centres[:, 0]) > 0.02, 1.0, 0.0)
    both = stable_turns(contact(), Support.of_models(SHAPE.cells.centres, np.array([uniform, rim])), 0.6)
    assert both is not None and both.curvature <= curvature["k", 0.6]


def test_shortest_push_of_all_faces_ends_at_the_goal_under_extreme_pressures() -> None:
    centre = np.array([0.002, -0.002])
    support = Support.unknown(SHAPE, centre)
    options = []
    for face in range(4):
        length = float(np.linalg.norm(OUTLINE[(face + 1) % 4] - OUTLINE[face]))
        on_face = contact_on_face(SHAPE, TOOL, face, 0.5 * length)
        if on_face is not None and (turns := stable_turns(on_face, support, FRICTION)) is not None:
            options.append(turns)
    assert len(options) == 4
    rng = np.random.default_rng(2)
    for _ in range(6):
        start, goal = (np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(-np.pi, np.pi)]) for _ in range(2))
        push = shortest_stable_push(options, start, goal, TOOL, speed=0.03, clearance=0.01)
        assert push is not None
        assert push.length == min(p.length for o in options for p in stable_pushes(o, start, goal, TOOL, speed=0.03))
        n = len(SHAPE.cells)
        friction = 0.3 * n * extreme_pressure(rng, centre)
        scenario = PushScenario(push.path, start, push.path.time[-1:])
        end = simulate(ObjectModel(SHAPE, np.full(n, 0.3 / n), friction, FRICTION), scenario).pose[0]
        assert end[:2] == pytest.approx(goal[:2], abs=1e-3)
        assert np.cos(end[2] - goal[2]) > np.cos(5e-3)


def test_what_allows_no_stable_push_is_said_or_refused() -> None:
    assert contact_on_face(SHAPE, TOOL, LEFT, 0.005) is None
    assert stable_turns(contact(), Support.unknown(SHAPE, np.array([0.0, 0.02])), FRICTION) is None
    straight = StableTurns(contact(), 0.03, 0.0)
    assert not stable_pushes(straight, np.zeros(3), np.ones(3), TOOL, speed=0.1)
    assert shortest_stable_push([straight], np.zeros(3), np.ones(3), TOOL, speed=0.1) is None
    bent, goal = StableTurns(contact(), 0.03, 5.0), np.array([0.2, 0.1, 0.5])
    assert shortest_stable_push([bent], np.zeros(3), goal, TOOL, speed=0.1, workspace=(-0.5, 0.5, -0.5, 0.5)) is not None
    assert shortest_stable_push([bent], np.zeros(3), goal, TOOL, speed=0.1, workspace=(-0.5, 0.1, -0.5, 0.5)) is None
    with pytest.raises(InputError, match="inside the outline"):
        Support.unknown(SHAPE, np.array([0.5, 0.0]))
    with pytest.raises(InputError, match="no friction"):
        Support.of_models(SHAPE.cells.centres, np.zeros(len(SHAPE.cells)))
    with pytest.raises(InputError, match="two fingers or a plate"):
        contact_on_face(SHAPE, PusherShape(0.01), LEFT, 0.025)
