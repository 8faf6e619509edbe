"""Requests of any thread, made in a callback group."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from rclpy.callback_groups import CallbackGroup

from push_ident.nodes.base.cell_node import CellNode


class GroupCalls:
    """Calls what any thread asks for in the callback group of a client.

    From another thread, an answer may arrive before rclpy has registered the request, and is dropped.
    """

    def __init__(self, node: CellNode, source: str, group: CallbackGroup) -> None:
        """`source` names what is refused where a call fails."""
        self._node = node
        self._calls: deque[Callable[[], object]] = deque()
        self._bell = node.create_guard_condition(node.guard.callback(source, self._call), callback_group=group)

    def ask(self, call: Callable[[], object]) -> None:
        """Make a call soon."""
        self._calls.append(call)
        self._bell.trigger()

    def close(self) -> None:
        """Make no more calls."""
        self._node.destroy_guard_condition(self._bell)

    def _call(self) -> None:
        while self._calls:
            self._calls.popleft()()
