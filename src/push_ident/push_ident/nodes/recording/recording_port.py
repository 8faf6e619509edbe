"""The status of the recorder, which the push executor observes: what was asked to be recorded is recorded, or nothing is pushed."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from push_ident.nodes.base.cell_node import LATCHED


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """What recorder and player of bags decide on that is no parameter. Times are wall time unless stated otherwise."""

    status_period: float = 0.5
    """Between two statuses of a recorder that writes [s]."""
    n_missed: int = 4
    """Statuses that do not come until a recorder counts as stopped."""
    n_messages: int = 1000
    """Messages of a topic that may wait for the disk: 1 s at 1 kHz."""
    n_images: int = 60
    """Depth images that may wait for the disk: 2 s at 30 Hz, 37 MB at 640 x 480."""
    clock_period_ns: int = 10_000_000
    """Between two messages on /clock of a bag that is played [ns], recorded time."""
    longest_pause_ns: int = 3600 * 10**9
    """A longer recorded time without any message is not waited for [ns]: a clock was set in the middle of it, or a stamp is wrong."""
    n_ahead: int = 2
    """Depth images under way to the node that processes them."""
    image_timeout: float = 120.0
    """Longest time for one image [s]; the first one compiles, on a loaded machine for half a minute."""
    delivery_timeout: float = 120.0
    """Longest wait for listeners to take the last messages [s]."""


RECORDING: Final = RecordingSettings()
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
