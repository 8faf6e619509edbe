"""push_executor_node with `free_motions: follow_joint_trajectory` before a controller that is a process of its own.

About 30 s on 2 cores that others use as well, most of it waiting for processes to start and for an arm that moves in real time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from action_msgs.msg import GoalStatus, GoalStatusArray
from builtin_interfaces.msg import Duration, Time
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionClient
from rclpy.context import Context
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from helpers.executor_cell import CONTACT, LATCHED, PARKED, Call, Cell, Stalls, ask, is_hold, send, start_node, wait_for, wait_until_ready
from helpers.node_process import NodeProcess
from helpers.spinning import spinning
from helpers.trajectory_controller import NAME, ControllerProcess
from push_ident.pushing.push import PushCode

pytestmark = pytest.mark.alone

PATH_TOLERANCE = 0.01
GIVEN = {
    "free_motions": "follow_joint_trajectory",
    "path_tolerance": PATH_TOLERANCE,
    "stamp_commands": True,
    # The process of the controller may wait for a processor; when a silent arm is held: `test_push_executor.py`.
    "arm_timeout": 2.0,
    "tracking_lag": 1.0,
}
NOW = Time()
BRAKING = 0.2
"""Of a joint at 2 rad/s with 10 rad/s^2 [s]."""


class DrivenCell(Cell):
    """All of the cell but the arm, which is the controller's."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.silent = True
        self.faults = self.create_publisher(String, f"{NAME}/fault", LATCHED)
        self.follow = ActionClient(self, FollowJointTrajectory, "follow_joint_trajectory")
        self.goals: dict[bytes, int] = {}
        self.earlier: set[bytes] = set()
        self.create_subscription(JointState, "joint_states", self._on_joint_states, 10)
        self.create_subscription(GoalStatusArray, "follow_joint_trajectory/_action/status", self._on_status, LATCHED)

    def _on_joint_states(self, msg: JointState) -> None:
        self.q = np.array(msg.position)
        self.states.append((time.monotonic(), self.q))

    def _on_status(self, msg: GoalStatusArray) -> None:
        all_goals = {bytes(status.goal_info.goal_id.uuid): status.status for status in msg.status_list}  # of its last minutes
        self.goals.update({goal: status for goal, status in all_goals.items() if goal not in self.earlier})

    def _move(self, now: float) -> None:
        before, self._tip = self._tip, self.kinematics.forward(self.q)[:3, 3]
        if self.touches(self._tip):
            self._carry_box(self._tip[:2], self._tip[:2] - before[:2])


@pytest.fixture(scope="module")
def the_driven_cell(domain: int) -> Iterator[DrivenCell]:
    with spinning(DrivenCell, domain) as cell:
        yield cell


@pytest.fixture(scope="module")
def controllers(domain: int, the_driven_cell: DrivenCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[ControllerProcess]]:
    """The controller that runs is the last."""
    folder = tmp_path_factory.mktemp("controller")
    running = [start_controller(domain, the_driven_cell, folder)]
    yield running
    running[-1].stop()


def start_controller(domain: int, cell: DrivenCell, folder: Path) -> ControllerProcess:
    tolerances = {"constraints.trajectory": 0.3, "constraints.goal": 0.02, "constraints.goal_time": 1.0}
    return ControllerProcess(cell.kinematics.joint_names, np.array(PARKED), domain, folder, **tolerances)


@pytest.fixture(scope="module")
def node(domain: int, controllers: object, the_driven_cell: DrivenCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeProcess]:
    process = start_node(domain, tmp_path_factory.mktemp("node"), **GIVEN)
    try:
        wait_until_ready(the_driven_cell)
        yield process
    finally:
        code = process.stop()
    assert code == 0 and "Traceback" not in process.output and "exception" not in process.output, process.output


