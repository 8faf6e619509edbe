"""Executors of rclpy that outlive what a callback, a message or the middleware throws at them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.utilities import get_default_context

from push_ident.nodes.base.settings import NODE

EXECUTOR: Final = "PUSH_IDENT_EXECUTOR"
"""Variable that chooses the executor of nodes with one thread: `events`, the default, or `wait_sets`, that of rclpy's releases before."""


class _GuardedExecutor(Executor):  # type: ignore[misc]
    """Guards what callbacks themselves cannot: taking a message, sending an answer to a client that has gone, the work of rclpy around
    actions and events. In rclpy such an error ends the process, or blocks a callback group for ever.

    And looks for events once a second: rclpy builds a wait set for every message, and each publisher and subscription has two of them.
    """

    _next_events = 0.0
    _takes_events = True

    def spin_once(self, timeout_sec: float | None = None) -> None:
        self._takes_events = time.monotonic() >= self._next_events
        super().spin_once(timeout_sec)

    def can_execute(self, entity: Any) -> bool:
        if isinstance(entity, EventHandler):
            if not self._takes_events:
                return False
            self._next_events = time.monotonic() + NODE.event_period  # not before a wait set was built
        return bool(super().can_execute(entity))

    def _make_handler(self, entity: Any, node: Any, take_from_wait_list: Callable[[Any], Any]) -> Any:
        return super()._make_handler(entity, node, lambda entity: _guarded(entity, node.guard, take_from_wait_list))


class _Single(_GuardedExecutor, SingleThreadedExecutor):  # type: ignore[misc]
    pass


class _Multi(_GuardedExecutor, MultiThreadedExecutor):  # type: ignore[misc]
    pass


def make_executor(n_threads: int, *, in_turn: bool = False, context: Context | None = None) -> Executor:
    """An executor of so many threads for nodes that have a `guard`. With one thread only its `spin_once` may be used.

    With one thread it is rclpy's executor of events, which builds no wait set for each message but takes all in order of arrival
    (docs/decisions/0056-executor-of-events.md). `in_turn`: as `CellNode.in_turn`.
    """
    if n_threads > 1:
        return _Multi(n_threads, context=context)
    if in_turn or os.environ.get(EXECUTOR) == "wait_sets":
        return _Single(context=context)
    return _events_executor(context or get_default_context())


def _events_executor(context: Context) -> Executor:
    # Not by `rclpy.experimental.EventsExecutor`, which does this and changes how the process ends (faulthandler).
    executor: Executor = rclpy_implementation.EventsExecutor(context)
    context.on_shutdown(executor.wake)
    return executor


def _guarded(entity: Any, guard: Any, take: Callable[[Any], Any]) -> Any:
    source = _source(entity)
    work = None
    with guard.watch(source):
        work = take(entity)
    if work is None:
        return None

    async def guarded() -> None:
        with guard.watch(source):
            await work()

    return guarded


def _source(entity: Any) -> str:
    """Topic, service or type. Another thread may have destroyed the entity since it was found ready: then its name is gone."""
    with suppress(InvalidHandle):
        if name := getattr(entity, "topic_name", "") or getattr(entity, "srv_name", ""):
            return str(name)
    return type(entity).__name__
