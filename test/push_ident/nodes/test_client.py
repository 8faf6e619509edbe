"""The client of a cell waits for a push as long as the executor sends feedback, and no message ends its thread."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from helpers.fuzzing import fuzzed
from helpers.fuzzing.messages import messages_like
from helpers.fuzzing.right import OBJECT, right_messages
from helpers.spinning import spinning
from push_ident.nodes.base.guard import Guard, is_guarded
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.client.cell_client import CellClient, CellTimeout
from push_ident_msgs.action import ExecutePush

pytestmark = pytest.mark.live

DOMAIN = own_domain()
SILENCE = 0.6
"""[s]"""
SERVER = """
import time
import rclpy
from rclpy.action import ActionServer
from push_ident_msgs.action import ExecutePush

def execute(goal):
    goal.publish_feedback(ExecutePush.Feedback())
    time.sleep(60.0)

rclpy.init()
node = rclpy.create_node("executor")
server = ActionServer(node, ExecutePush, "execute_push", execute)
rclpy.spin(node)
"""
"""Begins a push, and does not end it."""


class Executor(Node):
    """Takes `speed` seconds over a push, and sends feedback `distance` times."""

    def __init__(self, context: Context) -> None:
        super().__init__("executor", context=context)
        self._closing, self._idle = threading.Event(), threading.Event()
        self._idle.set()
        self.guard = Guard(self.get_logger)
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


@contextmanager
def serving() -> Iterator[Executor]:
    with spinning(Executor, n_threads=2) as node:
        try:
            yield node
        finally:
            node.close()


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))


@pytest.fixture
def executor() -> Iterator[Executor]:
    with serving() as node:
        yield node


@pytest.fixture
def client(executor: Executor) -> Iterator[CellClient]:
    with CellClient() as own:
        yield own


def test_client_waits_for_a_long_push_while_feedback_comes(client: CellClient) -> None:
    silence, every, n_reports = 1.5, 0.3, 12  # a machine that stalls for a second makes no silence
    progress: list[float] = []
    started = time.monotonic()
    goal = ExecutePush.Goal(speed=n_reports * every, distance=float(n_reports))
    result = client.execute_push(goal, silence=silence, on_feedback=lambda feedback: progress.append(feedback.progress))
    assert time.monotonic() - started > 2.3 * silence
    assert result.push_id == 7 and len(progress) > 8


def test_executor_that_falls_silent_is_given_up(client: CellClient) -> None:
    started = time.monotonic()
    with pytest.raises(CellTimeout, match=r"sent no feedback for 1 s .* push_executor_node"):
        client.execute_push(ExecutePush.Goal(speed=10.0), silence=SILENCE)
    assert time.monotonic() - started < 8.0


def test_executor_that_was_started_again_meanwhile_has_no_such_push() -> None:
    with subprocess.Popen([sys.executable, "-c", SERVER]) as server, ExitStack() as stack:

        def start_again(feedback: ExecutePush.Feedback) -> None:
            server.kill()
            server.wait()
            stack.enter_context(serving())

        with CellClient() as client, pytest.raises(CellTimeout, match=r"push_executor_node was started again .* no result"):
            client.execute_push(ExecutePush.Goal(), on_feedback=start_again)


def test_messages_of_any_content_end_no_client_and_are_one_line(
    client: CellClient, executor: Executor, capfd: pytest.CaptureFixture[str]
) -> None:
    names = ("pusher/shape", "/diagnostics", *(f"objects/{OBJECT}/{name}" for name in ("cells", "outline", "pose", "mass_friction_map")))
    traffic = {name: right_messages()[name] for name in names}
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publishers = {name: executor.create_publisher(type(msg), name, latched) for name, msg in traffic.items()}
    client.wait(client.object_ids, 10.0, "the object was not found")
    client.wait(lambda: all(publisher.get_subscription_count() for publisher in publishers.values()), 10.0, "not discovered")

    @fuzzed(60)
    @given(st.fixed_dictionaries({name: messages_like(msg) for name, msg in traffic.items()}))
    def publish(changed: dict[str, object]) -> None:
        for name, msg in changed.items():
            with suppress(RuntimeError):  # nobody can send what cannot be written
                publishers[name].publish(msg)
        time.sleep(0.005)

    publish()
    client.wait(lambda: client.node.guard.refused > 60, 10.0, "fewer were refused")
    callbacks = [entity.callback for entity in (*client.node.subscriptions, *client.node.timers)]
    assert callbacks and all(is_guarded(callback) for callback in callbacks)
    assert client.execute_push(ExecutePush.Goal(speed=0.2, distance=2.0)).push_id == 7
    assert capfd.readouterr().err.count("[push_ident_client]") == 1