@pytest.fixture
def cell(node: NodeProcess, the_driven_cell: DrivenCell) -> DrivenCell:
    cell = the_driven_cell
    cell.box[:] = 0.0, 0.02, 0.3
    cell.earlier.update(cell.goals)
    for kept in (cell.commands, cell.states, cell.records, cell.goals):
        kept.clear()
    cell.faults.publish(String(data="none"))
    time.sleep(0.2)  # for the poses of the box
    return cell


def begin_approach(cell: DrivenCell) -> Call:
    """A push whose arm is in the middle of its first goal."""
    call = send(cell, **CONTACT)
    begin = cell.q.copy()
    wait_for(lambda: call.result.done() or (running(cell) and np.max(np.abs(cell.q - begin)) > 0.15))
    assert not call.result.done(), call.end()
    return call


def running(cell: DrivenCell) -> list[int]:
    return [status for status in list(cell.goals.values()) if status == GoalStatus.STATUS_EXECUTING]


def stood_at(cell: DrivenCell) -> float:
    """When the arm last moved, once it has stood for 0.3 s [s]."""

    def last_motion() -> float:
        states = list(cell.states)
        return max((t for (t, q), (_, before) in zip(states[1:], states, strict=False) if np.max(np.abs(q - before)) > 1e-4), default=0.0)

    wait_for(lambda: cell.states and cell.states[-1][0] - last_motion() > 0.3)
    return last_motion()


def test_push_whose_way_there_and_home_are_goals(cell: DrivenCell) -> None:
    before = cell.box.copy()
    call = send(cell, **CONTACT)
    wait_for(lambda: running(cell) or call.result.done())
    n_commands = len(cell.commands)
    wait_for(lambda: not running(cell))
    assert len(cell.commands) - n_commands <= 2, "no pieces while the controller has a goal"
    result = call.end()
    assert result.error_code == 0, result.error_text
    assert list(cell.goals.values()) == 2 * [GoalStatus.STATUS_SUCCEEDED]
    assert np.linalg.norm(cell.box[:2] - before[:2]) == pytest.approx(0.06, abs=0.005)
    assert cell.q == pytest.approx(PARKED, abs=1e-3) and len(cell.commands) > 20
    assert sorted(set(call.feedback)) == [0, 1, 2, 3, 4]


def test_cancel_in_the_approach_holds_the_arm_on_its_path(cell: DrivenCell) -> None:
    call = begin_approach(cell)
    with Stalls() as stalls:
        canceled = time.monotonic()
        ask(cell, call.handle.cancel_goal_async)
        stood = stood_at(cell)
    assert call.end().error_code == PushCode.CANCELED
    assert is_hold(cell.commands[-1][1])
    assert cell.q == pytest.approx(np.array(cell.commands[-1][1].points[0].positions), abs=1e-3)
    assert stood - canceled < BRAKING + 0.1 + 3 * stalls.worst
    wait_for(lambda: not running(cell))
    result = send(cell, **CONTACT).end()  # from where it stands
    assert result.error_code == 0, result.error_text


def test_joint_that_leaves_its_path_is_named_with_the_tolerance(cell: DrivenCell) -> None:
    call = begin_approach(cell)
    joint = cell.kinematics.joint_names[0]
    n_holds = len(cell.holds)
    cell.faults.publish(String(data=f"block {joint}"))
    result = call.end()
    assert result.error_code == PushCode.TRACKING
    assert "PATH_TOLERANCE_VIOLATED" in result.error_text, result.error_text
    assert joint in result.error_text and f"path_tolerance {PATH_TOLERANCE:.3f} rad" in result.error_text
    assert len(cell.holds) == n_holds, "the controller holds the arm; where it stands is not on the path"
    cell.faults.publish(String(data="none"))
    result = send(cell, **CONTACT).end()
    assert result.error_code == 0, result.error_text


