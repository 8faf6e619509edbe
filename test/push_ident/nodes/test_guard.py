"""No message of any content ends a node: it is refused, counted and named."""

from __future__ import annotations

import logging
import time
from contextlib import suppress

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import TimeoutException
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from helpers.spinning import BareNode
from push_ident.errors import InputError
from push_ident.nodes.base.arrivals import StampCheck
from push_ident.nodes.base.executors import make_executor
from push_ident.nodes.base.guard import Guard


def guard() -> Guard:
    return Guard(lambda: logging.getLogger("guard"))


# ---- the guard itself


def test_whatever_a_callback_raises_is_counted_and_named(caplog: pytest.LogCaptureFixture) -> None:
    own = guard()

    def callback(message: object) -> None:
        raise InputError("a cell of 0 m") if message == 1 else ZeroDivisionError("of what?")

    guarded = own.callback("/objects/o1/cells", callback)
    with caplog.at_level(logging.INFO):
        guarded(1)
        guarded(2)
    assert own.values() == {"refused": "2", "last refusal": "/objects/o1/cells: ZeroDivisionError: of what?"}
    assert [record.getMessage() for record in caplog.records] == ["refused: /objects/o1/cells: a cell of 0 m"], "one line a topic at a time"
    assert "Traceback" not in caplog.text


def test_foreign_text_is_one_short_line_and_sources_without_end_are_counted_together() -> None:
    own = guard()
    for number in range(1000):
        own.refuse(f"/objects/o{number}/pose", "\x1b[31mred\n" + "a" * 10_000)
    last = own.values()["last refusal"]
    assert own.refused == 1000 and len(last) < 500 and last.isprintable()


def test_a_service_that_fails_answers_with_the_reason() -> None:
    own = guard()

    def callback(request: object, response: object) -> object:
        raise KeyError("o1")

    answer = own.service("/save_model", callback)(Trigger.Request(), Trigger.Response())
    assert not answer.success and answer.message == "KeyError: 'o1'"
    request = SetParameters.Request(parameters=[rclpy.parameter.Parameter("a").to_parameter_msg()] * 2)
    results = own.service("/set_parameters", callback)(request, SetParameters.Response()).results
    assert [result.successful for result in results] == [False, False]


# ---- one wrong stamp


def test_one_huge_stamp_is_refused_and_the_stream_goes_on() -> None:
    check = StampCheck()
    check.check("pose", 100.0)
    with pytest.raises(InputError, match="from those of other messages"):
        check.check("pose", 1e9)
    check.check("pose", 100.03)
    with pytest.raises(InputError):
        check.check("pose", 0.0)
    check.check("pose", 100.06)
    check.check("pusher", 98.0)


def test_messages_that_agree_on_another_time_are_believed() -> None:
    check = StampCheck()
    check.check("pose", 1000.0)
    check.check("pusher", 1000.0)
    for stamp in (5.0, 5.03):
        with pytest.raises(InputError):
            check.check("pose", stamp)
    check.check("pose", 5.06)
    check.check("pusher", 1000.1)  # what was still waiting from before
    check.check("pusher", 5.0)


# ---- a node


def test_a_subscription_destroyed_before_its_message_is_taken_does_not_block_the_others(context: Context) -> None:
    node = BareNode(lambda node: node.create_subscription(PoseStamped, "pose", lambda message: None, 10), context=context)
    executor, publisher = make_executor(1, context=context), node.create_publisher(PoseStamped, "pose", 10)
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
