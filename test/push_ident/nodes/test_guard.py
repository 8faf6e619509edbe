"""No message of any content ends a node: it is refused, counted and named."""

from __future__ import annotations

import logging
import time
from contextlib import suppress

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.context import Context
from rclpy.executors import TimeoutException
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from helpers.spinning import BareNode
from push_ident.errors import InputError
from push_ident.nodes.base.executors import make_executor
from push_ident.nodes.base.guard import Guard


@pytest.fixture
def own() -> Guard:
    return Guard(lambda: logging.getLogger("guard"))


def test_whatever_a_callback_raises_is_counted_and_named(own: Guard, caplog: pytest.LogCaptureFixture) -> None:
    def callback(message: object) -> None:
        raise InputError("a cell of 0 m") if message == 1 else ZeroDivisionError("of what?")

    guarded = own.callback("/objects/o1/cells", callback)
    with caplog.at_level(logging.INFO):
        guarded(1)
        guarded(2)
    assert own.values() == {"refused": "2", "last refusal": "/objects/o1/cells: ZeroDivisionError: of what?"}
    assert [record.getMessage() for record in caplog.records] == ["refused: /objects/o1/cells: a cell of 0 m"], "one line a topic at a time"
    assert "Traceback" not in caplog.text


def test_foreign_text_is_one_short_line_and_sources_without_end_are_counted_together(own: Guard) -> None:
    for number in range(1000):
        own.refuse(f"/objects/o{number}/pose", "\x1b[31mred\n" + "a" * 10_000)
    last = own.values()["last refusal"]
    assert own.refused == 1000 and len(last) < 500 and last.isprintable()


def test_a_service_that_fails_answers_with_the_reason(own: Guard) -> None:
    def callback(request: object, response: object) -> object:
        raise KeyError("o1")

    answer = own.service("/save_model", callback)(Trigger.Request(), Trigger.Response())
    assert not answer.success and answer.message == "KeyError: 'o1'"


def test_a_subscription_destroyed_before_its_message_is_taken_does_not_block_the_others(context: Context) -> None:
    node = BareNode(lambda node: node.create_subscription(PoseStamped, "pose", lambda message: None, 10), context=context)
    executor, publisher = make_executor(2, context=context), node.create_publisher(PoseStamped, "pose", 10)
    executor.add_node(node)
    deadline = time.monotonic() + 20.0
    while True:
        assert time.monotonic() < deadline
        publisher.publish(PoseStamped())
        with suppress(TimeoutException):
            work, entity, _ = executor.wait_for_ready_callbacks(timeout_sec=0.1)
            if isinstance(entity, Subscription) and entity.topic_name == "/pose":
                break
            work()
    node.destroy_subscription(entity)
    work()
    assert work.exception() is None and node.guard.refused == 0
    assert all(service.callback_group.can_execute(service) for service in node.services)
    node.close()
    executor.shutdown()
    node.destroy_node()
