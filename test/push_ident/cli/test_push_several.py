"""`push-ident push-to --goal ...`: several objects, with a cell in memory that brings each where it is sent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from helpers.commands import check_refused
from helpers.objects import square
from push_ident.cli.goal_report import GoalReport, planar
from push_ident.cli.push_several import SeveralReport, parse_goals, push_several
from push_ident.errors import InputError
from push_ident.planning.goal import GoalCode
from push_ident.types import Float64Array, ObjectShape, PusherShape
from push_ident_msgs.action import PushToGoal

LEFT, MIDDLE, RIGHT = (np.array([x, 0.0, 0.0]) for x in (-0.15, 0.0, 0.15))


@dataclass
class Client:
    """What `CellClient` has of the objects."""

    at: dict[str, Float64Array]
    codes: list[GoalCode] = field(default_factory=list)
    """Of the next goals; then all are reached."""
    tool: PusherShape = field(default_factory=lambda: PusherShape(0.008))
    asked: list[PushToGoal.Goal] = field(default_factory=list)

    def wait(self, what: Callable[[], Any], timeout: float, missing: str) -> Any:
        result = what()
        assert result is not None, missing
        return result

    def object_ids(self) -> tuple[str, ...]:
        return tuple(self.at)

    def is_known(self, object_id: str) -> bool:
        return True

    def shape(self, object_id: str) -> ObjectShape:
        return square(6, 0.01)

    def poses(self, object_id: str) -> list[tuple[float, Float64Array]]:
        return [(0.0, self.at[object_id])]

    def push(self, client: Any, report: GoalReport, prefix: str) -> None:
        self.asked.append(report.goal)
        assert prefix == f"{report.goal.object_id}: "
        code = self.codes.pop(0) if self.codes else GoalCode.NONE
        report.result = PushToGoal.Result(error_code=int(code), error_text="" if code is GoalCode.NONE else "why", pushes=2, elapsed=3.0)
        if code is GoalCode.NONE:
            self.at[report.goal.object_id] = planar(report.goal.goal.pose)


def pushed(client: Client, goals: dict[str, Float64Array]) -> SeveralReport:
    report = SeveralReport(goals)
    push_several(client, report, goals, client.push, tolerance=(10.0, 9.0), limits={"explore": 2, "max_pushes": 7})  # type: ignore[arg-type]
    return report


def test_objects_go_one_after_another_and_the_report_has_each_turn() -> None:
    client = Client({"o1": LEFT, "o2": MIDDLE})
    content = pushed(client, {"o1": MIDDLE, "o2": RIGHT}).content()
    assert [goal.object_id for goal in client.asked] == ["o2", "o1"]
    assert (client.asked[0].explore, client.asked[0].max_pushes) == (2, 7)
    assert client.asked[0].position_tolerance == pytest.approx(0.01) and client.asked[0].yaw_tolerance == pytest.approx(np.radians(9.0))
    np.testing.assert_allclose(planar(client.asked[1].goal.pose), MIDDLE, atol=1e-12)
    assert content["reached"] and (content["n_objects"], content["n_reached"], content["n_pushes"], content["time_s"]) == (2, 2, 4, 6.0)
    assert [(turn["object_id"], turn["makes_room"], turn["code"]) for turn in content["turns"]] == [
        ("o2", False, "SUCCESS"),
        ("o1", False, "SUCCESS"),
    ]


def test_change_of_places_is_three_turns() -> None:
    client = Client({"o1": LEFT, "o2": RIGHT})
    content = pushed(client, {"o1": RIGHT, "o2": LEFT}).content()
    assert content["reached"] and [turn["makes_room"] for turn in content["turns"]] == [True, False, False]
    np.testing.assert_allclose([client.at["o1"], client.at["o2"]], [RIGHT, LEFT], atol=1e-12)


def test_way_that_is_blocked_is_tried_later_and_any_other_failure_ends_it_with_its_text() -> None:
    client = Client({"o1": LEFT, "o2": RIGHT}, [GoalCode.UNREACHABLE])
    goals = {"o1": np.array([-0.1, 0.1, 0.0]), "o2": np.array([0.1, 0.1, 0.0])}
    assert pushed(client, goals).content()["reached"] and [goal.object_id for goal in client.asked] == ["o1", "o2", "o1"]
    lost = pushed(Client({"o1": LEFT, "o2": RIGHT}, [GoalCode.OBJECT_LOST]), goals)
    assert lost.why == "`o1`: OBJECT_LOST: why" and lost.content()["n_reached"] == 0 and len(lost.turns) == 1
    never = pushed(Client({"o1": LEFT, "o2": RIGHT}, [GoalCode.UNREACHABLE, GoalCode.NONE, GoalCode.UNREACHABLE]), goals)
    assert "`o1` cannot get there" in never.why and never.content()["n_reached"] == 1


def test_goals_of_the_command_line_name_their_object() -> None:
    goals = parse_goals(["o1:5cm,-0.1,90deg", "o2:0,0,0"])
    np.testing.assert_allclose(goals["o1"], [0.05, -0.1, np.pi / 2])
    for texts, word in ((["0,0,0"], "ID:X,Y,YAW"), (["o1:0,0"], "ID:X,Y,YAW"), (["o1:0,0,0", "o1:0,0,1"], "twice"), (["1/2:0,0,0"], "1/2")):
        with pytest.raises(InputError, match=word):
            parse_goals(texts)
    check_refused("name each object with --goal", "push-to", "--goal", "o1:0,0,0", "--x", 0)
