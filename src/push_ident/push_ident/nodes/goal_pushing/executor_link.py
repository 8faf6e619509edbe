"""The executor of pushes as goal_pushing_node sees it: a client of `execute_push` that never blocks."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from rclpy.action import ActionClient
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from unique_identifier_msgs.msg import UUID

from push_ident.limits import LIMITS, plain_text
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.group_calls import GroupCalls
from push_ident.nodes.base.keep_alive import KeepAlive, ServerWatch
from push_ident.nodes.convert.messages import push_interval_from_msg, stamp_from_msg
from push_ident.nodes.goal_pushing.parameters import GOAL_PUSHING
from push_ident.planning.goal_ports import PushReport
from push_ident.pushing.push import PushCode
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushRecord

K = TypeVar("K")


class ExecutorLink:
    """Sends pushes to the executor. Requests are made in the callback group of the client."""

    def __init__(self, node: CellNode) -> None:
        self._node = node
        self._group = MutuallyExclusiveCallbackGroup()
        self._client = ActionClient(node, ExecutePush, "execute_push", callback_group=self._group)
        self.keep_alive = KeepAlive(node, "execute_push", callback_group=self._group)
        self._probe = node.create_client(CancelGoal, "execute_push/_action/cancel_goal", callback_group=self._group)
        self._calls = GroupCalls(node, "execute_push", self._group)
        self._starts: dict[int, float] = {}
        self._latest: dict[str, float] = {}
        node.create_subscription(PushRecord, "push_record", self._on_record, 10)

    @property
    def is_served(self) -> bool:
        """Whether an executor is in the ROS graph."""
        return bool(self._client.server_is_ready())

    def close(self) -> None:
        """Withdraw the client; the node withdraws the rest."""
        self._calls.close()
        self._client.destroy()

    def begin(self, goal: ExecutePush.Goal, timeout: float) -> RequestedPush:
        """Ask for a push; `timeout` is the longest silence of the executor [s]."""
        return RequestedPush(self, goal, timeout)

    def ask(self, question: Callable[[], object]) -> None:
        """Call `question` in the callback group of the client."""
        self._calls.ask(question)

    def watch(self) -> ServerWatch:
        """Whether the executor is there, for one push."""
        return ServerWatch(self._client, self._probe)

    def send(self, goal: ExecutePush.Goal, number: UUID, on_feedback: Callable[[Any], None]) -> Any:
        """Future of the answer to a goal. To be called by `ask`."""
        return self._client.send_goal_async(goal, feedback_callback=on_feedback, goal_uuid=number)

    def start_of(self, push_id: int) -> float:
        """When a push began [s], clock of the poses; -inf where its record has not come."""
        return self._starts.get(push_id, -np.inf)

    def pushed_at(self, object_id: str) -> float:
        """When the latest push of an object that succeeded began [s], whichever client requested it, clock of the poses; -inf: none."""
        return self._latest.get(object_id, -np.inf)

    def watched(self, work: Callable[[Any], None]) -> Callable[[Any], None]:
        """`work` such that an exception in it is a refusal."""

        def guarded(value: Any) -> None:
            with self._node.guard.watch("execute_push"):
                work(value)

        return guarded

    def _on_record(self, msg: PushRecord) -> None:
        interval = push_interval_from_msg(msg)
        _remember(self._starts, interval.push_id, interval.start, GOAL_PUSHING.n_records)
        if interval.error_code == 0 and interval.object_id:
            _remember(self._latest, interval.object_id, interval.start, LIMITS.OBJECTS.value)


def _remember(kept: dict[K, float], key: K, value: float, largest: int) -> None:
    """Keep the latest `largest` values; a key may come again, as after a restart of the executor."""
    kept.pop(key, None)
    kept[key] = value
    while len(kept) > largest:
        del kept[next(iter(kept))]


class RequestedPush:
    """`planning.goal_ports.PushUnderWay` at the executor.

    A server that has not discovered the client yet drops its answers, and a goal must not be sent twice. So the goal is sent after the
    executor has answered a question that changes nothing.
    """

    def __init__(self, link: ExecutorLink, goal: ExecutePush.Goal, timeout: float) -> None:
        self._link, self._goal, self._timeout = link, goal, timeout
        self._executor, self._number = link.watch(), link.keep_alive.begin()
        self._lock = threading.Lock()
        self._report: PushReport | None = None
        self.begun = (0, 0.0)
        """Number of the push, and when its tool departs [s], clock of the poses; 0: not known yet."""
        self._push_id = 0
        self._handle: Any = None
        self._is_canceled = self._is_cancel_sent = self._is_sent = False
        self._began = self._heard = time.monotonic()

    @property
    def has_ended(self) -> bool:
        """Whether there is a report; any thread may ask."""
        return self._report is not None

    def report(self) -> PushReport | None:
        """As `PushUnderWay`."""
        if self._report is None:
            self._look(time.monotonic())
        report = self._report
        if report is None or not self._push_id:
            return report
        # The record of the push may come after the result.
        return PushReport(report.code, report.text, report.n_made, self._link.start_of(self._push_id))

    def cancel(self) -> None:
        """As `PushUnderWay`."""
        with self._lock:
            self._is_canceled = True
            if not self._is_sent and self._report is None:
                self._report = PushReport(PushCode.CANCELED, "canceled before it was sent.")
        self._link.keep_alive.end(self._number)
        # From this thread: the arm must hold also where the node is about to end and no callback is called any more.
        self._link.watched(lambda _: self._send_cancel())(None)

    # ---- called by the session

    def _look(self, now: float) -> None:
        why = self._executor.why_gone()
        if not self._is_sent:
            if self._executor.has_answered:
                self._link.ask(self._send)
            elif now - self._began > GOAL_PUSHING.executor_discovery:
                self._give_up(f"the action execute_push did not answer within {GOAL_PUSHING.executor_discovery:g} s.")
        elif why:
            self._give_up(f"the executor {why}.")
        elif now - self._heard > (GOAL_PUSHING.executor_answer if self._handle is None else self._timeout):
            self._give_up(f"the executor has been silent for {now - self._heard:.0f} s.")

    def _give_up(self, why: str) -> None:
        self._report = PushReport(PushCode.ARM_SILENT, why)
        self.cancel()

    # ---- called in the callback group of the client

    def _send(self) -> None:
        with self._lock:
            if self._is_sent or self._is_canceled:
                return
            self._is_sent, self._heard = True, time.monotonic()
        self._link.send(self._goal, self._number, self._link.watched(self._on_feedback)).add_done_callback(
            self._link.watched(self._on_answer)
        )

    def _on_answer(self, future: Any) -> None:
        handle = future.result()
        self._heard = time.monotonic()
        if not handle.accepted:
            self._end(PushReport(PushCode.BUSY, "the executor refused the push."))
            return
        self._handle, self._executor.after_silence = handle, self._ask_result
        self._ask_result()
        if self._is_canceled:
            self._send_cancel()

    def _ask_result(self) -> None:
        self._handle.get_result_async().add_done_callback(self._link.watched(self._on_result))

    def _on_feedback(self, message: Any) -> None:
        self._heard = time.monotonic()
        self._executor.heard()
        self.begun = int(message.feedback.push_id), stamp_from_msg(message.feedback.start)

    def _on_result(self, future: Any) -> None:
        if future.result().status == GoalStatus.STATUS_UNKNOWN:
            self._end(PushReport(PushCode.ARM_SILENT, "the executor was started again during the push."))
            return
        result = future.result().result
        self._push_id = int(result.push_id) or int(result.recentre_push_id)
        n_made = (result.push_id != 0) + (result.recentre_push_id != 0)
        try:
            code = PushCode(int(result.error_code))
        except ValueError:
            # An executor of another version: an unknown code still counts as a failure.
            code = PushCode.TRACKING
        self._end(PushReport(code, plain_text(result.error_text), n_made))

    def _end(self, report: PushReport) -> None:
        self._link.keep_alive.end(self._number)
        if self._report is None:
            self._report = report

    def _send_cancel(self) -> None:
        with self._lock:
            if self._handle is None or self._is_cancel_sent:
                return
            self._is_cancel_sent = True
        self._handle.cancel_goal_async()
