"""Several objects in one engine: who touches whom, and that what is far away changes nothing."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from push_ident.types import PusherPath
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.objects import make_object

RADIUS = 0.008
BOOK, TOOLBOX = make_object("book", 3), make_object("toolbox", 3)
HALF = float(BOOK.outline[:, 0].max())
"""Half the width of the book along x [m]."""
GAP = 0.04
"""Between the book at the origin and what stands before it [m]."""
BEFORE = np.array([HALF + GAP + float(TOOLBOX.outline[:, 0].max()), 0.0, 0.0])


def push(travel: float) -> PusherPath:
    """Along x against the middle of the book, so far after contact [m]."""
    start = -HALF - RADIUS - 0.02
    return PusherPath(np.array([0.0, (travel + 0.02) / 0.1]), np.array([[start, 0.0], [start + travel + 0.02, 0.0]]), RADIUS)


@pytest.fixture
def world() -> Iterator[PushWorld]:
    world = PushWorld(BOOK, RADIUS)
    yield world
    world.close()


def test_object_that_reaches_another_one_is_noted_and_one_that_does_not_moves_as_if_alone(world: PushWorld) -> None:
    alone = world.push(np.zeros(3), push(0.03))
    number = world.add(TOOLBOX, BEFORE, fixed=False)
    beside = world.push(np.zeros(3), push(0.03))
    np.testing.assert_allclose(beside.pose, alone.pose, atol=2e-5)
    assert world.touched == set()
    np.testing.assert_allclose(world.pose_of(number), BEFORE, atol=1e-5)
    world.push(np.zeros(3), push(0.08))
    assert world.touched == {number}
    moved = world.pose_of(number)
    assert 0.02 < moved[0] - BEFORE[0] < 0.06, "it is pushed by what is left of the travel after the gap"


def test_fixed_things_stay_and_are_touched_by_object_or_tool(world: PushWorld) -> None:
    number = world.add(TOOLBOX, BEFORE, fixed=True)
    world.push(np.zeros(3), push(GAP - 0.01))
    assert world.touched == set()
    motion = world.push(np.zeros(3), push(GAP + 0.01))
    assert world.touched == {number} and motion.pose[-1, 0] < GAP + 0.005
    # The tool alone, on the other side of it.
    side = BEFORE[0] + float(TOOLBOX.outline[:, 0].max()) + RADIUS
    world.push(np.zeros(3), PusherPath(np.array([0.0, 0.5]), np.array([[side + 0.03, 0.0], [side - 0.003, 0.0]]), RADIUS))
    assert world.touched == {number}
    world.remove(number)
    world.push(np.zeros(3), push(GAP + 0.01))
    assert world.touched == set()


def test_another_object_can_be_pushed_in_turn(world: PushWorld) -> None:
    number = world.add(TOOLBOX, BEFORE, fixed=False)
    world.place(0, np.array([0.0, 0.3, 0.5]))
    world.turn_to(number)
    motion = world.push(np.zeros(3), push(0.05))
    assert motion.pose[-1, 0] > 0.01 and world.touched == set()
    np.testing.assert_allclose(world.pose_of(0), [0.0, 0.3, 0.5], atol=1e-5)
