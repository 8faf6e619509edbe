"""Two fingers that turn, in Bullet and in the model: on one face and on the two faces beside a corner."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.planning.stable import StableTurns, Support, contact_on_face, shortest_stable_push, stable_turns
from push_ident.types import ObjectShape, PusherPath, PusherShape
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import Part, SimObject, object_from_picture
from push_ident_sim.recordings.truth import true_model

RADIUS, APART = 0.004, 0.024


def block(pusher_friction: float) -> SimObject:
    """Heavier and rougher at one end."""
    return object_from_picture("block", ["aabbbb"] * 5, {"a": Part(0.4, 0.5, 0.04), "b": Part(0.2, 0.25, 0.04)}, 0.012, pusher_friction)


def uneven_block(rng: np.random.Generator) -> SimObject:
    """Three masses drawn at random, one friction coefficient, fingers of more than 0.35."""
    parts = {letter: Part(rng.uniform(0.05, 0.4), 0.3, 0.04) for letter in "abc"}
    return object_from_picture("block", ["abbabb", "aabbbb", "aaccbb", "aabbbb", "abbbaa"], parts, 0.012, rng.uniform(0.35, 0.8))


def turns_of(shape: ObjectShape, support: Support, tool: PusherShape, *, friction: float) -> list[StableTurns]:
    """Of all faces, with the middle of the tool before the centre."""
    found = []
    for face, vertex in enumerate(shape.outline):
        edge = shape.outline[(face + 1) % len(shape.outline)] - vertex
        contact = contact_on_face(shape, tool, face, float((support.centre - vertex) @ edge / np.linalg.norm(edge)))
        if contact is not None and (turns := stable_turns(contact, support, friction)) is not None:
            found.append(turns)
    return found


def arc(shape: ObjectShape, rng: np.random.Generator, *, on_corner: bool) -> PusherPath:
    """Both fingers 1 mm before the left face, or one before the left and one before the lower face; then along an arc."""
    low = shape.outline.min(axis=0) - RADIUS - 1e-3
    origin, turn = np.array([low[0], rng.uniform(-0.006, 0.006)]), 0.0
    if on_corner:
        turn = np.pi / 4 + rng.uniform(-0.2, 0.2)
        across = APART * np.array([-np.sin(turn), np.cos(turn)])
        origin = low + np.array([0.0, across[1]]) - 0.5 * across
    time = np.linspace(0.0, 1.2, 121)
    yaw = turn + rng.uniform(-0.8, 0.8) * time
    heading = yaw + rng.uniform(-0.7, 0.7)
    steps = 0.05 * np.diff(time)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])[:-1]
    ends = np.array([[0.0, 0.5 * APART], [0.0, -0.5 * APART]])
    return PusherPath(time, origin + np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), RADIUS, yaw=yaw, fingers=ends)


@pytest.mark.parametrize("on_corner", [False, True])
def test_bullet_and_the_model_agree_on_two_fingers_that_stick_slide_and_turn(on_corner: bool) -> None:
    rng, errors = np.random.default_rng(5), []
    for _ in range(6):
        thing = block(rng.uniform(0.1, 0.7))
        model = true_model(thing)
        path = arc(model.shape, rng, on_corner=on_corner)
        with closing(PushWorld(thing, RADIUS, fingers=path.fingers)) as world:
            motion = world.push(np.zeros(3), path)
        end = simulate(model, PushScenario(path, np.zeros(3), motion.time[-1:])).pose[0]
        assert cell_error(model.shape.cells, np.zeros(3), motion.pose[-1]) > 0.02
        errors.append(cell_error(model.shape.cells, motion.pose[-1], end))
    print(np.round(1e3 * np.array(errors), 3))
    # 6 cm of travel. The largest is of a finger that passes the corner at the end, which Bullet rounds.
    assert np.median(errors) < 1e-4 and max(errors) < 1.2e-3


def test_effects_on_a_single_finger_are_refused() -> None:
    ends = np.array([[0.0, 0.01], [0.0, -0.01]])
    with pytest.raises(InputError, match="two fingers"):
        PushWorld(block(0.3), RADIUS, fingers=ends, effects=InjectedEffects.of({"tool_offset": (1e-3, 0.0)}))


def test_stable_push_ends_at_the_goal_in_bullet_though_nothing_is_known_of_the_pressure() -> None:
    tool, errors = PusherShape(RADIUS, fingers=APART * np.array([[0.0, 0.5], [0.0, -0.5]])), []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        thing = uneven_block(rng)
        model = true_model(thing)
        # Equal friction coefficients: the centre of friction is that of mass.
        centre = model.mass @ model.shape.cells.centres / model.total_mass
        turns = turns_of(model.shape, Support.unknown(model.shape, centre), tool, friction=0.3)
        goal = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(-np.pi, np.pi)])
        push = shortest_stable_push(turns, np.zeros(3), goal, tool, speed=0.03, clearance=0.01)
        assert push is not None
        with closing(PushWorld(thing, RADIUS, fingers=tool.fingers)) as world:
            end = world.push(np.zeros(3), push.path).pose[-1]
        errors.append(cell_error(model.shape.cells, end, goal))
    assert max(errors) < 3e-4, errors
