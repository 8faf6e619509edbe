"""Which pushes identification_node takes from the topics of a cell."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.context import Context
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Header

from helpers.executor_cell import ask, wait_for
from helpers.objects import random_records, square, uniform
from helpers.spinning import running, spinning
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import planar_pose_to_msg, position_to_msg, pusher_shape_to_msg, shape_to_msgs, stamp_to_msg
from push_ident.nodes.convert.table import EDGE_TOPIC, edge_to_msg
from push_ident.nodes.identification.identification_node import IdentificationNode
from push_ident.physics.overhang import TableEdge
from push_ident.types import PushRecord
from push_ident_msgs.msg import MassFrictionMap
from push_ident_msgs.msg import PushRecord as PushRecordMsg
from push_ident_msgs.srv import PredictPush

pytestmark = pytest.mark.live

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PATIENCE = 14.0
"""Longer than a record is waited for, by the stamps [s]."""


@cache
def pushes() -> list[PushRecord]:
    return random_records(uniform(square(5, 0.02)), 3, 3)


class Cell(Node):
    """Plays pushes of one object after the other, each at a time of its own."""

    def __init__(self, context: Context) -> None:
        super().__init__("cell", context=context)
        self.create_publisher(SolidPrimitive, "pusher/shape", LATCHED).publish(pusher_shape_to_msg(pushes()[0].pusher.shape, 0.08))
        self.pusher = self.create_publisher(PoseStamped, "pusher/pose", 100)
        self.values: dict[str, str] = {}
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._time = 10.0
        self.states_covariance = True

    def begin(self, object_id: str) -> None:
        """Go on with another object of the same shape; counts are from now on."""
        self.object_id, self._before = object_id, dict(self.values)
        for name, msg in zip(("cells", "outline"), shape_to_msgs(pushes()[0].shape, object_id, stamp_to_msg(1.0)), strict=True):
            self.create_publisher(type(msg), f"objects/{object_id}/{name}", LATCHED).publish(msg)
        self.poses = self.create_publisher(PoseWithCovarianceStamped, f"objects/{object_id}/pose", 100)
        self.n_pushes: list[int] = []
        on_map = self.n_pushes.append
        self.create_subscription(MassFrictionMap, f"objects/{object_id}/mass_friction_map", lambda m: on_map(int(m.n_pushes)), LATCHED)
        wait_for(lambda: self.poses.get_subscription_count() and self.pusher.get_subscription_count() and self.values, 60.0)

    def count(self, name: str) -> int:
        """Of the status, since the object of now."""
        return int(self.values.get(name, 0)) - int(self._before.get(name, 0))

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if "identification" in status.name:
                self.values = {value.key: value.value for value in status.values}

    def play(self, push: PushRecord, records: Publisher | None = None) -> None:
        """A push, ten times as fast, and the object at rest after it; its record, if it gets one."""
        start = self._time = self._time + 30.0
        shift, rest = start - push.poses.time[0], push.poses.time[-1] + np.arange(0.05, PATIENCE, 0.05)
        poses = zip([*push.poses.time, *rest], [*push.poses.pose, *[push.poses.pose[-1]] * len(rest)], strict=True)
        covariance = push.poses.covariance[0] * self.states_covariance
        messages = [(t, self.poses, planar_pose_to_msg(stamp_to_msg(t + shift), pose, covariance)) for t, pose in poses]
        tool = zip(push.pusher.time, push.pusher.position, strict=True)
        messages += [(t, self.pusher, position_to_msg(stamp_to_msg(t + shift), [*xy, 0.01])) for t, xy in tool]
        if records is not None:
            first, last = push.pusher.time[[0, -1]] + shift
            record = PushRecordMsg(push_id=1, object_id=self.object_id, start=stamp_to_msg(first), end=stamp_to_msg(last))
            record.stop, record.header.stamp, record.header.frame_id = record.end, record.end, "table"
            messages.append((last - shift + 0.3, records, record))
        before = start - shift
        for t, publisher, msg in sorted(messages, key=lambda message: message[0]):
            time.sleep(max(t - before, 0.0) / 10)
            before = t
            publisher.publish(msg)


@pytest.fixture(scope="module")
def cell() -> Iterator[Cell]:
    domain = own_domain()
    with spinning(Cell, domain) as cell, running(IdentificationNode, domain, "suggest_candidates:=0"):
        yield cell


def displaced(push: PushRecord, frames: slice) -> PushRecord:
    pose = push.poses.pose.copy()
    pose[frames] += [0.2, 0.15, 0.0]
    return replace(push, poses=replace(push.poses, pose=pose))


def test_push_whose_pose_jumps_is_left_out_and_said_and_an_excursion_is_not_learned(cell: Cell) -> None:
    cell.begin("o1")
    middle = len(pushes()[0].poses.time) // 2
    cell.play(displaced(pushes()[0], slice(middle, None)))
    wait_for(lambda: cell.count("pushes with impossible poses, left out") == 1, 60.0)
    assert "no push can have made its poses: its pose moves by 25" in cell.values["last error"]
    # What was estimated before the jump is given up, too.
    wait_for(lambda: cell.n_pushes and cell.n_pushes[-1] == 0, 60.0)
    assert cell.count("pushes") == cell.count("impossible poses, left out") == 0

    cell.play(displaced(pushes()[1], slice(middle, middle + 12)))
    wait_for(lambda: cell.count("pushes") == 1, 60.0)
    assert cell.count("impossible poses, left out") == 12 and "12 of" in cell.values["last error"]
    assert cell.count("pushes not explained") == 0 and cell.count("pushes with impossible poses, left out") == 1


def test_poses_without_a_covariance_are_learned_from_once_their_rests_show_it(cell: Cell) -> None:
    cell.begin("o4")
    client = cell.create_client(PredictPush, "predict_push")
    path = Path(header=Header(frame_id="table"))
    path.poses = [position_to_msg(stamp_to_msg(t), [x, 0.0, 0.01]) for t, x in ((1.0, -0.2), (2.0, 0.0))]

    def predict() -> PredictPush.Response:
        answer = ask(cell, lambda: client.call_async(PredictPush.Request(object_id="o4", pusher_path=path)))
        wait_for(answer.done)
        return answer.result()

    cell.states_covariance = False
    try:
        stamp = stamp_to_msg(30.0)
        said = predict()
        while "lack a covariance" not in said.message:
            cell.poses.publish(planar_pose_to_msg(stamp, pushes()[0].poses.pose[0], np.zeros((3, 3))))
            said = predict()
        assert not said.success and "0 of its frames at rest follow another one, expected at least 9; wait" in said.message
        cell.play(pushes()[0])
        wait_for(lambda: cell.count("pushes") == 1, 60.0)
        assert "from the scatter of" in cell.values["covariance of o4"] and cell.count("poses refused") == 0
        assert predict().success
    finally:
        cell.states_covariance = True


def test_push_over_an_edge_that_only_a_goal_gave_is_left_out_and_said(cell: Cell) -> None:
    cell.begin("o2")
    reach = transform_points(pushes()[0].poses.pose, pushes()[0].shape.outline).reshape(-1, 2)[:, 0].max()
    edge = TableEdge(np.array([1.0, 0.0]), float(reach) - 0.02, (-0.5, 0.5))
    latched = cell.create_publisher(PolygonStamped, EDGE_TOPIC, LATCHED)
    latched.publish(edge_to_msg(edge, stamp_to_msg(1.0)))
    cell.play(pushes()[0])
    wait_for(lambda: cell.count("pushes refused") == 1, 60.0)
    assert "overhung the edge of the table by 20 mm" in cell.values["last error"] and cell.count("pushes") == 0
    # A later goal with another edge: the same push is on the table.
    latched.publish(edge_to_msg(TableEdge(edge.outward, edge.offset + 1.0, edge.span), stamp_to_msg(1.0)))
    cell.play(pushes()[0])
    wait_for(lambda: cell.count("pushes") == 1, 60.0)


def test_push_without_an_end_record_is_not_learned_where_an_executor_is(cell: Cell) -> None:
    """The last one: from now on there is an executor."""
    cell.begin("o3")
    cell.play(pushes()[0])
    wait_for(lambda: cell.n_pushes and cell.n_pushes[-1] == 1 and cell.count("pushes") == 1, 60.0)

    records = cell.create_publisher(PushRecordMsg, "push_record", 10)
    wait_for(records.get_subscription_count)
    time.sleep(1.0)
    cell.play(pushes()[1])
    wait_for(lambda: cell.count("pushes without an end record, left out") == 1, 60.0)
    assert cell.count("pushes") == 1 and "the executor ended in the middle" in cell.values["last error"]
    # What was estimated during that push is given up, too.
    wait_for(lambda: cell.n_pushes[-1] == 1, 60.0)

    cell.play(pushes()[2], records)
    wait_for(lambda: cell.count("pushes") == 2, 60.0)
