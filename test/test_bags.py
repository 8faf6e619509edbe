"""Bags: what is written reads back, what is wrong is refused in one line, what a kill leaves is recovered."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from push_ident.bags.contract import Role, TopicRole, role_of
from push_ident.bags.decode import DEFAULT_COVARIANCE
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.bags.records import write_records
from push_ident.bags.salvage import salvage
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError, FrameError, InputError, PushIdentError
from push_ident.geometry.outline import cells_in_outline, outline_of_cells, points_in_polygon, polygon_area, signed_distance
from push_ident.geometry.se2 import compose, inverse, quaternion_of_yaw, rotation, transform_points, wrap_angle, yaw_of_quaternion
from push_ident.types import CameraIntrinsics, CellGrid, ObjectShape, PoseTrack, PusherPath, PushRecord, WrenchTrack

DATA = Path(os.environ.get("PUSH_IDENT_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
COVARIANCE = np.array([[2e-6, 3e-7, 1e-7], [3e-7, 1e-6, 2e-7], [1e-7, 2e-7, 8e-5]])
L_OUTLINE = np.array([[0.0, 0.0], [0.06, 0.0], [0.06, 0.02], [0.02, 0.02], [0.02, 0.05], [0.0, 0.05]])
L_SHAPE = ObjectShape(cells_in_outline(L_OUTLINE, 0.01), L_OUTLINE)


def make_record(start: float, *, object_id: str = "7", n_poses: int = 6, wrench: bool = True) -> PushRecord:
    """A push of 1 s; the numbers follow no physics, they only have to come back."""
    time = start + np.linspace(0.0, 1.0, 31)
    pose_time = start + np.linspace(0.0, 1.0, n_poses)
    pose = np.column_stack([0.1 + 0.02 * (pose_time - start), 0.3 - 0.01 * (pose_time - start), 3.1 + 0.2 * (pose_time - start)])
    force = WrenchTrack(time, np.column_stack([np.sin(time), np.cos(time)])) if wrench else None
    return PushRecord(
        object_id,
        L_SHAPE,
        PoseTrack(pose_time, pose, np.tile(COVARIANCE, (n_poses, 1, 1))),
        PusherPath(time, np.column_stack([0.05 * (time - start), np.full_like(time, 0.31)]), 0.0085),
        force,
    )


def write_push(writer: BagWriter, start: float, *, n: int = 31, poses: bool = True, pusher: bool = True) -> None:
    for time in start + np.linspace(0.0, 1.0, n):
        if poses:
            writer.write_pose("7", time, (0.1, 0.2, time), COVARIANCE)
        if pusher:
            writer.write_pusher(time, (time, 0.0))


def write_raw(writer: BagWriter, role: Role, topic: str, stamp_ns: int, *fields: object) -> None:
    store = jazzy_typestore()
    message = store.types[role.msgtype](*fields)  # type: ignore[arg-type]
    writer.write_raw(topic, role.msgtype, stamp_ns, store.serialize_cdr(message, role.msgtype))


def write_pusher_logged(writer: BagWriter, stamp_ns: int, log_ns: int, topic: str = "/pusher/pose") -> None:
    """A pusher pose whose log time is not its stamp."""
    types = jazzy_typestore().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)), "table")
    point, turn = types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    write_raw(writer, Role.PUSHER, topic, log_ns, header, types["geometry_msgs/msg/Pose"](point, turn))


def bag_error(path: Path) -> str:
    with pytest.raises(BagError) as caught:
        read_bag(path)
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    return text


# Geometry


def test_outline_of_cells_of_an_l_is_its_six_corners_whatever_the_yaw() -> None:
    traced = outline_of_cells(L_SHAPE.cells.centres, 0.01)
    assert {tuple(p) for p in traced.round(9)} == {tuple(p) for p in L_OUTLINE}
    turned = outline_of_cells(L_SHAPE.cells.centres @ rotation(0.3).T, 0.01, yaw=0.3)
    np.testing.assert_allclose(turned, traced @ rotation(0.3).T, atol=1e-12)


@pytest.mark.parametrize(
    ("rows", "area"),
    [
        (["#"], 1),
        (["###", "#.#", "###"], 9),
        (["#.", ".#"], 1),
        (["####.#", "#..#.#", "##.#.."], 9),
        (["###.", "#.##", "##.#", ".###"], 14),
    ],
)
def test_outline_is_the_largest_outer_loop_without_holes(rows: list[str], area: int) -> None:
    centres = np.array([(x, -y) for y, row in enumerate(rows) for x, mark in enumerate(row) if mark == "#"], dtype=float)
    outline = outline_of_cells(centres, 1.0)
    assert len({tuple(p) for p in outline}) == len(outline)
    assert polygon_area(outline) == pytest.approx(area)


def test_outline_of_cells_that_are_on_no_lattice_is_refused() -> None:
    with pytest.raises(InputError, match="lattice"):
        outline_of_cells([[0.0, 0.0], [0.013, 0.0]], 0.01)
    with pytest.raises(InputError, match="at least one cell"):
        outline_of_cells(np.empty((0, 2)), 0.01)


def test_distance_to_a_triangle_is_negative_inside() -> None:
    triangle = [[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]
    points = [[1.0, 1.0], [4.0, 0.0], [3.0, 4.0], [1.0, -2.0]]
    np.testing.assert_allclose(signed_distance(points, triangle), [-1.0, 1.0, 12 / 5, 2.0])  # incircle of 3-4-5 has radius 1
    np.testing.assert_array_equal(points_in_polygon(points, triangle), [True, False, False, False])


def test_planar_motions_compose_and_invert() -> None:
    a, b = np.array([[0.3, -0.2, 2.9], [1.0, 0.0, -1.0]]), np.array([0.1, 0.7, 0.6])
    points = np.array([[0.2, 0.1], [-0.4, 0.3]])
    np.testing.assert_allclose(transform_points(compose(a, b), points), transform_points(a, transform_points(b, points)), atol=1e-15)
    np.testing.assert_allclose(compose(a, inverse(a)), 0.0, atol=1e-15)
    np.testing.assert_allclose(transform_points([0.0, 0.0, np.pi / 2], [[1.0, 0.0]]), [[0.0, 1.0]], atol=1e-15)
    np.testing.assert_allclose(yaw_of_quaternion(quaternion_of_yaw([3.0, -1.2])), [3.0, -1.2])
    np.testing.assert_allclose(wrap_angle([4.0, -4.0, 0.5]), [4.0 - 2 * np.pi, 2 * np.pi - 4.0, 0.5])


# Contract


@pytest.mark.parametrize("prefix", ["", "/", "/cell1/", "/lab/cell_2/"])
def test_topics_are_recognised_under_any_namespace(prefix: str) -> None:
    assert role_of(prefix + "objects/7/pose") == TopicRole(Role.POSE, "7")
    assert role_of(prefix + "pusher/pose") == TopicRole(Role.PUSHER)
    assert role_of(prefix + "objects/7/prediction") is None
    assert role_of(prefix + "my_pusher/pose") is None


# Round trip


def assert_same_record(got: PushRecord, expected: PushRecord) -> None:
    shift = got.pusher.time[0] - expected.pusher.time[0]
    assert (got.object_id, got.pusher.radius) == (expected.object_id, expected.pusher.radius)
    np.testing.assert_allclose(got.shape.cells.centres, expected.shape.cells.centres, atol=1e-9)
    assert got.shape.cells.size == pytest.approx(expected.shape.cells.size, rel=1e-9)
    np.testing.assert_allclose(got.shape.outline, expected.shape.outline, atol=1e-8)  # float32 on the wire
    for name in ("time", "pose", "covariance"):
        offset = shift if name == "time" else 0.0
        np.testing.assert_allclose(getattr(got.poses, name) - offset, getattr(expected.poses, name), atol=2e-9)
    np.testing.assert_allclose(got.pusher.time - shift, expected.pusher.time, atol=2e-9)
    np.testing.assert_array_equal(got.pusher.position, expected.pusher.position)
    assert (got.wrench is None) == (expected.wrench is None)
    if got.wrench is not None and expected.wrench is not None:
        np.testing.assert_array_equal(got.wrench.force, expected.wrench.force)


@pytest.mark.parametrize("name", ["bag", "bag.mcap", "day.bag"])
def test_records_read_back_equal(tmp_path: Path, name: str) -> None:
    # The second starts before the first ends, the third knows its end poses only.
    records = [make_record(0.0), make_record(0.5), make_record(9.0, n_poses=2)]
    write_records(tmp_path / name, records)
    contents = read_bag(tmp_path / name)
    assert contents.notes == []
    got = split_pushes(contents, "7")
    assert [record.source for record in got] == [f"{name} push {n}" for n in range(3)]
    for one, other in zip(got, records, strict=True):
        assert_same_record(one, other)


def test_one_push_seen_on_two_objects_is_a_record_of_each(tmp_path: Path) -> None:
    records = [make_record(1.0, object_id="a", wrench=False), make_record(1.0, object_id="b", wrench=False)]
    write_records(tmp_path / "bag", records)
    contents = read_bag(tmp_path / "bag")
    assert list(contents.objects) == ["a", "b"] and len(contents.pusher) == 31
    assert_same_record(split_pushes(contents, "b")[0], records[1])


def test_records_that_cannot_share_a_bag_are_refused(tmp_path: Path) -> None:
    other = make_record(5.0)
    smaller = ObjectShape(CellGrid(L_SHAPE.cells.centres[:3], 0.01), L_OUTLINE)
    with pytest.raises(InputError, match="one shape"):
        write_records(tmp_path / "bag", [other, PushRecord("7", smaller, other.poses, other.pusher)])
    assert not (tmp_path / "bag").exists()


def test_an_existing_bag_is_never_overwritten(tmp_path: Path) -> None:
    write_records(tmp_path / "bag.mcap", [make_record(1.0)])
    before = (tmp_path / "bag.mcap").read_bytes()
    with pytest.raises(BagError, match="not overwritten"):
        write_records(tmp_path / "bag.mcap", [make_record(2.0)])
    assert (tmp_path / "bag.mcap").read_bytes() == before


def test_times_of_a_date_keep_their_nanoseconds(tmp_path: Path) -> None:
    stamps = [1_435_544_025_000_000_007 + n * 1_000_003 for n in range(40)]
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 1435544025.0, pusher=False)
        for stamp in stamps:
            write_pusher_logged(writer, stamp, stamp)
    np.testing.assert_allclose(np.diff(read_bag(tmp_path / "bag").pusher.time), 1_000_003e-9, rtol=0, atol=1e-13)


# Telling pushes apart


def test_pushes_are_cut_at_gaps_and_take_the_poses_at_rest_around_them(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        for time in np.arange(1.05, 12.0, 0.1):
            writer.write_pose("7", time, (0.1, 0.2, time), COVARIANCE)
        for start in (2.0, 3.6, 9.0):
            write_push(writer, start, poses=False)
    contents = read_bag(tmp_path / "bag")
    assert any("pusher/shape" in note for note in contents.notes)
    pushes = split_pushes(contents, "7")
    spans = [(record.poses.time[[0, -1]] + contents.origin_ns * 1e-9).round(6).tolist() for record in pushes]
    assert spans == [[1.55, 3.25], [3.35, 5.05], [8.55, 10.45]]
    assert [len(record.pusher.time) for record in pushes] == [31, 31, 31]


def test_poses_far_from_a_push_count_when_there_are_none_nearer(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        for time in (1.0, 5.2, 10.0):
            writer.write_pose("7", time, (time, 0.0, 0.0), COVARIANCE)
        for start in (2.0, 7.0):
            write_push(writer, start, poses=False)
    pushes = split_pushes(read_bag(tmp_path / "bag"), "7")
    # 5.2 s is nearer to the second push (7 s) than to the first (3 s): the first has no pose after it.
    assert [record.source for record in pushes] == ["bag push 1"]
    assert pushes[0].poses.pose[:, 0].tolist() == [5.2, 10.0]


def test_push_records_cut_the_bag_and_failed_pushes_are_left_out(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        for start in (2.0, 3.05, 8.0):
            write_push(writer, start)
        for push_id, (start, code) in enumerate([(2.0, 0), (3.05, -5), (8.0, 0)], start=1):
            writer.write_push_record(push_id, "7", start, start + 1.0, error_code=code)
    contents = read_bag(tmp_path / "bag")
    pushes = split_pushes(contents, "7")
    assert [record.source for record in pushes] == ["bag push 0", "bag push 2"]
    assert pushes[0].poses.time[-1] <= 3.025 - contents.origin_ns * 1e-9 + 1e-6
    assert any("error code -5" in note for note in contents.notes)
    n_notes = len(contents.notes)
    split_pushes(contents, "7")
    assert len(contents.notes) == n_notes


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
    assert "`pusher/pose`: 1 of 33 messages came out of order" in notes
    assert "`pusher/pose`: 1 of 33 messages have no stamp; their log time is used" in notes
    assert contents.pusher.time[-1] == pytest.approx(1.1)
    assert "1 of 32 poses lack a covariance" in notes
    np.testing.assert_array_equal(contents.objects["7"].covariance[-1], DEFAULT_COVARIANCE)
    np.testing.assert_allclose(contents.objects["7"].covariance[0], COVARIANCE)


def test_cells_follow_the_origin_and_yaw_of_their_grid(tmp_path: Path) -> None:
    store = jazzy_typestore()
    x, y, z, w = quaternion_of_yaw(np.pi / 2)
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](1, 0), "object_7")
    origin = store.types["geometry_msgs/msg/Pose"](
        store.types["geometry_msgs/msg/Point"](0.1, -0.2, 0.0), store.types["geometry_msgs/msg/Quaternion"](x, y, z, w)
    )
    info = store.types["nav_msgs/msg/MapMetaData"](header.stamp, 0.02, 3, 2, origin)  # type: ignore[attr-defined]
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0)
        write_raw(writer, Role.CELLS, "/objects/7/cells", 10**9, header, info, np.array([0, 0, 100, -1, 49, 50], dtype=np.int8))
    contents = read_bag(tmp_path / "bag")
    shape = contents.objects["7"].shape
    assert shape is not None and any("no outline" in note for note in contents.notes)
    # Column 2 is 5 cells of 1 cm along the grid's x, which points along the object's y.
    np.testing.assert_allclose(shape.cells.centres, [[0.09, -0.15], [0.07, -0.15]], atol=1e-9)
    assert polygon_area(shape.outline) == pytest.approx(2 * 0.02**2)


# Depth


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


@pytest.mark.parametrize(("bigendian", "pad"), [(0, 0), (1, 0), (0, 6), (1, 6)])
def test_depth_honours_step_and_byte_order(tmp_path: Path, bigendian: int, pad: int) -> None:
    values = np.array([[300, 1000], [2, 65535]], dtype=">u2" if bigendian else "<u2")
    rows = np.hstack([values.view(np.uint8).reshape(2, 4), np.full((2, pad), 7, dtype=np.uint8)])
    self_described(tmp_path / "bag", "16UC1", bigendian, rows)
    (frame,) = read_bag(tmp_path / "bag").depth_frames()
    np.testing.assert_allclose(frame.depth, [[0.3, 1.0], [0.002, 65.535]], rtol=1e-6)


def test_depth_of_another_encoding_is_refused_by_name(tmp_path: Path) -> None:
    self_described(tmp_path / "bag", "mono16", 0, np.zeros((2, 4), dtype=np.uint8))
    with pytest.raises(FrameError, match="'mono16'.*16UC1"):
        list(read_bag(tmp_path / "bag").depth_frames())


def self_described(path: Path, encoding: str, bigendian: int, rows: np.ndarray) -> None:
    store = jazzy_typestore()
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](2, 0), "camera_depth_optical_frame")
    with BagWriter(path) as writer:
        write_push(writer, 2.0)
        writer.write_camera_info(2.0, CameraIntrinsics(2, 2, 3.0, 3.0, 0.5, 0.5))
        write_raw(writer, Role.DEPTH, "/depth/image_rect", 2 * 10**9, header, 2, 2, encoding, bigendian, rows.shape[1], rows.ravel())


# What is wrong with a bag


def test_paths_that_hold_no_bag_are_named(tmp_path: Path) -> None:
    assert "no such bag" in bag_error(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    assert "holds no bag" in bag_error(tmp_path / "empty")
    (tmp_path / "notes.txt").write_text("hello")
    assert "not a bag by its name" in bag_error(tmp_path / "notes.txt")


@pytest.mark.parametrize("name", ["x.mcap", "x.db3", "x.bag", "metadata.yaml"])
@pytest.mark.parametrize("size", [0, 1, 4096])
def test_random_bytes_are_refused_in_one_line(tmp_path: Path, name: str, size: int) -> None:
    (tmp_path / name).write_bytes(random.Random(size).randbytes(size))
    assert "cannot be read" in bag_error(tmp_path / name)


def test_a_bag_without_pusher_poses_lists_what_is_missing_and_present(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0, pusher=False)
    assert "`pusher/pose` (geometry_msgs/msg/PoseStamped)" in (text := bag_error(tmp_path / "bag"))
    assert "/objects/7/pose (31)" in text


def test_a_bag_with_neither_poses_nor_depth_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0, poses=False)
    assert "`objects/<id>/pose`" in bag_error(tmp_path / "bag")


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_bag_of_zero_messages_is_refused(tmp_path: Path, plugin: StoragePlugin) -> None:
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        writer.add_connection("/pusher/pose", Role.PUSHER.msgtype, typestore=jazzy_typestore())
    assert "no messages at all" in bag_error(tmp_path / "bag")


def test_a_bag_whose_index_promises_more_than_can_be_read_is_refused(tmp_path: Path) -> None:
    store = jazzy_typestore()
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as sqlite:
        connection = sqlite.add_connection("/pusher/pose", Role.PUSHER.msgtype, typestore=store)
        header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](1, 0), "table")
        pose = store.types["geometry_msgs/msg/Pose"](
            store.types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        )
        sqlite.write(connection, 1, store.serialize_cdr(store.types[Role.PUSHER.msgtype](header, pose), Role.PUSHER.msgtype))
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 1", "message_count: 9"))
    assert "promises 9 messages" in bag_error(tmp_path / "bag")


def test_two_cells_in_one_bag_are_not_mixed(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0)
        write_pusher_logged(writer, 10**9, 10**9, topic="/cell2/pusher/pose")
    assert "/cell2/pusher/pose and /pusher/pose" in bag_error(tmp_path / "bag")


def test_a_clock_that_was_set_back_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0)
        for log in range(50):
            write_pusher_logged(writer, (log % 25) * 10**9, log * 10**9)
    assert "jumps back by 24 s" in bag_error(tmp_path / "bag")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_bag_cut_short_names_what_can_be_recovered_and_salvage_recovers_it(tmp_path: Path, share: float) -> None:
    with BagWriter(tmp_path / "bag", chunk_size=2000) as writer:
        writer.write_shape("7", L_SHAPE, 1.0)
        write_push(writer, 2.0, n=200)
    file = tmp_path / "bag" / "bag.mcap"
    whole = file.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(len(whole) * share)])
    text = bag_error(cut)
    report = salvage(cut, tmp_path / "new")
    assert f"{report.total} messages can be recovered: `push-ident salvage {cut} --out NEW`" in text
    assert 0 < report.total <= 402 and report.damaged_chunks == 0 and report.end
    assert cut.read_bytes() == whole[: int(len(whole) * share)]
    contents = read_bag(tmp_path / "new")
    assert sum(contents.topics.values()) == report.total
    assert contents.topics == report.messages


def test_salvage_leaves_a_chunk_with_a_flipped_byte_out(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag.mcap", chunk_size=2000) as writer:
        write_push(writer, 2.0, n=200)
    data = bytearray((tmp_path / "bag.mcap").read_bytes())
    data[len(data) // 2] ^= 0x10
    (tmp_path / "flipped.mcap").write_bytes(data)
    report = salvage(tmp_path / "flipped.mcap", tmp_path / "new")
    assert report.damaged_chunks <= 1 and 380 <= report.total <= 400


def test_salvage_leaves_messages_out_that_are_not_what_their_type_says(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0)
        writer.write_raw("/pusher/pose", Role.PUSHER.msgtype, 2 * 10**9, b"\x00\x01\x00\x00" + bytes(5))
    assert "cannot be read" in bag_error(tmp_path / "bag")
    report = salvage(tmp_path / "bag", tmp_path / "new")
    assert (report.undecodable, report.total) == (1, 62)
    assert len(read_bag(tmp_path / "new").pusher) == 31


def test_salvage_of_nothing_makes_no_bag(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(BagError, match="no message can be recovered"):
        salvage(tmp_path / "x.mcap", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_flipped_bytes_end_in_a_typed_error_or_a_readable_bag(tmp_path: Path) -> None:
    write_records(tmp_path / "bag.mcap", [make_record(1.0), make_record(5.0)])
    whole = (tmp_path / "bag.mcap").read_bytes()
    rng = random.Random(3)
    refused = 0
    for trial in range(80):
        data = bytearray(whole)
        for _ in range(rng.choice([1, 1, 8])):
            data[rng.randrange(len(data))] = rng.randrange(256)
        file = tmp_path / f"{trial}.mcap"
        file.write_bytes(data)
        try:
            split_pushes(read_bag(file), "7")
        except PushIdentError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 40


KILLED = """
import sys, time
from pathlib import Path
import numpy as np
from push_ident.bags.writer import BagWriter
with BagWriter(Path(sys.argv[1])) as writer:
    for n in range(5000):
        writer.write_pose("7", 1.0 + 0.01 * n, (0.1, 0.2, 0.3), np.eye(3) * 1e-6)
        if n == 4000:
            time.sleep(1.1)
        if n == 4001:
            print("written", flush=True)
            time.sleep(60)
