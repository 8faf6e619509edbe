"""The client and the server of an action each notice within seconds that the other one is gone, however it went.

A client that is to be missed begins the number of its goal with `_MARK`, and says that number on `<action>/keep_alive` ten times a second,
from before it sends the goal until it has the result. It does so in the thread that takes in the result: one that is dead or stuck says
nothing. To its server, silence is an end of the goal from the first moment on. The numbers of others, as of `ros2 action send_goal`,
promise nothing: their goals are carried out to the end.

A server is gone where it has left the ROS graph, or answers no more. One that was killed stays in the graph for 20 s (leaseDuration in
`config/fastdds_local.xml`), and one that plans sends no feedback, so a silent server is asked: to cancel a goal that nobody has, which
changes nothing. One that was killed and started again does answer, but has no such goal: whoever asks for its result hears so.

Silence is counted in looks, not between two times: to a process that stood still, all others seem to have been silent.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

from action_msgs.srv import CancelGoal
from rclpy.action import ActionClient
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from unique_identifier_msgs.msg import UUID

from push_ident.nodes.base.cell_node import CellNode

_MARK: Final = b"keepaliv"
"""Of numbers of goals; the other 8 bytes are random, and other clients draw all 16."""
_SIGNS: Final = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
"""A sign that is lost is followed by the next; no reader may hold up its client."""


@dataclass(frozen=True, slots=True)
class KeepAliveTimes:
    """Set by what is promised: an arm whose client is gone stands after about a second, and a client hears of its server within seconds."""

    period: float = 0.1
    """Between two signs of life of a client, and between two checks for them [s]."""
    absence: float = 0.7
    """Without the server in the ROS graph until it counts as gone [s]: with a look before and after it less than a second."""
    question_period: float = 0.5
    """Silence after which a server is asked, and between two questions [s]; one that runs answers within milliseconds."""
    silence: float = 3.0
    """After which a server that was asked is gone [s]: no node may stall for as long, see `arm_timeout` of a simulated cell (1 s)."""


KEEP_ALIVE: Final = KeepAliveTimes()


def _topic(action: str) -> str:
    return f"{action}/keep_alive"


def cancellation(goal: UUID | None = None) -> CancelGoal.Request:
    """To cancel a goal; None: one that does not exist."""
    request = CancelGoal.Request()
    request.goal_info.goal_id = goal or UUID(uuid=list(os.urandom(16)))
    return request


class KeepAlive:
    """The signs of life of the client of an action, for each of its goals."""

    def __init__(self, node: Node, action: str, *, callback_group: CallbackGroup | None = None) -> None:
        """`callback_group` is that of the client: what blocks it silences the signs, too. Made before a client of the action's services:
        whoever answers that one hears the signs as well."""
        self._goals: dict[bytes, UUID] = {}
        self._publisher = node.create_publisher(UUID, _topic(action), _SIGNS)
        # On the wall clock: it must run when simulated time stands still.
        node.create_timer(KEEP_ALIVE.period, self._say, callback_group=callback_group, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def begin(self) -> UUID:
        """Number of a new goal, whose signs of life are sent until `end`."""
        number = _MARK + os.urandom(16 - len(_MARK))
        goal = self._goals[number] = UUID(uuid=list(number))
        return goal

    def end(self, goal: UUID) -> None:
        """Nobody waits for a goal any more."""
        self._goals.pop(bytes(goal.uuid), None)

    def _say(self) -> None:
        for goal in list(self._goals.values()):
            self._publisher.publish(goal)


class _RunningTime:
    """Time in which this process ran: what lies between two looks, but no more than twice their period."""

    def __init__(self) -> None:
        self._looked = time.monotonic()

    def passed(self) -> float:
        """Since the last look [s]; 0 and no look where that was less than the period ago."""
        passed = time.monotonic() - self._looked
        if passed < KEEP_ALIVE.period:
            return 0.0
        self._looked += passed
        return min(passed, 2 * KEEP_ALIVE.period)


@dataclass(slots=True)
class _Silence:
    seconds: float = 0.0


class ClientWatch:
    """Hears the signs of life of the clients of an action."""

    def __init__(self, node: CellNode, action: str) -> None:
        self._silences: dict[bytes, _Silence] = {}
        self._running_time = _RunningTime()
        self._lock = threading.Lock()
        group = MutuallyExclusiveCallbackGroup()
        node.create_subscription(UUID, _topic(action), self._on_sign, _SIGNS, callback_group=group)
        node.create_timer(KEEP_ALIVE.period, self._count, callback_group=group, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @contextmanager
    def over(self, goal: ServerGoalHandle, timeout: float) -> Iterator[Callable[[], str]]:
        """Within, what tells why the client of a goal is gone: silent for longer than `timeout` [s]. Empty while it is not."""
        number, silence = bytes(goal.goal_id.uuid), _Silence()
        if number.startswith(_MARK):
            with self._lock:
                self._silences[number] = silence
        try:
            yield lambda: f"its client has been silent for {silence.seconds:.1f} s" if silence.seconds > timeout else ""
        finally:
            with self._lock:
                self._silences.pop(number, None)

    def _on_sign(self, msg: UUID) -> None:
        with self._lock:
            if (silence := self._silences.get(bytes(msg.uuid))) is not None:
                silence.seconds = 0.0

    def _count(self) -> None:
        passed = self._running_time.passed()
        with self._lock:
            for silence in self._silences.values():
                silence.seconds += passed


class ServerWatch:
    """Whether the server of an action is there, for one goal.

    Args:
        probe: of its service to cancel, made after it: a server that answers this has discovered the ends of the action, too. One that has
            not would drop its answers.
    """

    def __init__(self, client: ActionClient, probe: Client) -> None:
        self._client, self._probe = client, probe
        self._running_time, self._asked = _RunningTime(), -math.inf
        self._missing = self._silent = 0.0
        self.has_answered = False
        """Whether there was any sign of life."""
        self.after_silence: Callable[[], object] = lambda: None
        """Called in the thread of the answer, when a silent server has answered."""

    def heard(self) -> None:
        """There was a sign of life, such as feedback."""
        self._silent, self.has_answered = 0.0, True

    def _answered(self, answer: Any) -> None:
        self.heard()
        self.after_silence()

    def why_gone(self) -> str:
        """Why the server is gone, as the end of a sentence; empty while it is not. To be called several times a second."""
        now = time.monotonic()
        if passed := self._running_time.passed():
            self._silent += passed
            self._missing = 0.0 if self._client.server_is_ready() else self._missing + passed
        is_due = now - self._asked >= KEEP_ALIVE.question_period
        if is_due and not self._missing and (self._silent > KEEP_ALIVE.question_period or not self.has_answered):
            self._asked = now
            self._probe.call_async(cancellation()).add_done_callback(self._answered)
        if self._missing > KEEP_ALIVE.absence:
            return "has left the ROS graph"
        return f"has not answered for {self._silent:.0f} s" if self._silent > KEEP_ALIVE.silence else ""