def test_goal_of_another_client_ends_the_push(cell: DrivenCell) -> None:
    call = begin_approach(cell)
    stay = JointTrajectoryPoint(positions=cell.q.tolist(), time_from_start=Duration(sec=1))
    trajectory = JointTrajectory(joint_names=list(cell.kinematics.joint_names), points=[stay])
    ask(cell, lambda: cell.follow.send_goal_async(FollowJointTrajectory.Goal(trajectory=trajectory)))
    result = call.end()
    assert result.error_code == PushCode.BUSY and "Only one client" in result.error_text, result.error_text
    wait_for(lambda: not running(cell))


def test_goal_that_is_rejected_moves_nothing(cell: DrivenCell) -> None:
    cell.faults.publish(String(data="reject"))
    begin = cell.q.copy()
    result = send(cell, **CONTACT).end()
    assert result.error_code == PushCode.TRACKING and "rejected the goal" in result.error_text, result.error_text
    assert cell.q == pytest.approx(begin, abs=1e-3)


def test_stand_in_takes_what_joint_trajectory_controller_takes(cell: DrivenCell) -> None:
    names, here = list(cell.kinematics.joint_names), cell.q.tolist()

    def is_accepted(*points: JointTrajectoryPoint, joints: list[str] = names, stamp: Time = NOW) -> bool:
        trajectory = JointTrajectory(joint_names=joints, points=points)
        trajectory.header.stamp = stamp
        sent = ask(cell, lambda: cell.follow.send_goal_async(FollowJointTrajectory.Goal(trajectory=trajectory)))
        wait_for(sent.done)
        return bool(sent.result().accepted)

    def point(milliseconds: int, **fields: list[float]) -> JointTrajectoryPoint:
        return JointTrajectoryPoint(**({"positions": here} | fields), time_from_start=Duration(nanosec=milliseconds * 10**6))

    assert is_accepted(point(100), point(200, velocities=[0.0] * len(here)))
    assert not is_accepted()
    assert not is_accepted(point(100), stamp=Time(sec=1)), "its end is in the past"
    assert not is_accepted(point(200), point(100)), "times do not increase"
    assert not is_accepted(point(100, velocities=[0.1] * len(here))), "it does not end at rest"
    assert not is_accepted(point(100, positions=here[1:])) and not is_accepted(point(100, positions=[np.nan, *here[1:]]))
    assert not is_accepted(point(100), joints=["other", *names[1:]])
    wait_for(lambda: not running(cell))


@pytest.mark.long
def test_controller_that_dies_ends_the_push_and_no_other_begins_before_it_answers_again(
    cell: DrivenCell, controllers: list[ControllerProcess], domain: int, tmp_path: Path
) -> None:
    call = begin_approach(cell)
    controllers[-1].kill()
    result = call.end()
    assert result.error_code == PushCode.ARM_SILENT, result.error_text
    assert send(cell, **CONTACT).end().error_code == PushCode.ARM_SILENT
    controllers.append(start_controller(domain, cell, tmp_path))
    cell.goals.clear()
    n_states = len(cell.states)
    wait_for(lambda: len(cell.states) > n_states + 100)  # an arm that jumped is believed after a second
    result = send(cell, **CONTACT).end(40.0)
    assert result.error_code == 0, result.error_text


@pytest.mark.long
def test_arm_whose_executor_is_killed_goes_on_to_the_end_of_its_goal(
    cell: DrivenCell, node: NodeProcess, domain: int, tmp_path: Path
) -> None:
    """What SAFETY.md says of goals; with pieces it stands after 80 ms and braking."""
    assert node.stop() == 0
    other = start_node(domain, tmp_path, **GIVEN)
    try:
        wait_until_ready(cell)
        begin_approach(cell)
        other.kill()
        killed = time.monotonic()
        wait_for(lambda: not running(cell))
        assert list(cell.goals.values()) == [GoalStatus.STATUS_SUCCEEDED]
        assert stood_at(cell) - killed > 0.3
    finally:
        other.kill()
