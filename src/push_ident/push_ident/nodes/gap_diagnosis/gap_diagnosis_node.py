"""Node `gap_diagnosis`: reports, on request, where and why the simulation differs from observed pushes."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import replace
from typing import Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import InputError, PushIdentError
from push_ident.identification.observation import observe_push
from push_ident.identification.prior import Prior
from push_ident.nodes.gap_diagnosis.convert_diagnosis import report_to_msg
from push_ident.nodes.gap_diagnosis.diagnosis_process import DiagnosisProcess
from push_ident.nodes.parameters import Parameter, Parameters
from push_ident.nodes.push_collector import PushCollector
from push_ident.nodes.run import run_node
from push_ident.physics.effects import EFFECTS
from push_ident.pushing.push import PushSettings
from push_ident.types import ObjectShape, PushRecord
from push_ident_msgs.action import DiagnoseGap
from push_ident_msgs.msg import GapReport

__all__ = ["PARAMETERS", "GapDiagnosisNode", "main"]

_LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

PARAMETERS: Final = (
    Parameter("total_mass", 0.5, "Nominal total mass of an object [kg]", 0.001, 1000.0, read_only=True),
    Parameter("friction", 0.3, "Nominal support friction coefficient [-]", 0.001, 10.0, read_only=True),
    Parameter("pusher_friction", 0.3, "Nominal friction of the pusher [-]; another value is an effect", 0.001, 10.0, read_only=True),
    Parameter("push_gap", 0.5, "Pause of the pusher that ends a push [s]", 0.05, 10.0, read_only=True),
    Parameter("keep", 40, "Latest pushes of each object that are kept for a diagnosis", 3, 1000, read_only=True),
    Parameter("outline_from_camera", True, "Whether poses and outlines come from a camera: its errors then belong to the base model"),
    Parameter("workspace", [-0.20, 0.20, -0.25, 0.25], "x_min, x_max, y_min, y_max of the tool of a proposed push [m]", -10.0, 10.0),
)


class GapDiagnosisNode(Node):
    """Keeps the latest pushes of every object; action `diagnose_gap` diagnoses them, topic `gap_report` has the latest outcome."""

    def __init__(self) -> None:
        super().__init__("gap_diagnosis_node")
        self._settings = Parameters(self, PARAMETERS)
        self._records: dict[str, deque[PushRecord]] = {}
        self._shapes: dict[str, ObjectShape] = {}
        self._busy = threading.Lock()
        self._last = ""
        self._collector = PushCollector(
            self,
            self._settings["push_gap"],
            on_object=lambda object_id: None,
            on_shape=self._on_shape,
            on_pushes=self._on_pushes,
        )
        self._collector.active = True
        self._reports = self.create_publisher(GapReport, "gap_report", _LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._action = ActionServer(
            self,
            DiagnoseGap,
            "diagnose_gap",
            execute_callback=self._execute,
            goal_callback=self._on_goal,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )
        self.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._closing = False

    def close(self) -> None:
        """End the node, and a diagnosis that is running."""
        self._closing = True
        self._collector.close()
        self._action.destroy()

    # ---- input

    def _on_shape(self, object_id: str, shape: ObjectShape) -> None:
        known = self._shapes.get(object_id)
        if known is not None and not known.is_same_object(shape):
            self.get_logger().warning(f"object {object_id} has another shape now: its earlier pushes are dropped")
            self._records.pop(object_id, None)
        self._shapes[object_id] = shape

    def _on_pushes(self, pushes: list[list[PushRecord]]) -> None:
        for push in pushes:
            for record in push:
                if observe_push(record).touched:
                    kept = self._records.setdefault(record.object_id, deque(maxlen=self._settings["keep"]))
                    order = kept[-1].order + 1 if kept else 0
                    kept.append(replace(record, order=order))
                    self._collector.counts["pushes"] += 1
                else:
                    self._collector.counts["pushes without contact"] += 1

    # ---- the action

    def _on_goal(self, goal: DiagnoseGap.Goal) -> GoalResponse:
        # One at a time: each takes whole cores.
        return GoalResponse.REJECT if self._busy.locked() else GoalResponse.ACCEPT

    def _execute(self, goal: ServerGoalHandle) -> DiagnoseGap.Result:
        result = DiagnoseGap.Result()
        if not self._busy.acquire(blocking=False):
            goal.abort()
            result.message = "A diagnosis is running; wait for it or cancel it."
            return result
        try:
            object_id, records = self._chosen(goal.request)
            process = DiagnosisProcess(records, self._diagnosis_settings(goal.request), self._push_settings(records))

            def publish_stage(stage: str) -> None:
                goal.publish_feedback(DiagnoseGap.Feedback(stage=stage))

            content = process.wait(publish_stage, lambda: not goal.is_cancel_requested and not self._closing)
            if content is None:
                goal.canceled()
                result.message = "Canceled."
                return result
            result.report = report_to_msg(content, object_id, float(records[-1].poses.time[-1]), len(records))
            self._last = f"{object_id}: {content['verdict']}"
            self._reports.publish(result.report)
            self.get_logger().info(f"object {object_id}, {len(records)} pushes: {content['verdict']}. {content['sentence']}")
            result.success, result.message = True, content["verdict"]
            goal.succeed()
        except PushIdentError as error:
            self._collector.refuse("diagnoses", str(error))
            result.message = str(error)
            goal.abort()
        finally:
            self._busy.release()
        return result

    def _chosen(self, request: DiagnoseGap.Goal) -> tuple[str, list[PushRecord]]:
        known = sorted(self._records)
        object_id = request.object_id or (known[0] if len(known) == 1 else "")
        if object_id not in self._records:
            names = ", ".join(known) or "none yet"
            raise InputError(f"There are no pushes of object `{request.object_id}`; there are some of: {names}. Push it first.")
        records = list(self._records[object_id])
        return object_id, records[-int(request.last) :] if request.last else records

    def _diagnosis_settings(self, request: DiagnoseGap.Goal) -> DiagnosisSettings:
        if unknown := [name for name in request.base_effects if name not in EFFECTS]:
            raise InputError(f"There is no effect `{unknown[0]}`; choose from {', '.join(EFFECTS)}.")
        values = self._settings
        prior = Prior(total_mass=values["total_mass"], friction=values["friction"], pusher_friction=values["pusher_friction"])
        return DiagnosisSettings(prior=prior, base_effects=tuple(request.base_effects), outline_from_camera=values["outline_from_camera"])

    def _push_settings(self, records: list[PushRecord]) -> PushSettings:
        x_min, x_max, y_min, y_max = self._settings["workspace"]
        return PushSettings(pusher_radius=records[-1].pusher.radius, workspace=(x_min, x_max, y_min, y_max))

    # ---- health

    def _report(self) -> None:
        pushes = {object_id: len(records) for object_id, records in list(self._records.items())}
        missing = self._collector.what_is_missing()
        level = DiagnosticStatus.WARN if missing else DiagnosticStatus.OK
        text = missing or (f"pushes kept by object: {pushes}" if pushes else "waiting for a push")
        status = DiagnosticStatus(level=level, name=self.get_fully_qualified_name(), message=text, hardware_id="push_ident")
        values = {**self._collector.report(), "diagnosing": self._busy.locked(), "last diagnosis": self._last or "none"}
        status.values = [KeyValue(key=str(k), value=str(v)) for k, v in values.items()]
        msg = DiagnosticArray(status=[status])
        msg.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(msg)


def main() -> int:
    """Run the node until a signal ends it; the exit code."""
    return run_node(GapDiagnosisNode, n_threads=3)
