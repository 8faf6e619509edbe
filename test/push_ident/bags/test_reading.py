"""Bags: what is written reads back, and what is dropped or assumed is counted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from helpers.bags import (
    COVARIANCE,
    L_OUTLINE,
    L_SHAPE,
    assert_same_record,
    header_msg,
    make_record,
    new,
    pose_msg,
    write_cells,
    write_push,
    write_pusher_logged,
    write_raw,
)
from helpers.paths import EXAMPLE_BAG
from push_ident.bags.contract import Role, TopicRole, role_of
from push_ident.bags.pushes import split_pushes
from push_ident.bags.raw import raw_messages
from push_ident.bags.reader import read_bag
from push_ident.bags.records import write_records
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError, FrameError, InputError
from push_ident.geometry.outline import polygon_area
from push_ident.types import CameraIntrinsics, CellGrid, ObjectShape
from push_ident_msgs.msg import PushRecord, PushScore


def test_topics_are_recognised_under_any_namespace() -> None:
    for prefix in ("", "/", "/lab/cell_2/"):
        assert role_of(prefix + "objects/7/pose") == TopicRole(Role.POSE, "7")
        assert role_of(prefix + "pusher/pose") == TopicRole(Role.PUSHER)
        assert role_of(prefix + "objects/7/prediction") is None and role_of(prefix + "my_pusher/pose") is None


@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
def test_records_read_back_equal(tmp_path: Path, name: str) -> None:
    # The second starts before the first ends, the third knows its end poses only.
    records = [make_record(0.0), make_record(0.5), make_record(9.0, n_poses=2)]
    write_records(tmp_path / name, records)
    contents = read_bag(tmp_path / name)
    assert contents.notes == []
    got = split_pushes(contents, "7")
    assert [record.source for record in got] == [f"{name} push {n}" for n in (1, 2, 3)]
    for one, other in zip(got, records, strict=True):
        assert_same_record(one, other)
    before = sorted(path.stat().st_mtime_ns for path in tmp_path.rglob("*"))
    with pytest.raises(BagError, match="not overwritten"):
        write_records(tmp_path / name, [make_record(2.0)])
    assert sorted(path.stat().st_mtime_ns for path in tmp_path.rglob("*")) == before


def test_one_push_of_two_objects_is_a_record_of_each_and_one_object_has_one_shape(tmp_path: Path) -> None:
    records = [make_record(1.0, object_id="a", wrench=False), make_record(1.0, object_id="b", wrench=False)]
    write_records(tmp_path / "bag", records)
    contents = read_bag(tmp_path / "bag")
    assert list(contents.objects) == ["a", "b"] and len(contents.pusher) == 31
    assert_same_record(split_pushes(contents, "b")[0], records[1])
    smaller = ObjectShape(CellGrid(L_SHAPE.cells.centres[:3], 0.01), L_OUTLINE)
    with pytest.raises(InputError, match="one shape"):
        write_records(tmp_path / "other", [records[0], replace(records[0], shape=smaller)])
    assert not (tmp_path / "other").exists()


def test_times_of_a_date_keep_their_nanoseconds(tmp_path: Path) -> None:
    stamps = [1_435_544_025_000_000_007 + n * 1_000_003 for n in range(40)]
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 1435544025.0, pusher=False)
        for stamp in stamps:
            write_pusher_logged(writer, stamp, stamp)
    np.testing.assert_allclose(np.diff(read_bag(tmp_path / "bag").pusher.time), 1_000_003e-9, rtol=0, atol=1e-13)


def test_what_is_dropped_or_assumed_is_counted(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        write_push(writer, 2.0)
        writer.write_pose("7", 3.2, (np.nan, 0.0, 0.0), COVARIANCE)
        writer.write_pose("7", 2.5, (0.5, 0.5, 0.5), COVARIANCE)
        writer.write_pose("7", 3.4, (0.5, 0.5, 0.5), np.zeros((3, 3)))
        write_pusher_logged(writer, 2_900_000_001, 3 * 10**9)
        write_pusher_logged(writer, 0, 3_100_000_000)
    contents = read_bag(tmp_path / "bag")
    notes = " ".join(contents.notes)
    assert "`objects/7/pose`: 1 of 34 messages hold values that are not finite" in notes
    assert "`objects/7/pose`: 1 of 34 messages repeat a stamp" in notes
    assert "`pusher/pose`: 1 of 32 messages were out of order" in notes
    assert "`pusher/pose`: 1 of 33 messages have no stamp, where others have; dropped" in notes
    assert "1 of 32 poses lack a covariance" in notes
    np.testing.assert_array_equal(contents.objects["7"].covariance[-1], np.zeros((3, 3)))
    np.testing.assert_allclose(contents.objects["7"].covariance[0], COVARIANCE)


def test_log_times_count_where_nothing_has_a_stamp(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for logged in (2.0, 2.1, 2.2):
            pose = new("geometry_msgs/msg/PoseWithCovariance", pose_msg(0.1, 0.2), np.zeros(36))
            write_raw(writer, Role.POSE.msgtype, "/objects/7/pose", round(1e9 * logged), header_msg(0.0, "table"), pose)
            write_pusher_logged(writer, 0, round(1e9 * logged))
    contents = read_bag(tmp_path / "bag")
    np.testing.assert_allclose(contents.pusher.time, [0.0, 0.1, 0.2])
    assert sum("none of 3 messages has a stamp; their log time is used" in note for note in contents.notes) == 2


@pytest.mark.parametrize(
    ("of_pose", "of_pusher", "noted"), [("", "", "pose` and `pusher"), ("", "table", "pose`:"), ("table", "table", ""), ("", "world", "")]
)
def test_a_frame_without_a_name_is_table_with_a_note_and_no_other_frame(tmp_path: Path, of_pose: str, of_pusher: str, noted: str) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for stamp in (2.0, 2.1, 2.2):
            pose = new("geometry_msgs/msg/PoseWithCovariance", pose_msg(0.1, 0.2), np.zeros(36))
            write_raw(writer, Role.POSE.msgtype, "/objects/7/pose", round(1e9 * stamp), header_msg(stamp, of_pose), pose)
            write_raw(writer, Role.PUSHER.msgtype, "/pusher/pose", round(1e9 * stamp), header_msg(stamp, of_pusher), pose_msg())
    if of_pusher == "world":
        with pytest.raises(BagError, match=r"objects/7/pose` in 'table' \(no frame_id\), `pusher/pose` in 'world'; expected all in"):
            read_bag(tmp_path / "bag")
        return
    notes = [note for note in read_bag(tmp_path / "bag").notes if "no frame_id; taken as in 'table'" in note]
    assert len(notes) == bool(noted) and noted in "".join(notes)


def test_the_frame_that_the_images_name_is_that_of_the_camera(tmp_path: Path) -> None:
    camera, in_table = CameraIntrinsics(2, 2, 3.0, 3.0, 0.5, 0.5), np.eye(4)
    for name in ("camera_depth_optical_frame", "camera_color_optical_frame", ""):
        with BagWriter(tmp_path / (name or "unnamed")) as writer:
            writer.write_extrinsics(1.0, in_table)
            write_push(writer, 2.0)
            writer.write_camera_info(2.0, camera)
            fields = header_msg(2.0, name), 2, 2, "16UC1", 0, 4, np.full(8, 1, dtype=np.uint8)
            write_raw(writer, Role.DEPTH.msgtype, "/depth/image_rect", 2 * 10**9, *fields)
    assert read_bag(tmp_path / "camera_depth_optical_frame").camera_in_table is not None
    unnamed = read_bag(tmp_path / "unnamed")
    assert unnamed.camera_in_table is not None and any("depth images: no frame_id; taken as in" in note for note in unnamed.notes)
    other = read_bag(tmp_path / "camera_color_optical_frame")
    assert other.camera_in_table is None and any("no frame 'camera_color_optical_frame'" in note for note in other.notes)


@pytest.mark.parametrize(("encoding", "schema"), [("json", b"{}"), ("protobuf", b"\x0a\xff\xfe")])
def test_channels_of_other_programs_do_no_harm(tmp_path: Path, encoding: str, schema: bytes) -> None:
    with (tmp_path / "mixed.mcap").open("wb") as file:
        mcap = McapWriter(file)
        mcap.start(profile="ros2", library="test")
        other = mcap.register_channel("/status", encoding, mcap.register_schema("Status", f"{encoding}schema", schema))
        for topic, fields in (
            ("/pusher/pose", (pose_msg(0.1, 0.2),)),
            ("/objects/7/pose", (new("geometry_msgs/msg/PoseWithCovariance", pose_msg(0.3, 0.2), np.eye(6).ravel()),)),
        ):
            msgtype = Role.PUSHER.msgtype if topic == "/pusher/pose" else Role.POSE.msgtype
            text, _ = jazzy_typestore().generate_msgdef(msgtype)
            channel = mcap.register_channel(topic, "cdr", mcap.register_schema(msgtype, "ros2msg", text.encode()))
            for stamp in (2.0, 2.1):
                data = jazzy_typestore().serialize_cdr(new(msgtype, header_msg(stamp, "table"), *fields), msgtype)
                mcap.add_message(channel, round(1e9 * stamp), bytes(data), round(1e9 * stamp))
                mcap.add_message(other, round(1e9 * stamp), b"{}", round(1e9 * stamp))
        mcap.finish()
    np.testing.assert_allclose(read_bag(tmp_path / "mixed.mcap").pusher.time, [0.0, 0.1])


def test_files_of_a_split_recording_are_read_in_order_of_time(tmp_path: Path) -> None:
    """As a script lists them, 10 before 2, and without a list."""
    for number in (0, 1, 2, 10):
        with BagWriter(tmp_path / f"part_{number}.mcap") as writer:
            write_push(writer, 2.0 + 3.0 * number)
    times = read_bag(tmp_path).pusher.time
    assert len(times) > 100 and np.all(np.diff(times) > 0)
    (tmp_path / "other.mcap").write_bytes((tmp_path / "part_0.mcap").read_bytes())
    with pytest.raises(BagError, match="name one of them"):
        read_bag(tmp_path)


def test_cells_follow_the_origin_and_yaw_of_their_grid(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0)
        write_cells(writer, 0.02, pose_msg(0.1, -0.2, yaw=np.pi / 2), np.array([[0, 0, 100], [-1, 49, 50]]))
    contents = read_bag(tmp_path / "bag")
    shape = contents.objects["7"].shape
    assert shape is not None and any("no outline" in note for note in contents.notes)
    # Column 2 is 5 cells of 1 cm along the grid's x, which points along the object's y.
    np.testing.assert_allclose(shape.cells.centres, [[0.09, -0.15], [0.07, -0.15]], atol=1e-9)
    assert polygon_area(shape.outline) == pytest.approx(2 * 0.02**2)


def test_depth_frames_come_one_by_one_in_metres(tmp_path: Path) -> None:
    camera = CameraIntrinsics(5, 3, 4.0, 4.5, 2.0, 1.0)
    millimetres = np.arange(15, dtype=np.uint16).reshape(3, 5) * 100
    metres = millimetres.astype(np.float32) / 1000
    metres[0, 0] = np.nan
    camera_in_table = np.array([[0.0, 1.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.1], [0.0, 0.0, -1.0, 0.9], [0.0, 0.0, 0.0, 1.0]])
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_extrinsics(1.0, camera_in_table)
        write_push(writer, 2.0, poses=False)
        for time, image in ((2.0, millimetres), (2.1, metres)):
            writer.write_camera_info(time, camera)
            writer.write_depth(time, image)
        writer.write_depth(2.2, metres[:2])
    contents = read_bag(tmp_path / "bag")
    assert not contents.has_poses and contents.n_depth == 3
    assert contents.camera_in_table is not None
    np.testing.assert_allclose(contents.camera_in_table, camera_in_table, atol=1e-12)
    frames = list(contents.depth_frames())
    assert [round(frame.stamp, 9) for frame in frames] == [0.0, 0.1] and frames[0].intrinsics == camera
    np.testing.assert_allclose(frames[0].depth, metres, rtol=1e-6)
    np.testing.assert_array_equal(frames[1].depth, metres)
    assert any("1 of 3 images are not usable" in note for note in contents.notes)


def test_depth_honours_step_and_byte_order_and_says_which_encodings_it_knows(tmp_path: Path) -> None:
    padded = np.hstack([np.array([[300, 1000], [2, 65535]], dtype=">u2").view(np.uint8), np.full((2, 6), 7, dtype=np.uint8)])
    for encoding in ("16UC1", "mono16"):
        with BagWriter(tmp_path / encoding) as writer:
            write_push(writer, 2.0)
            writer.write_camera_info(2.0, CameraIntrinsics(2, 2, 3.0, 3.0, 0.5, 0.5))
            fields = header_msg(2.0, "camera_depth_optical_frame"), 2, 2, encoding, 1, padded.shape[1], padded.ravel()
            write_raw(writer, Role.DEPTH.msgtype, "/depth/image_rect", 2 * 10**9, *fields)
    (frame,) = read_bag(tmp_path / "16UC1").depth_frames()
    np.testing.assert_allclose(frame.depth, [[0.3, 1.0], [0.002, 65.535]], rtol=1e-6)
    with pytest.raises(FrameError, match="'mono16'.*16UC1"):
        list(read_bag(tmp_path / "mono16").depth_frames())


def test_accuracy_of_the_camera_is_that_of_every_push_and_one_that_is_none_is_noted(tmp_path: Path) -> None:
    for name, position, heading in (("right", 2e-3, 5e-3), ("none", 1e6, 0.0)):
        variance = np.diag([position**2, position**2, 0.0, 0.0, 0.0, heading**2]).ravel()
        covariance = new("geometry_msgs/msg/PoseWithCovariance", pose_msg(), variance)
        with BagWriter(tmp_path / name) as writer:
            writer.write_shape("7", L_SHAPE, 1.0)
            write_raw(writer, Role.CAMERA_ACCURACY.msgtype, "/depth/camera_accuracy", 10**9, header_msg(1.0, "table"), covariance)
            write_push(writer, 2.0)
    right, wrong = (read_bag(tmp_path / name) for name in ("right", "none"))
    assert right.camera_accuracy is not None
    assert (right.camera_accuracy.position, right.camera_accuracy.heading) == pytest.approx((2e-3, 5e-3))
    (record,) = split_pushes(right, "7")
    assert record.poses.camera == right.camera_accuracy
    assert wrong.camera_accuracy is None and any("depth/camera_accuracy" in note for note in wrong.notes)


# ---- messages recorded with other definitions are played as the installed ones


def test_push_records_of_the_example_bag_are_what_subscribers_take() -> None:
    records = [deserialize_message(message.data, PushRecord) for message in raw_messages(EXAMPLE_BAG) if message.topic == "/push_record"]
    assert [record.push_id for record in records] == [1, 2, 3, 4]
    assert {record.object_id for record in records} == {"o1"}
    assert {record.purpose for record in records} == {PushRecord.PURPOSE_REQUESTED}
    assert all(record.distance > 0.01 and record.end.sec > record.start.sec for record in records)


OTHER = "std_msgs/Header header\nstring remark\nuint32 number\nfloat64 error\nfloat64[] extra"
"""Of PushScore, with other fields in another order."""


def test_fields_of_another_definition_are_taken_over_by_name_and_others_are_empty(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    name, text = "push_ident_msgs/msg/PushScore", "std_msgs/msg/String"
    store.register(get_types_from_msg(OTHER, name))
    score = store.types[name](header=header_msg(3.0, "table"), remark="old", number=7, error=0.25, extra=np.array([1.0, 2.0]))
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind, message in (("/objects/o1/push_score", name, score), ("/words", text, store.types[text](data="as it is"))):
            writer.write(writer.add_connection(topic, kind, typestore=store), 3 * 10**9, store.serialize_cdr(message, kind))
    played, words = raw_messages(tmp_path / "bag")
    found = deserialize_message(played.data, PushScore)
    assert found.header.stamp.sec == 3 and found.number == 7
    others = [getattr(found, field) for field in found.get_fields_and_field_types() if field not in ("header", "number")]
    assert all(value in (0, "", False) for value in others)
    assert words.data.endswith(b"as it is\x00")
