"""A node of a test whose callbacks run in a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.context import Context
from rclpy.node import Node

from push_ident.nodes.base.cell_node import CellNode, Component, Health
from push_ident.nodes.base.executors import make_executor

AnyNode = TypeVar("AnyNode", bound=Node)
AnyCellNode = TypeVar("AnyCellNode", bound=CellNode)


class BareComponent(Component):
    """One that is always well."""

    def health(self) -> Health:
        return Health(DiagnosticStatus.OK, "")


class BareNode(CellNode):
    """A node of the suite that has what `build` adds to it."""

    def __init__(self, build: Callable[[CellNode], object] = lambda node: None, **kwargs: Any) -> None:
        self._build = build
        super().__init__("bare_node", (), **kwargs)

    def make_component(self) -> Component:
        self._build(self)
        return BareComponent()


@contextmanager
def spinning(make: Callable[[Context], AnyNode], domain: int | None = None, *, n_threads: int = 1) -> Iterator[AnyNode]:
    """The node that `make` makes, on a ROS domain, by default that of the tests; a `CellNode` may have several threads."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = make(context)
    executor = make_executor(n_threads, in_turn=getattr(node, "in_turn", False), context=context)
    executor.add_node(node)
    is_over = threading.Event()

    def spin_once_and_again() -> None:
        # `spin` of rclpy's executor of events takes a whole core and calls nothing back.
        while not is_over.is_set():
            executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=executor.spin if n_threads > 1 else spin_once_and_again, daemon=True)
    thread.start()
    try:
        yield node
    finally:
        is_over.set()
        if n_threads == 1:
            thread.join(30.0)
        executor.shutdown()
        thread.join(30.0)
        node.destroy_node()
        context.try_shutdown()


@contextmanager
def running(
    kind: Callable[..., AnyCellNode], domain: int, *parameters: str, file: Path | None = None, n_threads: int = 1
) -> Iterator[AnyCellNode]:
    """A node of the suite in this process, with parameters as `name:=value` and those of a file; closed at the end."""
    arguments = ["--ros-args", *(("--params-file", str(file)) if file else ()), *(word for given in parameters for word in ("-p", given))]
    with spinning(lambda context: kind(context=context, cli_args=arguments), domain, n_threads=n_threads) as node:
        try:
            yield node
        finally:
            node.close()
