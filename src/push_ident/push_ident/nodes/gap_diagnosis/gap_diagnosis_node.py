"""Node `gap_diagnosis`: reports, on request, where and why the simulation differs from observed pushes."""

from __future__ import annotations

import json
import math
import threading
from collections import deque
from dataclasses import replace
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import InputError
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.unknowns.prior import Prior
from push_ident.nodes.base.cell_node import LATCHED, CellNode, Component, Health
from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.convert.messages import TABLE_FRAME, stamp_to_msg
from push_ident.nodes.gap_diagnosis.diagnosis_process import DiagnosisProcess
from push_ident.nodes.input.push_collector import PushCollector
from push_ident.nodes.input.table import CORNERS, TableInput, table_of_corners
from push_ident.physics.effects import EFFECTS
from push_ident.pushing.push import PushSettings
from push_ident.types import ObjectShape, PushRecord
from push_ident_msgs.action import DiagnoseGap
from push_ident_msgs.msg import GapEffect, GapPart, GapReport

PARAMETERS: Final = (
    Parameter("total_mass", 0.5, "Nominal total mass of an object [kg]", 0.001, 1000.0, read_only=True),
    Parameter("friction", 0.3, "Nominal support friction coefficient [-]", 0.001, 10.0, read_only=True),
    Parameter("pusher_friction", 0.3, "Nominal friction of the pusher [-]; another value is an effect", 0.001, 10.0, read_only=True),
    Parameter("push_gap", 0.5, "Pause of the pusher that ends a push [s]", 0.05, 10.0, read_only=True),
    Parameter("keep", 40, "Latest pushes of each object that are kept for a diagnosis", 3, 1000, read_only=True),
    Parameter("outline_from_camera", True, "Whether poses and outlines come from a camera: its errors then belong to the base model"),
    Parameter("workspace", [-0.20, 0.20, -0.25, 0.25], "x_min, x_max, y_min, y_max of the tool of a proposed push [m]", -10.0, 10.0),
    CORNERS,
)


class GapDiagnosisNode(CellNode):
    """Keeps the latest pushes of every object; action `diagnose_gap` diagnoses them, topic `gap_report` has the latest outcome."""

    n_threads = 3

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("gap_diagnosis_node", PARAMETERS, check=lambda values: table_of_corners(values[CORNERS.name]), **kwargs)

    def make_component(self) -> Component:
        """The pushes that are kept, and the action."""
        return _GapDiagnosis(self)


class _GapDiagnosis(Component):
    def __init__(self, node: CellNode) -> None:
        self._node, self._settings = node, node.settings
        self._records: dict[str, deque[PushRecord]] = {}
        self._shapes: dict[str, ObjectShape] = {}
        self._busy = threading.Lock()
        self._process = DiagnosisProcess()
        self._last = ""
        self._table = TableInput(node)
        self._is_active = False
        self._collector = PushCollector(
            node, self._settings["push_gap"], on_object=lambda object_id: None, on_shape=self._on_shape, on_pushes=self._on_pushes
        )
        self._reports = node.create_publisher(GapReport, "gap_report", LATCHED)
        node.create_action_server(
            DiagnoseGap,
            "diagnose_gap",
            self._execute,
            failed=_failed,
            # One at a time: each takes whole cores.
            accept=lambda request: not self._busy.locked(),
            callback_group=ReentrantCallbackGroup(),
        )

    def resume(self) -> None:
        self._is_active = True

    def pause(self) -> None:
        self._is_active = False
        self._collector.pause()
        if self._busy.acquire(blocking=False):
            self._process.stop()
            self._busy.release()

    def close(self) -> None:
        self._process.stop()

    # ---- input

    def _on_shape(self, object_id: str, shape: ObjectShape) -> None:
        known = self._shapes.get(object_id)
        if known is not None and not known.is_same_object(shape):
            self._node.get_logger().warning(f"object {object_id} has another shape now: its earlier pushes are dropped")
            self._records.pop(object_id, None)
        self._shapes[object_id] = shape
        # A better outline holds for the pushes before it, too.
        if records := self._records.get(object_id):
            self._records[object_id] = deque((replace(record, shape=shape) for record in records), maxlen=records.maxlen)

    def _on_pushes(self, pushes: list[list[PushRecord]]) -> None:
        for push in pushes:
            for record in push:
                if self._table.beyond(record) > 0.0:
                    why = f"{record.object_id} overhung the edge of the table; the push is left out."
                    self._collector.refuse("pushes", "gap_diagnosis", why)
                elif observe_push(record).touched:
                    records = self._records.setdefault(record.object_id, deque(maxlen=self._settings["keep"]))
                    order = records[-1].order + 1 if records else 0
                    records.append(replace(record, order=order))
                    self._collector.counts["pushes"] += 1
                else:
                    self._collector.counts["pushes without contact"] += 1

    # ---- the action

    def _execute(self, goal: ServerGoalHandle) -> DiagnoseGap.Result:
        if not self._busy.acquire(blocking=False):
            raise InputError("A diagnosis is running; wait for it or cancel it.")
        try:
            return self._diagnose(goal)
        finally:
            self._busy.release()

    def _diagnose(self, goal: ServerGoalHandle) -> DiagnoseGap.Result:
        object_id, records = self._chosen(goal.request)
        content = self._process.diagnose(
            records,
            self._diagnosis_settings(goal.request),
            self._push_settings(records),
            on_stage=lambda stage: goal.publish_feedback(DiagnoseGap.Feedback(stage=stage)),
            should_continue=lambda: not goal.is_cancel_requested and self._is_active,
        )
        if content is None:
            if not goal.is_cancel_requested:
                raise InputError("The node was deactivated; the diagnosis is ended.")
            goal.canceled()
            return _failed("Canceled.")
        report = report_to_msg(content, object_id, float(records[-1].poses.time[-1]), len(records))
        self._last = f"{object_id}: {content['verdict']}"
        self._reports.publish(report)
        self._node.get_logger().info(f"object {object_id}, {len(records)} pushes: {content['verdict']}. {content['sentence']}")
        goal.succeed()
        return DiagnoseGap.Result(success=True, message=content["verdict"], report=report)

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

    def health(self) -> Health:
        pushes = {object_id: len(records) for object_id, records in list(self._records.items())}
        missing = self._collector.what_is_missing()
        level = DiagnosticStatus.WARN if missing else DiagnosticStatus.OK
        text = missing or (f"pushes kept by object: {pushes}" if pushes else "waiting for a push")
        return Health(level, text, {**self._collector.report(), "diagnosing": self._busy.locked(), "last diagnosis": self._last or "none"})


