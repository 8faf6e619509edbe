"""Mutated messages can be sent, differ, and cover what a field can hold."""

from __future__ import annotations

import math
import random

import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import serialize_message
from std_msgs.msg import Float32MultiArray

from push_ident_msgs.srv import SaveModel
from push_ident_sim.fuzz.fields import FLOATS, field_types, interface_class
from push_ident_sim.fuzz.minimise import shortest
from push_ident_sim.fuzz.mutate_message import mutate_bytes, mutate_message

TYPES = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CameraInfo",
    "nav_msgs/msg/OccupancyGrid",
    "shape_msgs/msg/SolidPrimitive",
    "trajectory_msgs/msg/JointTrajectory",
    "rcl_interfaces/msg/ParameterEvent",
    "push_ident_msgs/msg/MassFrictionMap",
    "push_ident_msgs/msg/HandCommand",
    "unique_identifier_msgs/msg/UUID",
)


@pytest.mark.parametrize("name", TYPES)
def test_mutated_messages_can_be_sent_and_most_differ(name: str) -> None:
    base = interface_class(name)()
    before = repr(base)
    mutated = [mutate_message(base, random.Random(seed))[0] for seed in range(300)]
    assert sum(repr(msg) != before for msg in mutated) > 150
    assert all(mutate_bytes(serialize_message(msg), random.Random(seed)) for seed, msg in enumerate(mutated))
    assert repr(base) == before


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_largest_numbers_that_a_message_holds_can_be_set_again(sign: float) -> None:
    once, again = Float32MultiArray(data=[sign * FLOATS["float"]]), Float32MultiArray()
    again.data = once.data.tolist()
    assert math.isfinite(again.data[0])


def test_same_seed_gives_the_same_mutation() -> None:
    base = interface_class("nav_msgs/msg/OccupancyGrid")()
    first, second = (mutate_message(base, random.Random(5)) for _ in range(2))
    assert repr(first) == repr(second)


def test_poses_get_every_kind_of_wrong_value() -> None:
    base = PoseWithCovarianceStamped()
    base.header.frame_id, base.pose.pose.orientation.w = "table", 1.0
    mutated = [mutate_message(base, random.Random(seed))[0] for seed in range(2000)]
    positions = [msg.pose.pose.position.x for msg in mutated]
    assert any(math.isnan(x) for x in positions) and any(x == 5e-324 for x in positions) and any(x == math.inf for x in positions)
    assert any(any(math.isnan(x) for x in msg.pose.covariance) for msg in mutated)
    assert any(msg.header.stamp.sec < 0 for msg in mutated) and any(msg.header.stamp.nanosec >= 10**9 for msg in mutated)
    assert any(msg.pose.pose.orientation.w == msg.pose.pose.orientation.x == 0.0 for msg in mutated)
    assert any("<script>" in msg.header.frame_id for msg in mutated) and any("[/x]" in msg.header.frame_id for msg in mutated)


def test_names_of_files_stay_in_the_folder_of_the_node() -> None:
    base = SaveModel.Request(object_id="o1", path="model.json")
    paths = {mutate_message(base, random.Random(seed))[0].path for seed in range(500)} - {base.path}
    assert len(paths) > 10 and not any("/" in path or path.startswith((".", "~")) for path in paths)


def test_bounded_arrays_keep_their_bound() -> None:
    kind = interface_class("shape_msgs/msg/SolidPrimitive")
    assert field_types(kind)["dimensions"].bound == 3
    for seed in range(300):
        assert len(mutate_message(kind(), random.Random(seed))[0].dimensions) <= 3


def test_shortest_sequence_holds_only_what_is_needed() -> None:
    tried: list[list[int]] = []

    def fails(items: list[int]) -> bool:
        tried.append(items)
        return 7 in items and 42 in items

    assert shortest(range(100), fails) == [7, 42]
    assert len(tried) < 100
