"""Every lifecycle transition in every state, also those that do not exist: each is answered, and the state is the right one."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from push_ident.errors import PushIdentError

__all__ = ["LABELS", "NUMBERS", "Lifecycle"]

LABELS: Final = ("configure", "activate", "deactivate", "cleanup", "create", "destroy", "transition_success", "[/x]é\n", "a" * 10_000)
"""Of transitions, asked for by name."""
NUMBERS: Final = (*range(1, 5), 0, 8, 10, 11, 12, 40, 62, 99, 254, 255)
"""Of transitions, asked for without a name."""
_SHUTDOWN: Final = {"unconfigured": 5, "inactive": 6, "active": 7}
_NEXT: Final = {
    ("unconfigured", "configure"): "inactive",
    ("inactive", "activate"): "active",
    ("inactive", "cleanup"): "unconfigured",
    ("active", "deactivate"): "inactive",
}
_NAMES: Final = {1: "configure", 2: "cleanup", 3: "activate", 4: "deactivate"}
_WAY: Final = {
    ("unconfigured", "inactive"): "configure",
    ("unconfigured", "active"): "configure",
    ("inactive", "active"): "activate",
    ("active", "inactive"): "deactivate",
    ("active", "unconfigured"): "deactivate",
    ("inactive", "unconfigured"): "cleanup",
}
"""The transition that leads from one state towards another."""
_AGAIN: Final = 2.5
"""A node that does not answer when it starts is asked again after this time [s]."""


class Lifecycle:
    """Asks one node for transitions.

    Args:
        node: that asks; `executor` spins it.
        name: of the node that is asked.
        patience: longest time to an answer [s].
    """

    def __init__(self, node: Node, executor: SingleThreadedExecutor, name: str, *, patience: float = 60.0) -> None:
        self._executor, self._name, self._patience = executor, name, patience
        self._change = node.create_client(ChangeState, f"{name}/change_state")
        self._get = node.create_client(GetState, f"{name}/get_state")
        self.slowest = 0.0
        """Longest time to an answer so far [s]."""

    @staticmethod
    @contextmanager
    def of(name: str, domain: int) -> Iterator[Lifecycle]:
        """With a node of its own in a ROS domain."""
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        node = Node("lifecycle_client", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            yield Lifecycle(node, executor, name)
        finally:
            executor.shutdown()
            node.destroy_node()
            context.try_shutdown()

    def wait(self, timeout: float = 120.0) -> None:
        """Until the node answers; raises PushIdentError when it does not.

        A node that has not found the reading end of a client yet drops its answer: the state is asked for again until it comes.
        """
        deadline, again = time.monotonic() + timeout, 0.0
        answers: list[Any] = []
        while not (self._change.service_is_ready() and self._get.service_is_ready()):
            if time.monotonic() > deadline:
                raise PushIdentError(f"{self._name} has no lifecycle services after {timeout:.0f} s; does it run?")
            self._executor.spin_once(timeout_sec=0.05)
        while not any(answer.done() for answer in answers):
            now = time.monotonic()
            if now > deadline:
                raise PushIdentError(f"{self._name} has lifecycle services and does not answer within {timeout:.0f} s; see its log")
            if now > again:
                answers.append(self._get.call_async(GetState.Request()))
                again = now + _AGAIN
            self._executor.spin_once(timeout_sec=0.05)

    def state(self) -> str:
        """Label of the node's state."""
        return str(self._ask(self._get, GetState.Request()).current_state.label)

    def change(self, label: str = "", number: int = 0) -> bool:
        """Whether the node made the transition; raises PushIdentError without an answer."""
        return bool(self._ask(self._change, ChangeState.Request(transition=Transition(id=number, label=label))).success)

    def go_to(self, state: str) -> None:
        """Lead the node to one of its states but finalized."""
        while (now := self.state()) != state:
            if not self.change(_WAY[now, state]):
                raise PushIdentError(f"{self._name} does not go from {now} to {state}; see its log")

    def exercise(self, rounds: int = 1) -> list[str]:
        """Every transition in every state, `rounds` times; what was wrong. The node is active after it."""
        faults = []
        for _ in range(rounds):
            for state in ("unconfigured", "inactive", "active"):
                self.go_to(state)
                shutdowns = [("", number) for name, number in _SHUTDOWN.items() if name != state]
                for label, number in [*((label, 0) for label in LABELS), *(("", number) for number in NUMBERS), *shutdowns]:
                    expected = _NEXT.get((state, label or _NAMES.get(number, "")))
                    success, after = self.change(label, number), self.state()
                    if success != (expected is not None) or after != (expected or state):
                        faults.append(f"{self._name}: {label[:40] or number} in {state}: {success}, {after}")
                    if after != state:
                        self.go_to(state)
        self.go_to("active")
        return faults

    def shut_down(self) -> list[str]:
        """Shut the node down by its service, then ask for everything; what was wrong. The node cannot be used after it."""
        faults = [] if self.change("shutdown") else [f"{self._name}: shutdown is refused"]
        faults += [f"{self._name}: {label[:40]} is made after shutdown" for label in (*LABELS, "shutdown") if self.change(label)]
        faults += [f"{self._name}: {number} is made after shutdown" for number in (*NUMBERS, 5, 6, 7) if self.change(number=number)]
        return faults if self.state() == "finalized" else [*faults, f"{self._name}: {self.state()} after shutdown"]

    def _ask(self, client: Any, request: Any) -> Any:
        asked = time.monotonic()
        future = client.call_async(request)
        # Not `spin_until_future_complete`, which becomes slower with every call.
        while not future.done() and time.monotonic() < asked + self._patience:
            self._executor.spin_once(timeout_sec=0.1)
        if not future.done():
            raise PushIdentError(f"{self._name} does not answer {request} within {self._patience:.0f} s")
        self.slowest = max(self.slowest, time.monotonic() - asked)
        return future.result()
