"""A node of a test whose callbacks run in a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

AnyNode = TypeVar("AnyNode", bound=Node)


@contextmanager
def spinning(make: Callable[[Context], AnyNode], domain: int | None = None) -> Iterator[AnyNode]:
    """The node that `make` makes, on a ROS domain, by default that of the tests."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = make(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield node
    finally:
        executor.shutdown()
        thread.join(30.0)
        node.destroy_node()
        context.try_shutdown()
