"""What is wrong with a bag is refused in one line; what a cut or a flipped byte leaves is recovered."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from helpers.bags import L_SHAPE, bag_error, write_push, write_pusher_logged
from helpers.paths import EXAMPLE_BAG
from push_ident.bags.contract import Role
from push_ident.bags.reader import read_bag
from push_ident.bags.salvage import salvage
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError


def test_paths_that_hold_no_bag_are_named_and_random_bytes_refused(tmp_path: Path) -> None:
    assert "no such bag" in bag_error(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    assert "holds no bag" in bag_error(tmp_path / "empty")
    (tmp_path / "notes.txt").write_text("hello")
    assert "not the name of a bag" in bag_error(tmp_path / "notes.txt")
    for name in ("x.mcap", "x.db3", "x.bag", "metadata.yaml"):
        for size in (0, 1, 4096):
            (tmp_path / name).write_bytes(random.Random(size).randbytes(size))
            assert "cannot be read" in bag_error(tmp_path / name)


def test_a_bag_without_pusher_poses_or_with_neither_poses_nor_depth_lists_what_is_missing_and_present(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "poses") as writer:
        write_push(writer, 2.0, pusher=False)
    assert "`pusher/pose` (geometry_msgs/msg/PoseStamped)" in (text := bag_error(tmp_path / "poses"))
    assert "/objects/7/pose (31)" in text
    with BagWriter(tmp_path / "pusher") as writer:
        write_push(writer, 2.0, poses=False)
    assert "`objects/<id>/pose`" in bag_error(tmp_path / "pusher")


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_bag_of_zero_messages_is_refused(tmp_path: Path, plugin: StoragePlugin) -> None:
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        writer.add_connection("/pusher/pose", Role.PUSHER.msgtype, typestore=jazzy_typestore())
    assert "no messages at all" in bag_error(tmp_path / "bag")


def test_a_bag_whose_index_lists_more_messages_than_can_be_read_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0)
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 31", "message_count: 39"))
    assert "lists 78 messages" in bag_error(tmp_path / "bag")


def test_two_cells_in_one_bag_are_not_mixed_and_a_clock_that_was_set_back_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "cells") as writer:
        write_push(writer, 2.0)
        write_pusher_logged(writer, 10**9, 10**9, topic="/cell2/pusher/pose")
    assert "/cell2/pusher/pose and /pusher/pose" in bag_error(tmp_path / "cells")
    with BagWriter(tmp_path / "clock") as writer:
        write_push(writer, 2.0)
        for log in range(50):
            write_pusher_logged(writer, (log % 25) * 10**9, log * 10**9)
    assert "jumps back by 23 s" in bag_error(tmp_path / "clock")


@pytest.mark.parametrize("share", [0.1, 0.99])
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


def test_salvage_of_a_whole_bag_loses_nothing_also_where_its_types_are_of_an_older_version(tmp_path: Path) -> None:
    report = salvage(EXAMPLE_BAG, tmp_path / "new")  # its push records are older than the installed type
    assert report.undecodable == 0 and report.messages == read_bag(EXAMPLE_BAG).topics


def test_salvage_leaves_out_a_chunk_with_a_flipped_byte_and_messages_that_do_not_decode(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "whole.mcap", chunk_size=2000) as writer:
        write_push(writer, 2.0, n=200)
    data = bytearray((tmp_path / "whole.mcap").read_bytes())
    data[len(data) // 2] ^= 0x10
    (tmp_path / "flipped.mcap").write_bytes(data)
    report = salvage(tmp_path / "flipped.mcap", tmp_path / "some")
    assert report.damaged_chunks <= 1 and 380 <= report.total <= 400
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 2.0)
        writer.write_raw("/pusher/pose", Role.PUSHER.msgtype, 2 * 10**9, b"\x00\x01\x00\x00" + bytes(5))
    assert "cannot be read" in bag_error(tmp_path / "bag")
    report = salvage(tmp_path / "bag", tmp_path / "new")
    assert (report.undecodable, report.total) == (1, 62)
    assert len(read_bag(tmp_path / "new").pusher) == 31
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(BagError, match="no message can be recovered"):
        salvage(tmp_path / "x.mcap", tmp_path / "none")
    assert not (tmp_path / "none").exists()
