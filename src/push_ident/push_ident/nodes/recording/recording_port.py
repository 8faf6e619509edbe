"""The status of the recorder, which the push executor observes: what was asked to be recorded is recorded, or nothing is pushed."""

from __future__ import annotations

import time
from typing import Final

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.recording.settings import RECORDING

__all__ = ["RECORDING_TOPIC", "REPEATED", "RecordingPort"]

RECORDING_TOPIC: Final = "recording"
"""diagnostic_msgs/DiagnosticStatus, latched: OK or WARN again and again while a bag is written, ERROR with the reason after a failure,
STALE when no recording is requested any more."""
REPEATED: Final = "repeated every [s]"
"""Key of the value in a status that promises the next one."""
_SILENT: Final = "the recorder fell silent: it was stopped or killed; start it again, or restart this node to push without one"


class RecordingPort:
    """Subscription of the push executor to the status of the recorder."""

    def __init__(self, node: Node, callback_group: CallbackGroup) -> None:
        self._node = node
        self._fault = ""
        self._heard = 0.0
        self._is_left = self._is_repeated = False
        node.create_subscription(DiagnosticStatus, RECORDING_TOPIC, self._on_status, LATCHED, callback_group=callback_group)

    @property
    def fault(self) -> str:
        """Why a requested recording is not written; empty while it is, or where none is requested.

        After a recorder has left, no recording is requested. One that fell silent before is still requested until it writes again: it was
        stopped or killed.
        """
        silence = time.monotonic() - self._heard
        if not self._is_left and silence > RECORDING.status_period:
            if self._node.count_publishers(self._node.resolve_topic_name(RECORDING_TOPIC)) == 0:
                self._is_left, self._fault = True, ""
            elif self._is_repeated and silence > RECORDING.n_missed * RECORDING.status_period:
                self._is_left, self._fault = True, _SILENT
        return self._fault

    def _on_status(self, msg: DiagnosticStatus) -> None:
        self._heard, self._is_left = time.monotonic(), False
        # A recorder of another kind may say once that it writes.
        self._is_repeated = any(value.key == REPEATED for value in msg.values)
        self._fault = msg.message if msg.level == DiagnosticStatus.ERROR else ""
