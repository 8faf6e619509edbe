"""A diagnosis as a message: the parts of its account add up, and abstention has none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message

from helpers.diagnosis import account_of_parts, gap_of
from push_ident.diagnosis.diagnosis_json import to_json
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.verdict import Verdict
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.nodes.gap_diagnosis.gap_diagnosis_node import report_to_msg
from push_ident.pushing.push import PushPlan2D
from push_ident.types import PusherPath
from push_ident_msgs.msg import GapReport


def as_received(diagnosis: Diagnosis) -> GapReport:
    return deserialize_message(serialize_message(report_to_msg(to_json(diagnosis), "o1", 1.5, 4)), GapReport)


def test_account_arrives_with_parts_that_add_up_and_the_push_to_make_first() -> None:
    gap = gap_of([5e-3, 4e-3, 6e-3, 5e-3], [2e-3, 1.5e-3, 2.5e-3, 2e-3], 1e-3, names=("table_tilt",))
    account = account_of_parts(gap, 1e-3, 6e-4, 1e-4, more_pushes=3)
    plan = PushPlan2D(np.array([0.05, -0.02]), np.array([0.05, -0.035]), 1.5, 0.08, 0.12)
    push = PlannedPush(np.zeros(3), PusherPath(np.array([0.0, 1.0]), np.zeros((2, 2)), 0.015), plan)
    msg = as_received(Diagnosis(Verdict.NAMED, "", (), gap=gap, account=account, next_push=push))
    assert [part.name for part in msg.account] == ["noise", "maps", "model", "table_tilt", "unexplained"]
    assert sum(part.mean for part in msg.account) == pytest.approx(msg.before) == pytest.approx(5e-3)
    tilt = msg.account[3]
    assert 0.0 < tilt.low < tilt.mean < tilt.high and tilt.mean == pytest.approx(3e-3)
    assert msg.more_pushes == 3 and msg.has_next_push
    assert (msg.contact_point.x, msg.contact_point.y) == (0.05, -0.02)
    assert (msg.direction, msg.distance, msg.speed) == (1.5, 0.08, 0.12)


def test_unknown_number_of_pushes_and_abstention_are_no_numbers() -> None:
    gap = gap_of([2e-3] * 4, [2e-3] * 4, 1e-3)
    assert as_received(Diagnosis(Verdict.NO_GAP, "", (), gap=gap, account=account_of_parts(gap, 1e-3, 1e-3, 0.0, None))).more_pushes == -1
    abstained = as_received(Diagnosis(Verdict.NOT_TRUSTWORTHY, "", ()))
    assert list(abstained.account) == [] and abstained.more_pushes == -1 and not abstained.has_next_push and math.isnan(abstained.before)