"""


def test_what_was_written_a_second_before_a_kill_is_recovered(tmp_path: Path) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path / "bag")],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
    )
    try:
        assert child.stdout is not None and child.stdout.readline() == b"written\n"
    finally:
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
    assert "4002 messages can be recovered" in bag_error(tmp_path / "bag")
    assert salvage(tmp_path / "bag", tmp_path / "new").messages == {"/objects/7/pose": 4002}


# A bag by others


def test_contract_sample_of_another_maker_is_read() -> None:
    bag = DATA / "contract_sample" / "bag"
    if not bag.exists():
        pytest.skip(f"no recording at {bag}; set PUSH_IDENT_DATA to the folder of recordings")
    contents = read_bag(bag)
    pushes = split_pushes(contents, "1")
    assert contents.notes == [] and len(pushes) == 8
    assert sum(len(push.poses.time) for push in pushes) == sum(len(push.pusher.time) for push in pushes) == 359
    shape = pushes[0].shape
    assert len(shape.cells) == 70 and shape.cells.size == 0.011 and pushes[0].pusher.radius == 0.008
    # The outline it states is the one of its cells.
    assert polygon_area(shape.outline) == pytest.approx(70 * 0.011**2, rel=1e-5)
    assert polygon_area(outline_of_cells(shape.cells.centres, 0.011)) == pytest.approx(70 * 0.011**2)
    np.testing.assert_allclose(np.sqrt(np.diag(pushes[0].poses.covariance[0])), [1e-3, 1e-3, np.radians(0.5)])
