"""What `push-ident push` asks of the executor, and what it refuses before it looks for a cell."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.context import Context
from rclpy.node import Node

from helpers.commands import check_refused, run_here
from helpers.spinning import spinning
from push_ident.cli.push import contact_goal, random_goals
from push_ident.errors import InputError
from push_ident_msgs.action import ExecutePush


class Executor(Node):
    """Answers the pushes that it is asked for with the codes that it is given, one after the other."""

    def __init__(self, context: Context, codes: list[int]) -> None:
        super().__init__("executor", context=context)
        self._codes = codes
        self.asked: list[ExecutePush.Goal] = []
        self._server = ActionServer(self, ExecutePush, "execute_push", self._execute)

    def _execute(self, goal: ServerGoalHandle) -> ExecutePush.Result:
        self.asked.append(goal.request)
        goal.publish_feedback(ExecutePush.Feedback(phase=ExecutePush.Feedback.PHASE_PUSH))
        goal.succeed()
        return ExecutePush.Result(error_code=self._codes.pop(0), distance=0.05, speed=0.1)


@pytest.fixture
def executor() -> Iterator[Executor]:
    """One that answers: missed, made, arm silent."""
    codes = [ExecutePush.Result.NO_CONTACT, ExecutePush.Result.NONE, ExecutePush.Result.ARM_SILENT]
    with spinning(lambda context: Executor(context, codes)) as node:
        # The one of the test before may not have left yet: a goal sent to it would be lost.
        ends = time.monotonic() + 20.0
        while node.count_publishers("execute_push/_action/status") > 1 and time.monotonic() < ends:
            time.sleep(0.05)
        yield node


def drawn(seed: int) -> list[int]:
    return [goal.seed for goal in random_goals(4, seed)]


@pytest.mark.live
def test_a_push_that_misses_is_followed_by_the_next_and_a_silent_arm_ends_all(executor: Executor, tmp_path: Path) -> None:
    done = run_here("push", "--random", 4, "--seed", 2, "--dry-run", "--json", tmp_path / "pushes.json")
    assert done.returncode == 1 and "1 of 4 pushes could be planned" in done.stderr
    assert "push 1: NO_CONTACT" in done.stderr and "push 2: touched at" in done.stdout and "push 3: ARM_SILENT" in done.stderr
    content = json.loads((tmp_path / "pushes.json").read_text())
    assert [push["code"] for push in content["pushes"]] == ["NO_CONTACT", "SUCCESS", "ARM_SILENT"] and content["n_done"] == 1
    assert all(goal.dry_run for goal in executor.asked) and [goal.seed for goal in executor.asked] == drawn(2)[:3] != drawn(3)[:3]


@pytest.mark.live
def test_numbers_with_units_reach_the_executor_in_metres_and_radians(executor: Executor) -> None:
    done = run_here("push", "--at", "50mm,-2cm", "--direction", "90deg", "--distance", "6cm", "--speed", "100mm/s", "--dry-run")
    assert len(executor.asked) == 1, done.stderr
    (goal,) = executor.asked
    got = [goal.contact_point.x, goal.contact_point.y, goal.direction, goal.distance, goal.speed]
    np.testing.assert_allclose(got, [0.05, -0.02, np.pi / 2, 0.06, 0.1])


def test_a_push_at_a_point_names_its_frame() -> None:
    goal = contact_goal(np.array([0.05, -0.02]), 1.5, object_id="o1", in_object=True, distance=0.06)
    assert (goal.mode, goal.frame_id, goal.contact_point.y) == (ExecutePush.Goal.MODE_CONTACT, "object_o1", -0.02)
    assert contact_goal(np.zeros(2), 0.0).frame_id == "table"
    with pytest.raises(InputError, match="not finite"):
        contact_goal(np.array([np.inf, 0.0]), 0.0)


def test_options_that_make_no_push_are_refused_at_once() -> None:
    for options, reason in (
        ((), "--random N"),
        (("--random", 2, "--at", "0,0", "--direction", 0), "--random N"),
        (("--at", "0,0"), "belong together"),
        (("--at", "a,b", "--direction", 1), "X,Y in metres"),
        (("--at", "50,-20", "--direction", 1), "50mm is 0.05 m"),
        (("--at", "0,0", "--direction", 1, "--in-object"), "--object ID"),
        (("--random", 1, "--distance", 0.1), "draw their own"),
        (("--random", 1, "--object", "a b"), "Object id"),
    ):
        check_refused(reason, "push", *options)
    assert run_here("push", "--at", "0,0", "--direction", 0, "--speed", -1).returncode == 2
