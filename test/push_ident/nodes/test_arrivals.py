"""What a full queue drops is counted, and a stage that is slower than its input says so."""

from __future__ import annotations

import time
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import String

from push_ident.nodes.base.arrivals import Arrivals
from push_ident.nodes.base.cell_node import CellNode, Component, Health
from push_ident.nodes.base.network import own_domain


def info(number: int | None, age: float = 0.0) -> dict[str, Any]:
    return {"publication_sequence_number": number, "source_timestamp": time.time_ns() - round(1e9 * age)}


def test_gaps_of_the_numbers_are_messages_that_were_lost() -> None:
    arrivals = Arrivals(lambda: 1)
    for number in (7, 8, 11, 12):
        arrivals.note(info(number, age=0.2))
    lost, taken, delay = arrivals.since_last()
    assert (lost, taken) == (2, 4)
    assert 0.19 < delay < 1.0
    assert arrivals.since_last() == (0, 0, 0.0)
    assert arrivals.n_lost == 2


def test_publisher_that_starts_again_loses_nothing() -> None:
    arrivals = Arrivals(lambda: 1)
    for number in (500, 501, 1, 2):
        arrivals.note(info(number))
    assert arrivals.n_lost == 0


def test_numbers_of_several_publishers_are_not_compared() -> None:
    arrivals = Arrivals(lambda: 2)
    for number in (1, 900, 2, 901):
        arrivals.note(info(number))
    assert arrivals.n_lost == 0


def test_middleware_without_numbers_is_counted_only() -> None:
    arrivals = Arrivals(lambda: 1)
    arrivals.note({"publication_sequence_number": None, "source_timestamp": None})
    assert arrivals.since_last() == (0, 1, 0.0)


class Slow(Component):
    """Takes 30 ms for a message."""

    def __init__(self, node: CellNode) -> None:
        self.arrivals = node.arrivals_of("words")
        node.create_subscription(String, "words", lambda msg: time.sleep(0.03), qos_profile_sensor_data, arrivals=self.arrivals)

    def health(self) -> Health:
        return Health(DiagnosticStatus.OK, "")


class SlowNode(CellNode):
    """A node whose input is faster than its callback."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("slow_node", (), **kwargs)

    def make_component(self) -> Component:
        self.slow = Slow(self)
        return self.slow


def test_node_counts_what_its_queue_drops() -> None:
    context = Context()
    rclpy.init(context=context, domain_id=own_domain())
    executor = SingleThreadedExecutor(context=context)
    try:
        node, source = SlowNode(context=context), Node("source", context=context)
        executor.add_node(node)
        words = source.create_publisher(String, "words", qos_profile_sensor_data)
        deadline = time.monotonic() + 10.0
        while not words.get_subscription_count() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)
        words.publish(String(data="first"))
        while not node.slow.arrivals.n_taken and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)
        for _ in range(100):
            words.publish(String(data="more"))
        while time.monotonic() < deadline and node.slow.arrivals.n_taken + node.slow.arrivals.n_lost < 101:
            executor.spin_once(timeout_sec=0.05)
        assert node.slow.arrivals.n_taken + node.slow.arrivals.n_lost == 101
        assert node.slow.arrivals.n_lost > 50  # the queue holds five
        assert node.raw_callbacks() == []
        node.close()
        source.destroy_node()
    finally:
        executor.shutdown(timeout_sec=0.5)
        context.try_shutdown()