def _failed(why: str) -> DiagnoseGap.Result:
    return DiagnoseGap.Result(success=False, message=why)


def report_to_msg(content: dict[str, Any], object_id: str, stamp: float, n_pushes: int) -> GapReport:
    """A diagnosis as a message.

    Args:
        content: JSON of the command-line contract, see `push_ident.diagnosis.diagnosis_json.to_json`.
        stamp: of its newest push [s].
        n_pushes: that were diagnosed.
    """
    gap, account, proposal = content["gap"], content["account"], content["next_push"]
    low, high = (_number(value) for value in gap["shrink_interval"])
    msg = GapReport(
        header=Header(stamp=stamp_to_msg(stamp), frame_id=TABLE_FRAME),
        object_id=object_id,
        n_pushes=int(n_pushes),
        verdict=content["verdict"],
        sentence=content["sentence"],
        confusable=list(content["confusable"]),
        before=_number(gap["before_m"]),
        after=_number(gap["after_m"]),
        noise=_number(gap["noise_m"]),
        shrink=_number(gap["shrink"]),
        shrink_low=low,
        shrink_high=high,
        more_pushes=-1 if account["more_pushes"] is None else int(account["more_pushes"]),
        ranking=[row["name"] for row in content["ranking"]],
        ranking_evidence=[_number(row["evidence"]) for row in content["ranking"]],
        ranking_smallest=[_number(row["smallest"]) for row in content["ranking"]],
        check=content["check"],
        json=json.dumps(content),
    )
    msg.effects = [_effect_to_msg(effect) for effect in content["effects"]]
    # Parts by push are there where there are parts.
    msg.account = _account_to_msg(account) if account["per_push_m"] else []
    if proposal is not None:
        msg.has_next_push, msg.contact_point = True, _point(proposal)
        msg.direction, msg.distance = float(proposal["direction_rad"]), float(proposal["distance_m"])
        msg.speed = float(proposal["speed_mps"])
    return msg


def _account_to_msg(account: dict[str, Any]) -> list[GapPart]:
    """The parts in the order in which they are added up."""
    fixed = [(key.removesuffix("_m"), account[key], account["intervals"][key]) for key in ("noise_m", "maps_m", "model_m", "unexplained_m")]
    effects = [(name, value, account["intervals"]["effects"][name]) for name, value in account["effects"].items()]
    return [
        GapPart(name=name, mean=_number(mean), low=_number(low), high=_number(high))
        for name, mean, (low, high) in (*fixed[:-1], *effects, fixed[-1])
    ]


def _effect_to_msg(effect: dict[str, Any]) -> GapEffect:
    names = list(effect["parameters"])
    return GapEffect(
        name=effect["name"],
        parameters=names,
        values=[_number(effect["parameters"][name]) for name in names],
        std=[_number(effect["std"][name]) for name in names],
        evidence=_number(effect["evidence"]),
    )


def _point(push: dict[str, Any]) -> Point:
    x, y = push["contact_point_m"]
    return Point(x=float(x), y=float(y), z=0.0)


def _number(value: float | None) -> float:
    """JSON has null where a number is not finite."""
    return math.nan if value is None else float(value)
