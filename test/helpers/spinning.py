"""A node of a test whose callbacks run in a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.executors import make_executor

AnyNode = TypeVar("AnyNode", bound=Node)
AnyCellNode = TypeVar("AnyCellNode", bound=CellNode)


@contextmanager
def spinning(make: Callable[[Context], AnyNode], domain: int | None = None, *, n_threads: int = 1) -> Iterator[AnyNode]:
    """The node that `make` makes, on a ROS domain, by default that of the tests; a `CellNode` may have several threads."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = make(context)
    executor = SingleThreadedExecutor(context=context) if n_threads == 1 else make_executor(n_threads, context=context)
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


@contextmanager
def running(kind: type[AnyCellNode], domain: int, *parameters: str, file: Path | None = None, n_threads: int = 1) -> Iterator[AnyCellNode]:
    """A node of the suite in this process, with parameters as `name:=value` and those of a file; closed at the end."""
    arguments = ["--ros-args", *(("--params-file", str(file)) if file else ()), *(word for given in parameters for word in ("-p", given))]
    with spinning(lambda context: kind(context=context, cli_args=arguments), domain, n_threads=n_threads) as node:
        try:
            yield node
        finally:
            node.close()
