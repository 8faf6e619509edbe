"""How the streams of a bag are cut into pushes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.bags import COVARIANCE, L_SHAPE, write_push
from push_ident.bags.contract import Role
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError


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
    assert [record.source for record in pushes] == ["bag push 2"]
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
    assert [record.source for record in pushes] == ["bag push 1", "bag push 3"]
    assert pushes[0].poses.time[-1] <= 3.025 - contents.origin_ns * 1e-9 + 1e-6
    assert any("error code -5" in note for note in contents.notes)
    n_notes = len(contents.notes)
    split_pushes(contents, "7")
    assert len(contents.notes) == n_notes


def test_one_push_beside_an_executor_that_left_no_record_was_broken_off_and_two_are_those_of_another_program(tmp_path: Path) -> None:
    for name, starts in (("one", (2.0,)), ("two", (2.0, 6.0))):
        with BagWriter(tmp_path / name) as writer:
            writer.declare("/push_record", Role.PUSH_RECORD.msgtype)
            writer.write_shape("7", L_SHAPE, 1.0)
            for start in starts:
                write_push(writer, start)
    with pytest.raises(BagError, match="the executor ended in the middle"):
        split_pushes(read_bag(tmp_path / "one"), "7")
    assert len(split_pushes(read_bag(tmp_path / "two"), "7")) == 2
