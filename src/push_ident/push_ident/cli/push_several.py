"""`push-ident push-to --goal A:X,Y,YAW --goal B:...`: several objects of a live cell to their goals, one after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from push_ident.cli.goal_report import GoalReport, goal_message
from push_ident.cli.output import say
from push_ident.cli.units import parse_floats
from push_ident.errors import InputError
from push_ident.limits import check_object_id, plain_text
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from push_ident.nodes.client.cell_client import CellClient
    from push_ident.planning.several import PlacedObject, Turn

_PATIENCE: Final = 20.0
"""For the objects and the pusher to be known [s]."""


def parse_goals(texts: Sequence[str]) -> dict[str, Float64Array]:
    """Poses, each of shape (3,), by object, from texts `ID:X,Y,YAW` [m, m, rad]. Raises InputError for another form, or an object twice."""
    goals: dict[str, Float64Array] = {}
    for text in texts:
        object_id, colon, pose = text.partition(":")
        if not colon:
            raise InputError(f"--goal is {plain_text(text)!r}, expected ID:X,Y,YAW, such as o1:0.05,-0.1,1.57.")
        if check_object_id(object_id) in goals:
            raise InputError(f"--goal names `{object_id}` twice; give each object one goal.")
        goals[object_id] = parse_floats(pose, ("m", "m", "rad"), "--goal", "ID:X,Y,YAW in metres and radians, such as o1:0.05,-0.1,1.57")
    return goals


class SeveralReport:
    """What came of goals of several objects: a report for each turn, with whether that object made room for another one."""

    def __init__(self, goals: Mapping[str, Float64Array]) -> None:
        self._goals = goals
        self.turns: list[tuple[GoalReport, bool]] = []
        self.why = "broken off before it ended: the arm holds, and what was learned is kept."
        """Why not all are at their goals; empty: they are."""

    def content(self) -> dict[str, Any]:
        """For JSON: lengths in metres, angles in radians."""
        last = {report.goal.object_id: report for report, is_aside in self.turns if not is_aside}
        return {
            "reached": not self.why,
            "text": self.why,
            "n_objects": len(self._goals),
            "n_reached": sum(report.is_reached for report in last.values()),
            "n_pushes": sum(int(report.result.pushes) for report, _ in self.turns),
            "time_s": sum(float(report.result.elapsed) for report, _ in self.turns),
            "turns": [{"makes_room": is_aside, **report.content()} for report, is_aside in self.turns],
        }


def push_several(
    client: CellClient,
    report: SeveralReport,
    goals: Mapping[str, Float64Array],
    push: Callable[[CellClient, GoalReport, str], None],
    *,
    tolerance: tuple[float, float],
    limits: Mapping[str, Any],
) -> None:
    """Push objects to their goals; `push` carries out the goal of a report, with a text for its progress.

    `tolerance`: [mm] and [degrees]; `limits`: further fields of each goal. Raises CellTimeout where a node does not answer, InputError for
    goals that cannot all be reached.
    """
    from push_ident.planning.goal import Goal, GoalCode
    from push_ident.planning.several import NoTurnError, SeveralGoals
    from push_ident.pushing.push import PushSettings, tool_sizes

    client.wait(lambda: (_known(client).keys() >= goals.keys() and client.tool) or None, _PATIENCE, _missing(client, goals))
    wanted = {name: Goal(pose, 1e-3 * tolerance[0], float(np.radians(tolerance[1]))) for name, pose in goals.items()}
    assert client.tool is not None, "it was waited for"
    order = SeveralGoals(wanted, PushSettings(**tool_sizes(client.tool)))
    order.check(_known(client))
    try:
        while (turn := order.next(_known(client))) is not None:
            made = GoalReport(_message(turn, limits))
            report.turns.append((made, turn.is_aside))
            say(f"{turn.object_id} makes room" if turn.is_aside else f"{turn.object_id} to its goal")
            push(client, made, f"{turn.object_id}: ")
            code = int(made.result.error_code)
            # Another object in the way, or on the goal, may be gone later; anything else ends it.
            if not made.is_reached and code != GoalCode.UNREACHABLE:
                report.why = f"`{turn.object_id}`: {made.content()['code']}: {made.content()['text']}"
                return
            order.note(turn, is_reached=made.is_reached, has_moved=bool(made.result.pushes))
    except NoTurnError as error:
        report.why = str(error)
        return
    report.why = ""


def _message(turn: Turn, limits: Mapping[str, Any]) -> Any:
    goal = turn.goal
    size = {"tolerance_mm": 1e3 * goal.position, "tolerance_deg": float(np.degrees(goal.yaw))}
    return goal_message(goal.pose, object_id=turn.object_id, **size, **limits)


def _known(client: CellClient) -> dict[str, PlacedObject]:
    """Objects with their latest pose."""
    from push_ident.planning.several import PlacedObject

    tracks = {name: (client.poses(name), client.is_known(name)) for name in client.object_ids()}
    return {
        name: PlacedObject(client.shape(name).outline, poses[-1][1]) for name, (poses, is_known) in tracks.items() if poses and is_known
    }


def _missing(client: CellClient, goals: Mapping[str, Float64Array]) -> str:
    return f"not all of {', '.join(goals)} have pose and cells within {_PATIENCE:g} s; known: {', '.join(client.object_ids()) or 'none'}"
