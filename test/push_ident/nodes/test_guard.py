"""No message of any content ends a node: it is refused, counted and named."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.executors import Executor, TimeoutException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from push_ident.errors import InputError
from push_ident.nodes.base.arrivals import StampCheck
from push_ident.nodes.base.cell_node import CellNode, Component, Health
from push_ident.nodes.base.executors import make_executor
from push_ident.nodes.base.guard import Guard
from push_ident.nodes.base.network import own_domain


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


# ---- nodes


class Picky(CellNode):
    """Raises on every message."""

    def __init__(self, context: Context) -> None:
        super().__init__("picky", (), context=context)

    def make_component(self) -> Component:
        return _Picky(self)


class _Picky(Component):
    def __init__(self, node: CellNode) -> None:
        self.n_heard = 0
        node.create_subscription(PoseStamped, "pose", self.hear, 10)

    def hear(self, message: PoseStamped) -> None:
        self.n_heard += 1
        raise IndexError("out of range")

    def health(self) -> Health:
        return Health(DiagnosticStatus.OK, "")


@pytest.fixture
def picky() -> Iterator[tuple[Picky, Executor, Publisher]]:
    """The node, its executor, and a publisher that it hears."""
    context = Context()
    rclpy.init(context=context, domain_id=own_domain())
    sender, node = Node("sender", context=context), Picky(context)
    executor = make_executor(1, context=context)
    executor.add_node(node)
    publisher = sender.create_publisher(PoseStamped, "pose", 10)
    for _ in range(500):
        if publisher.get_subscription_count():
            break
        executor.spin_once(timeout_sec=0.02)
    yield node, executor, publisher
    node.close()
    executor.shutdown()
    node.destroy_node()
    sender.destroy_node()
    context.try_shutdown()


def test_messages_with_damaged_bytes_do_not_keep_the_next_one_away(picky: tuple[Picky, Executor, Publisher]) -> None:
    node, executor, publisher = picky
    for data in (b"\x00\x01\x00\x00", b"\x00\x01\x00\x00" + b"\xff" * 40, b""):
        publisher.publish(data)
    publisher.publish(PoseStamped())
    for _ in range(100):
        executor.spin_once(timeout_sec=0.02)
        if node.component.n_heard:
            break
    assert node.component.n_heard == 1
    assert "/pose" in node.guard.values()["last refusal"] and "IndexError" in node.guard.values()["last refusal"]


def test_a_subscription_destroyed_before_its_message_is_taken_does_not_block_the_others(picky: tuple[Picky, Executor, Publisher]) -> None:
    node, executor, publisher = picky
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


def test_events_are_heard_although_they_are_looked_for_once_a_second(
    picky: tuple[Picky, Executor, Publisher], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, executor, publisher = picky
    added: list[EventHandler] = []
    add = EventHandler.add_to_wait_set

    def counted(event: EventHandler, wait_set: Any) -> None:
        added.append(event)
        add(event, wait_set)

    monkeypatch.setattr(EventHandler, "add_to_wait_set", counted)
    context = Context()
    rclpy.init(context=context, domain_id=executor.context.get_domain_id())
    other = Node("other", context=context)
    other.create_publisher(PoseStamped, "pose", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    said, deadline, n_spins = "", time.monotonic() + 20.0, 0
    while ("incompatible QoS" not in said or n_spins < 100) and time.monotonic() < deadline:
        publisher.publish(PoseStamped())
        executor.spin_once(timeout_sec=0.02)
        n_spins += 1
        said += capfd.readouterr().err
    other.destroy_node()
    context.try_shutdown()
    assert "incompatible QoS" in said
    assert 0 < added.count(added[0]) < 0.5 * n_spins
