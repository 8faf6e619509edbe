"""A gripper with an action of control_msgs as the hand of the executor; its server stands in for that of a driver. About 8 s."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from control_msgs.action import GripperCommand, ParallelGripperCommand
from rclpy.action import ActionClient, ActionServer, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from helpers.executor_cell import ask, wait_for
from helpers.spinning import BareNode, running, spinning
from push_ident.nodes.push_executor.gripper_port import GripperHand, GripperSettings
from push_ident.nodes.push_executor.push_executor_node import PushExecutorNode
from push_ident.pushing.push import PushCode
from push_ident_msgs.action import ExecutePush

pytestmark = pytest.mark.live

ACTION = "/robotiq_gripper_controller/gripper_cmd"
JOINT = "robotiq_85_left_knuckle_joint"


class Gripper(Node):
    """The server of a gripper, as a controller of ros2_controllers, whose goals end as `outcome` says."""

    def __init__(self, context: Context) -> None:
        super().__init__("gripper", context=context)
        self.outcome = "reached"
        self.asked: list[tuple[float, float]] = []
        self._server: ActionServer | None = None
        self._states = self.create_publisher(JointState, "joint_states", qos_profile_sensor_data)

    def serve(self, kind: type) -> None:
        self._server = ActionServer(
            self,
            kind,
            ACTION,
            lambda handle: self._end(kind, handle),
            goal_callback=lambda goal: GoalResponse.REJECT if self.outcome == "rejected" else GoalResponse.ACCEPT,
            handle_accepted_callback=lambda handle: None if self.outcome == "silent" else handle.execute(),
        )

    def leave(self) -> None:
        if self._server is not None:
            self._server.destroy()
        self._server = None

    def say(self, position: float) -> None:
        self._states.publish(JointState(name=[JOINT], position=[position]))

    def _end(self, kind: type, handle: ServerGoalHandle) -> Any:
        command, result = handle.request.command, kind.Result()
        effort = command.max_effort if kind is GripperCommand else command.effort[0]
        self.asked.append((command.position if kind is GripperCommand else command.position[0], effort))
        result.reached_goal, result.stalled = self.outcome == "reached", self.outcome.startswith("stalled")
        (handle.succeed if self.outcome in ("reached", "stalled") else handle.abort)()
        return result


@pytest.fixture
def listener(domain: int) -> Iterator[BareNode]:
    # As the executor, which has several threads: rclpy's executor of events knows no guard conditions.
    with spinning(lambda context: BareNode(context=context), domain, n_threads=2) as node:
        yield node


@pytest.fixture
def gripper(domain: int) -> Iterator[Gripper]:
    with spinning(Gripper, domain) as node:
        yield node
        node.leave()


@pytest.fixture
def hand(listener: BareNode) -> Iterator[GripperHand]:
    settings = GripperSettings(ACTION, 0.8, 50.0, "", 0.02, 0.5)
    port = GripperHand(listener, settings, callback_group=listener.default_callback_group)
    yield port
    port.close()


def never() -> bool:
    return False


@pytest.mark.parametrize("kind", [GripperCommand, ParallelGripperCommand])
def test_gripper_is_closed_once_it_reached_its_position_or_holds_something(kind: type, gripper: Gripper, hand: GripperHand) -> None:
    assert "not been closed" in hand.why_no_fist()
    gripper.serve(kind)
    for outcome in ("reached", "stalled", "stalled but not allowed to"):
        gripper.outcome = outcome
        wait_for(lambda: hand.close_fist(5.0, never) == "")
        assert hand.why_no_fist() == "" and gripper.asked[-1] == (0.8, 50.0)
    gripper.leave()
    wait_for(lambda: "has left since it was closed" in hand.why_no_fist())
    gripper.serve(kind)
    assert "has left" in hand.why_no_fist(), "it may have been opened meanwhile"


def test_gripper_that_did_not_close_says_why(gripper: Gripper, hand: GripperHand) -> None:
    wait_for(lambda: f"no server of the action {ACTION}, GripperCommand or" in hand.close_fist(0.3, never))
    gripper.serve(ParallelGripperCommand)
    wait_for(lambda: hand.close_fist(5.0, never) == "")
    for outcome, why in (("rejected", "rejected the goal"), ("neither", "neither reached"), ("silent", "has not reported")):
        gripper.outcome = outcome
        assert why in hand.close_fist(2.0, never)
        assert why in hand.why_no_fist(), "no push begins"
    gripper.outcome = "silent"
    assert "has not reported" in hand.close_fist(60.0, lambda: True), "the node is stopped"


def test_gripper_whose_joint_leaves_where_it_closed_or_falls_silent_is_open(listener: BareNode, gripper: Gripper) -> None:
    settings = GripperSettings(ACTION, 0.8, 50.0, JOINT, 0.02, 0.5)
    hand = GripperHand(listener, settings, callback_group=listener.default_callback_group)
    gripper.serve(GripperCommand)

    def closes() -> bool:
        gripper.say(0.45)  # on a pin
        return hand.close_fist(5.0, never) == ""

    wait_for(closes)

    def says(position: float, text: str) -> bool:
        gripper.say(position)
        return text in hand.why_no_fist()

    wait_for(lambda: says(0.46, "") and hand.why_no_fist() == "")
    wait_for(lambda: says(0.3, "the gripper has moved"))
    wait_for(lambda: says(0.45, "") and hand.why_no_fist() == "")
    wait_for(lambda: f"joint {JOINT} in joint_states for" in hand.why_no_fist())
    hand.close()


def test_executor_closes_the_gripper_and_pushes_only_with_it_closed(gripper: Gripper, domain: int) -> None:
    gripper.serve(ParallelGripperCommand)
    close, push = gripper.create_client(Trigger, "close_hand"), ActionClient(gripper, ExecutePush, "execute_push")

    def answer(of: Callable[[], Any]) -> Any:
        future = ask(gripper, of)
        wait_for(future.done)
        return future.result()

    def refusal() -> ExecutePush.Result:
        handle = answer(lambda: push.send_goal_async(ExecutePush.Goal()))
        return answer(handle.get_result_async).result

    with running(PushExecutorNode, domain, "hand:=gripper_action", f"hand_action:={ACTION}", n_threads=5):
        wait_for(lambda: close.service_is_ready() and push.server_is_ready())
        assert refusal().error_code == PushCode.HAND and "call close_hand" in refusal().error_text
        response = answer(lambda: close.call_async(Trigger.Request()))
        assert response.success, response.message
        assert refusal().error_code == PushCode.UNKNOWN_OBJECT, "the hand is no reason any more"
    push.destroy()


@pytest.mark.parametrize("parameter", ["hand:=gripper_action", "free_motions:=follow_joint_trajectory"])
def test_executor_without_control_msgs_names_the_parameter_and_the_remedy(
    parameter: str, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "control_msgs.action", None)
    with running(PushExecutorNode, domain) as node:  # without them, as ever
        assert node.component is not None
    needs = f"Parameter {parameter.replace(':=', ' is ')}, which needs control_msgs.*install ros-jazzy"
    with pytest.raises(Exception, match=needs), running(PushExecutorNode, domain, parameter):
        pass
