"""The one list of pushes of the demo: what counts, and in which order."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from helpers.objects import hammer
from push_ident.cli.demo_pushes import DemoPush, DemoPushes
from push_ident.identification.predicting.scoring import summarise_scores
from push_ident.nodes.convert.model import path_to_msg
from push_ident.types import Float64Array, PusherPath, PusherShape
from push_ident_msgs.action import ExecutePush

PATH = path_to_msg(PusherPath(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [0.05, 0.0]]), 0.01))
GOAL, RESULT = ExecutePush.Goal, ExecutePush.Result


class Cell:
    """Stands for the client of a cell: an executor that makes the pushes it is asked for, of an object that lies near the edge first."""

    tool = PusherShape(0.01)
    phases = (1, 2, 3)

    def __init__(self, *codes: int) -> None:
        self.asked: list[ExecutePush.Goal] = []
        self._codes, self._pose, self._n_learned = list(codes), np.array([0.0, 0.22, 0.0]), 0

    def execute_push(self, goal: ExecutePush.Goal, *, on_feedback: Any = None) -> ExecutePush.Result:
        self.asked.append(goal)
        result = RESULT(distance=0.05, direction=-1.5 if goal.mode == GOAL.MODE_RECENTRE else 0.0, speed=0.1, tool_path=PATH)
        if not goal.dry_run:
            for phase in self.phases:
                on_feedback(SimpleNamespace(phase=phase))
            result.error_code = self._codes.pop(0) if self._codes else RESULT.NONE
            self._pose = np.zeros(3) if result.error_code == RESULT.NONE else self._pose
        return result

    def shape(self, object_id: str) -> Any:
        return hammer(1).shape

    def poses(self, object_id: str) -> list[tuple[float, Float64Array]]:
        return [(1.0, self._pose)]

    def pose_at_rest(self, object_id: str, after: float) -> Float64Array:
        return self._pose.copy()

    def latest_map(self, object_id: str) -> Any:
        return SimpleNamespace(n_pushes=0)

    def wait_for_map(self, object_id: str, n_pushes: int, timeout: float) -> None:
        self._n_learned = n_pushes


def test_a_push_back_to_the_middle_is_a_push_of_the_list_and_one_that_missed_is_none(tmp_path: Path) -> None:
    cell = Cell(RESULT.NONE, RESULT.NO_CONTACT)
    pushes = DemoPushes(cell, "o1", 0, tmp_path / "model.json", lambda **shown: None)  # type: ignore[arg-type]
    training, tested = pushes.make(1), pushes.make(2)
    moved = [goal for goal in cell.asked if not goal.dry_run]
    assert [goal.mode for goal in moved] == [GOAL.MODE_CONTACT] * 4, "each as it was planned, so that it can be predicted"
    assert [push.number for push in pushes.made] == [1, 2, 3] and pushes.made == training + tested
    assert moved[0].direction == training[0].direction == -1.5


@pytest.mark.parametrize(("phases", "listed"), [((1, 2), 0), ((1, 2, 3, 4), 1)])
def test_a_push_whose_arm_was_held_on_its_way_back_was_made(phases: tuple[int, ...], listed: int, tmp_path: Path) -> None:
    """As its record and the identification have it; one that was held before its end was not."""
    cell = Cell(RESULT.TRACKING)
    cell.phases = phases
    pushes = DemoPushes(cell, "o1", 0, tmp_path / "model.json", lambda **shown: None)  # type: ignore[arg-type]
    pushes.make(1)
    n_moved = sum(not goal.dry_run for goal in cell.asked)
    assert len(pushes.made) == 1 and n_moved == 2 - listed


def test_console_and_report_have_one_score() -> None:
    numbers = {"expected_m": 1e-3, "uniform_m": 0.01, "mahalanobis2": 2.0}
    pushes = [DemoPush(n, 0.0, 0.05, 0.1, [0.0] * 3, predicted_m=e, **numbers) for n, e in ((5, 1e-3), (6, 2e-3))]
    summary = summarise_scores([push.score for push in pushes])
    assert (summary.mean_cell_error, summary.mean_uniform_cell_error, summary.share_within_90) == pytest.approx((1.5e-3, 0.01, 1.0))
    assert [push.content()["number"] for push in pushes] == [push.score.number for push in pushes] == [5, 6]
