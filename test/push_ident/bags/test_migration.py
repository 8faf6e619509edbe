"""Messages recorded with other definitions are played as the installed ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from helpers.paths import EXAMPLE_BAG
from push_ident.bags.raw import raw_messages
from push_ident_msgs.msg import PushRecord, PushScore

OTHER = """std_msgs/Header header
string remark
uint32 number
float64 error
float64[] extra"""
"""Of PushScore, with other fields in another order."""


def test_push_records_of_the_example_bag_are_what_subscribers_take() -> None:
    records = [deserialize_message(message.data, PushRecord) for message in raw_messages(EXAMPLE_BAG) if message.topic == "/push_record"]
    assert [record.push_id for record in records] == [1, 2, 3, 4]
    assert {record.object_id for record in records} == {"o1"}
    assert {record.purpose for record in records} == {PushRecord.PURPOSE_REQUESTED}
    assert all(record.distance > 0.01 and record.end.sec > record.start.sec for record in records)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    store = get_typestore(Stores.ROS2_JAZZY)
    name = "push_ident_msgs/msg/PushScore"
    store.register(get_types_from_msg(OTHER, name))
    header = store.types["std_msgs/msg/Header"](stamp=store.types["builtin_interfaces/msg/Time"](sec=3, nanosec=0), frame_id="table")
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/objects/o1/push_score", name, typestore=store)
        message = store.types[name](header=header, remark="old", number=7, error=0.25, extra=np.array([1.0, 2.0]))
        writer.write(connection, 3 * 10**9, store.serialize_cdr(message, name))
        text = writer.add_connection("/words", "std_msgs/msg/String", typestore=store)
        writer.write(text, 4 * 10**9, store.serialize_cdr(store.types["std_msgs/msg/String"](data="as it is"), "std_msgs/msg/String"))
    return tmp_path / "bag"


def test_fields_are_taken_over_by_name_and_others_are_empty(bag: Path) -> None:
    score, words = raw_messages(bag)
    found = deserialize_message(score.data, PushScore)
    assert found.header.stamp.sec == 3 and found.number == 7
    others = [getattr(found, name) for name in found.get_fields_and_field_types() if name not in ("header", "number")]
    assert all(value in (0, "", False) for value in others)
    assert words.data.endswith(b"as it is\x00")
