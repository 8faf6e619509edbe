"""An observer of the cell that knows what must never happen."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from push_ident.identification.online.state_file import load_state
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident_msgs.msg import MassFrictionMap, PushRecord
from push_ident_sim.studies.common.base import Json

__all__ = ["Witness", "tracebacks"]

_LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_ALL: Final = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_AVAILABLE)
_MOVES: Final = 0.02
"""A joint that is faster than this moves [rad/s]."""
_LOOK: Final = 0.05
"""Period at which the observer checks whether it should end [s]."""
_BACK: Final = 0.5
"""Stamps this much older mean that the simulated cell began anew [s]."""
_SLACK: Final = 0.05
"""Between the start of a push in its record and its first frame [s]."""
_TRACEBACK: Final = "Traceback (most recent call last)"


class Witness:
    """Listens in a thread of its own, on a context of its own; a context manager."""

    def __init__(self, domain: int, object_id: str) -> None:
        self._context = Context()
        self._context.init(domain_id=domain)
        self.node = Node("endurance_witness", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._ended = threading.Event()
        self._commanded = self._stamp = -np.inf
        self.longest_unasked = 0.0
        """Longest motion of the arm after the last command, in simulated time [s]."""
        self.n_states = self.n_commands = self.n_maps = self.sim_starts = 0
        self.bad_maps: list[str] = []
        """Maps with a negative mass or a number that is not finite."""
        self.refused: dict[str, int] = {}
        """By node: largest number of refusals that it reported."""
        self.whole: list[tuple[float, float]] = []
        """Start and end of each push that ended well [s]."""
        self.failed: dict[int, int] = {}
        """Number of pushes by error code."""
        for kind, topic, take, qos in (
            (JointState, "joint_states", self._on_state, _ALL),
            (JointTrajectory, "joint_trajectory", self._on_command, _ALL),
            (PushRecord, "push_record", self._on_record, _ALL),
            (MassFrictionMap, f"objects/{object_id}/mass_friction_map", self._on_map, _LATCHED),
            (DiagnosticArray, "/diagnostics", self._on_diagnostics, _ALL),
        ):
            self.node.create_subscription(kind, topic, take, qos)
        self._thread = threading.Thread(target=self._spin, name="witness", daemon=True)

    def __enter__(self) -> Witness:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join(timeout=2.0)
        self._executor.shutdown(timeout_sec=0.5)
        self.node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        while not self._ended.is_set():
            self._executor.spin_once(timeout_sec=_LOOK)

    def _on_state(self, msg: JointState) -> None:
        stamp = stamp_from_msg(msg.header.stamp)
        if stamp < self._stamp - _BACK:
            self.sim_starts += 1
            self._commanded = stamp
        self._stamp = stamp
        self.n_states += 1
        if max((abs(v) for v in msg.velocity), default=0.0) > _MOVES and np.isfinite(self._commanded):
            self.longest_unasked = max(self.longest_unasked, stamp - self._commanded)

    def _on_command(self, msg: JointTrajectory) -> None:
        self.n_commands += 1
        self._commanded = self._stamp

    def _on_record(self, msg: PushRecord) -> None:
        code = int(msg.error_code)
        self.failed[code] = self.failed.get(code, 0) + 1
        if code == 0:
            self.whole.append((stamp_from_msg(msg.start), stamp_from_msg(msg.end)))

    def _on_map(self, msg: MassFrictionMap) -> None:
        self.n_maps += 1
        values = [np.asarray(getattr(msg, name)) for name in ("mass", "friction", "mass_friction", "mass_friction_std")]
        if any(not np.all(np.isfinite(v)) or np.any(v < 0) for v in values):
            self.bad_maps.append(f"{msg.n_pushes} pushes, stamp {stamp_from_msg(msg.header.stamp):.2f} s")

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            counts: dict[str, Any] = {value.key: value.value for value in status.values}
            if str(counts.get("refused", "")).isdigit():
                self.refused[status.name] = max(self.refused.get(status.name, 0), int(counts["refused"]))

    def learned_unfinished(self, state: Path) -> list[float]:
        """Starts [s] of the pushes in a state of identification that no record of a whole push covers."""
        return [
            time for time, _, _ in load_state(state).pushes if not any(start - _SLACK <= time <= end + _SLACK for start, end in self.whole)
        ]

    def account(self) -> Json:
        """What it has seen."""
        return {
            "n_commands": self.n_commands,
            "n_maps": self.n_maps,
            "sim_restarts": self.sim_starts,
            "longest_unasked_s": self.longest_unasked,
            "bad_maps": self.bad_maps,
            "refused": self.refused,
            "records_by_code": {str(code): n for code, n in sorted(self.failed.items())},
        }


def tracebacks(folder: Path) -> list[str]:
    """Names of the logs that hold a traceback."""
    return [path.name for path in sorted(folder.glob("*.log")) if _TRACEBACK in path.read_text(encoding="utf-8", errors="replace")]
