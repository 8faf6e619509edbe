"""Several objects: whose turn it is, and who makes room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import square
from push_ident.errors import InputError
from push_ident.planning.goal import Goal
from push_ident.planning.keep_out import distance_between
from push_ident.planning.several import NoTurnError, PlacedObject, SeveralGoals
from push_ident.pushing.push import PushSettings

SETTINGS = PushSettings(workspace=(-0.4, 0.4, -0.4, 0.4), pusher_radius=0.008)
OUTLINE = square(6, 0.01).outline
LEFT, MIDDLE, RIGHT = (np.array([x, 0.0, 0.0]) for x in (-0.2, 0.0, 0.2))
ABOVE, BESIDE = np.array([0.0, 0.2, 0.0]), np.array([0.02, 0.02, 0.0])


def placed(**poses: np.ndarray) -> dict[str, PlacedObject]:
    return {name: PlacedObject(OUTLINE, pose) for name, pose in poses.items()}


def carried_out(order: SeveralGoals, objects: dict[str, PlacedObject]) -> list[tuple[str, bool]]:
    """All turns, each of which succeeds."""
    turns = []
    while (turn := order.next(objects)) is not None:
        objects[turn.object_id] = replace(objects[turn.object_id], pose=turn.goal.pose)
        for name, one in objects.items():
            others = [other for key, other in objects.items() if key != name]
            assert all(distance_between(one.at(one.pose), other.at(other.pose)) > 0.0 for other in others)
        order.note(turn, is_reached=True, has_moved=True)
        turns.append((turn.object_id, turn.is_aside))
    return turns


def test_object_waits_for_the_one_on_its_goal() -> None:
    order = SeveralGoals({"a": Goal(MIDDLE), "b": Goal(RIGHT)}, SETTINGS)
    assert carried_out(order, placed(a=LEFT, b=MIDDLE)) == [("b", False), ("a", False)]
    assert order.next(placed(a=MIDDLE, b=RIGHT)) is None


def test_objects_that_change_places_make_room_first() -> None:
    objects = placed(a=LEFT, b=RIGHT, c=MIDDLE)
    order = SeveralGoals({"a": Goal(RIGHT), "b": Goal(MIDDLE), "c": Goal(LEFT)}, SETTINGS)
    turns = carried_out(order, objects)
    assert sum(is_aside for _, is_aside in turns) == 1 and len(turns) == 4
    for name, pose in (("a", RIGHT), ("b", MIDDLE), ("c", LEFT)):
        np.testing.assert_array_equal(objects[name].pose, pose)


def test_place_aside_leaves_room_for_the_tool_and_is_on_no_goal() -> None:
    objects = placed(a=LEFT, b=RIGHT)
    goals = {"a": Goal(RIGHT), "b": Goal(LEFT)}
    taken = [LEFT, RIGHT]
    for number in range(3):  # each time something stands where it would have gone
        turn = SeveralGoals(goals, SETTINGS).next(objects)
        assert turn is not None and turn.is_aside
        at = objects[turn.object_id].at(turn.goal.pose)
        assert SETTINGS.excess(at) == 0.0
        assert all(distance_between(at, objects["a"].at(pose)) > SeveralGoals(goals, SETTINGS).room for pose in taken)
        objects |= placed(**{f"c{number}": turn.goal.pose})
        taken.append(turn.goal.pose)


def test_object_that_could_not_be_brought_nearer_is_tried_again_once_another_has_moved() -> None:
    order, objects = SeveralGoals({"a": Goal(MIDDLE), "b": Goal(ABOVE)}, SETTINGS), placed(a=LEFT, b=RIGHT)
    first = order.next(objects)
    assert first is not None and first.object_id == "a"
    order.note(first, is_reached=False, has_moved=False)
    second = order.next(objects)
    assert second is not None and second.object_id == "b"
    order.note(second, is_reached=True, has_moved=True)
    again = order.next(objects)
    assert again is not None and again.object_id == "a"
    order.note(again, is_reached=False, has_moved=False)
    with pytest.raises(NoTurnError, match="`a` cannot get there"):
        order.next(objects)


def test_what_cannot_be_is_named() -> None:
    with pytest.raises(InputError, match="no object `c`"):
        SeveralGoals({"c": Goal(MIDDLE)}, SETTINGS).check(placed(a=LEFT))
    with pytest.raises(InputError, match="goals of `a` and `b` overlap"):
        SeveralGoals({"a": Goal(MIDDLE), "b": Goal(BESIDE)}, SETTINGS).check(placed(a=LEFT, b=RIGHT))
    # One without a goal lies in the way and is not moved.
    with pytest.raises(NoTurnError, match="`a` has `b` on its goal"):
        SeveralGoals({"a": Goal(MIDDLE)}, SETTINGS).next(placed(a=LEFT, b=MIDDLE))
