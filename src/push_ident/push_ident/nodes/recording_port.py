"""The status of the recorder, which the push executor observes."""

from __future__ import annotations

from typing import Final

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

__all__ = ["RECORDING_QOS", "RECORDING_TOPIC", "RecordingPort"]

RECORDING_TOPIC: Final = "recording"
"""diagnostic_msgs/DiagnosticStatus, latched: OK while a bag is written, ERROR with the reason after a failure."""
RECORDING_QOS: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class RecordingPort:
    """Subscription of the push executor to the status of the recorder."""

    def __init__(self, node: Node, callback_group: CallbackGroup) -> None:
        self._node = node
        self._fault = ""
        node.create_subscription(DiagnosticStatus, RECORDING_TOPIC, self._on_status, RECORDING_QOS, callback_group=callback_group)

    @property
    def fault(self) -> str:
        """Why the recorder cannot write; empty while it can, or while none runs."""
        if self._fault and self._node.count_publishers(self._node.resolve_topic_name(RECORDING_TOPIC)) == 0:
            self._fault = ""
        return self._fault

    def _on_status(self, msg: DiagnosticStatus) -> None:
        self._fault = msg.message if msg.level == DiagnosticStatus.ERROR else ""
