"""The client of a cell waits for a push as long as the executor sends feedback."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.context import Context
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node

from push_ident.nodes.client import CellClient, CellTimeout
from push_ident.nodes.network import process_domain
from push_ident_msgs.action import ExecutePush

pytestmark = pytest.mark.alone

SILENCE = 0.6
"""[s]"""


class Executor(Node):
    """Takes `speed` seconds over a push, and sends feedback `distance` times."""

    def __init__(self, context: Context) -> None:
        super().__init__("executor", context=context)
        self._closing, self._idle = threading.Event(), threading.Event()
        self._idle.set()
        self._server = ActionServer(self, ExecutePush, "execute_push", self._execute)

    def _execute(self, goal: ServerGoalHandle) -> ExecutePush.Result:
        self._idle.clear()
        n_reports = int(goal.request.distance)
        for i in range(n_reports):
            goal.publish_feedback(ExecutePush.Feedback(phase=ExecutePush.Feedback.PHASE_PUSH, progress=i / n_reports))
            self._closing.wait(goal.request.speed / n_reports)
        if not n_reports:
            self._closing.wait(goal.request.speed)
        goal.succeed()
        self._idle.set()
        return ExecutePush.Result(push_id=7)

    def close(self) -> None:
        self._closing.set()
        self._idle.wait(1.0)


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Iterator[CellClient]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(process_domain()))
    context = Context()
    rclpy.init(context=context)
    node = Executor(context)
    executor = MultiThreadedExecutor(2, context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        with CellClient() as own:
            yield own
    finally:
        node.close()
        executor.shutdown(timeout_sec=1.0)
        node.destroy_node()
        rclpy.try_shutdown(context=context)
        thread.join(timeout=2.0)


def test_client_waits_for_a_long_push_while_feedback_comes(client: CellClient) -> None:
    silence, every, n_reports = 2.0, 0.4, 12  # a machine that stalls for a second makes no silence
    progress: list[float] = []
    started = time.monotonic()
    goal = ExecutePush.Goal(speed=n_reports * every, distance=float(n_reports))
    result = client.execute_push(goal, silence=silence, on_feedback=lambda feedback: progress.append(feedback.progress))
    assert time.monotonic() - started > 2.3 * silence
    assert result.push_id == 7 and len(progress) > 8


def test_feedback_that_comes_after_the_result_is_not_heard(client: CellClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both come on topics of their own: a command would print the state of a push that is over, and take it for its outcome."""
    progress: list[float] = []
    callbacks: list[Callable[[object], None]] = []
    send = ActionClient.send_goal_async

    def noting(action: ActionClient, goal: object, feedback_callback: Callable[[object], None]) -> object:
        callbacks.append(feedback_callback)
        return send(action, goal, feedback_callback=feedback_callback)

    monkeypatch.setattr(ActionClient, "send_goal_async", noting)
    client.execute_push(ExecutePush.Goal(speed=0.2, distance=2.0), on_feedback=lambda feedback: progress.append(feedback.progress))
    assert len(callbacks) == 1 and 1.0 not in progress
    callbacks[0](ExecutePush.Impl.FeedbackMessage(feedback=ExecutePush.Feedback(progress=1.0)))
    assert 1.0 not in progress


def test_executor_that_falls_silent_is_given_up(client: CellClient) -> None:
    started = time.monotonic()
    with pytest.raises(CellTimeout, match=r"sent no feedback for 1 s .* push_executor_node"):
        client.execute_push(ExecutePush.Goal(speed=10.0), silence=SILENCE)
    assert time.monotonic() - started < 8.0
