"""What perception refused, as markers and back."""

from __future__ import annotations

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from visualization_msgs.msg import Marker, MarkerArray

from push_ident.errors import InputError
from push_ident.nodes.convert.refusals import refusals_from_msg, refusals_to_msg
from push_ident.perception.refusals import Reason, Refusal, summary_of

OUTLINE = np.array([[0.1, 0.1], [0.2, 0.1], [0.2, 0.2]])
REFUSALS = [Refusal(Reason.BESIDE_ROBOT, Reason.BESIDE_ROBOT.value, OUTLINE, 0.05), Refusal(Reason.TOO_SMALL, "small", OUTLINE + 0.2, 0.02)]


def test_outlines_and_reasons_come_back():
    found = refusals_from_msg(refusals_to_msg(REFUSALS, Time(sec=3)))
    assert [words for _, words in found] == [refusal.why for refusal in REFUSALS]
    for (outline, _), refusal in zip(found, REFUSALS, strict=True):
        np.testing.assert_allclose(outline, np.column_stack([[*refusal.outline, refusal.outline[0]], np.full(4, refusal.height)]))
    assert refusals_from_msg(refusals_to_msg([], Time())) == []


def test_markers_of_another_frame_or_size_are_refused():
    msg = refusals_to_msg(REFUSALS, Time())
    msg.markers[1].header.frame_id = "map"
    with pytest.raises(InputError, match="frame map, expected table"):
        refusals_from_msg(msg)
    msg = refusals_to_msg(REFUSALS, Time())
    msg.markers[1].points[0].x = float("nan")
    with pytest.raises(InputError, match="Outline of a refusal"):
        refusals_from_msg(msg)
    many = Marker(action=Marker.ADD, type=Marker.LINE_STRIP, points=[Point()] * 10_001)
    with pytest.raises(InputError, match="Refusals"):
        refusals_from_msg(MarkerArray(markers=[many]))


def test_the_summary_counts_equal_reasons():
    assert summary_of([*REFUSALS, REFUSALS[1]]).startswith("2 segments: small; 1 segment: touches the robot")
