"""Tables of tracked poses: what goes out as CSV comes back from the bag."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.commands import run_here
from helpers.objects import hammer, random_records
from helpers.recordings import PERIOD, table_file, tracked_rows
from push_ident.bags.importers import TableFormat, TrackedPoses, import_tracked_poses
from push_ident.bags.importers.tables import read_table
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.errors import BagError, InputError, PushIdentError
from push_ident.types import PushRecord

N = 4


@pytest.fixture(scope="module")
def records() -> list[PushRecord]:
    return random_records(hammer(3), N, 3, noise=0.2)


@pytest.fixture
def files(tmp_path: Path, records: list[PushRecord]) -> TrackedPoses:
    poses, pusher = tracked_rows(records)
    return TrackedPoses(
        poses=table_file(tmp_path / "poses.csv", "time,x,y,yaw", poses),
        pusher=table_file(tmp_path / "pusher.csv", "time,x,y", pusher[:, :3]),
        outline=table_file(tmp_path / "outline.csv", "x,y", records[0].shape.outline),
        radius=0.008,
        position_std=2e-4,
        yaw_std=2e-3,
        cell_size=0.011,
    )


def arguments(files: TrackedPoses, *more: object) -> list[object]:
    return ["import", "csv", files.poses, "--pusher", files.pusher, "--outline", files.outline, "--radius", files.radius, *more]


def test_tables_come_back_from_the_bag(tmp_path: Path, files: TrackedPoses, records: list[PushRecord]) -> None:
    done = run_here(*arguments(files, "--object", "hammer", "--out", tmp_path / "bag", "--json", tmp_path / "r.json"))
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["n_pushes"] == N and report["warnings"] == [] and report["mass"] is None and report["supports_m"] == []
    assert np.abs(report["contact_distance_m"]).max() < 2e-3
    pushes = split_pushes(read_bag(tmp_path / "bag"), "hammer")
    assert len(pushes) == N
    for push, record in zip(pushes, records, strict=True):
        np.testing.assert_allclose(push.shape.outline, record.shape.outline, atol=1e-6)
        assert push.pusher.radius == 0.008
        # The pusher stands at both ends of the record; the poses have some of the rest around it.
        np.testing.assert_allclose(push.pusher.position[[0, -1]], record.pusher.position[[0, -1]], atol=1e-3)
        np.testing.assert_allclose(push.poses.pose[[0, -1], :2], record.poses.pose[[0, -1], :2], atol=2e-3)
        assert len(push.poses.time) > len(record.poses.time) / 2
        assert np.sqrt(push.poses.covariance[0, 0, 0]) == pytest.approx(2e-4, rel=0.3)


def test_first_column_names_the_file_where_the_object_option_holds_it(tmp_path: Path, files: TrackedPoses) -> None:
    given = ("--object", files.poses, "--pusher", files.pusher, "--outline", files.outline, "--radius", 0.008)
    done = run_here("import", "csv", *given, "--out", tmp_path / "bag")
    assert done.returncode == 0, done.stderr
    assert len(split_pushes(read_bag(tmp_path / "bag"), "1")) == N


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_names_units_and_separators_of_other_programs(
    tmp_path: Path, files: TrackedPoses, records: list[PushRecord], separator: str
) -> None:
    poses, pusher = tracked_rows(records)
    poses = poses * [1e3, 1e3, 1e3, 180.0 / np.pi]
    pusher = pusher[:, :3] * 1e3
    other = replace(
        files,
        poses=table_file(tmp_path / "p.csv", "Stamp,PX,PY,Heading", poses, separator=separator),
        pusher=table_file(tmp_path / "t.csv", "Stamp,X,Y", pusher, separator=separator),
        outline=table_file(tmp_path / "o.csv", "x,y", 1e3 * records[0].shape.outline, separator=separator),
    )
    units = ("--length-unit", "mm", "--angle-unit", "deg", "--time-unit", "ms", "--cell-size", "0.011")
    names = ("--columns", "time=stamp,x=px,y=py,yaw=heading", "--pusher-columns", "time=Stamp")
    done = run_here(*arguments(other, *units, *names, "--out", tmp_path / "bag"))
    assert done.returncode == 0, done.stderr
    import_tracked_poses(files, tmp_path / "plain")
    first, second = (split_pushes(read_bag(tmp_path / name), "1") for name in ("bag", "plain"))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a.poses.pose, b.poses.pose, atol=1e-6)
        np.testing.assert_allclose(a.pusher.position, b.pusher.position, atol=1e-6)


def test_decimal_commas_are_read_where_another_sign_separates(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("# made by hand\n\ntime;x\n1,5;-2,25\n2;\n")
    content = read_table(file)
    np.testing.assert_array_equal(content.column("time", {}), [1.5, 2.0])
    np.testing.assert_array_equal(content.column("x", {}), [-2.25, np.nan])


def test_motion_capture_poses_become_planar(tmp_path: Path, files: TrackedPoses, records: list[PushRecord]) -> None:
    poses, _ = tracked_rows(records)
    half = 0.5 * poses[:, 3]
    zeros = np.zeros(len(poses))
    full = np.column_stack([poses[:, :3], zeros + 0.03, zeros, zeros, np.sin(half), np.cos(half)])
    mocap = replace(files, poses=table_file(tmp_path / "mocap.csv", "time,x,y,z,qx,qy,qz,qw", full))
    import_tracked_poses(mocap, tmp_path / "mocap")
    import_tracked_poses(files, tmp_path / "planar")
    first, second = (split_pushes(read_bag(tmp_path / name), "1") for name in ("mocap", "planar"))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a.poses.pose[:, :2], b.poses.pose[:, :2], atol=1e-6)
        turned = a.poses.pose[:, 2] - b.poses.pose[:, 2]
        np.testing.assert_allclose(turned - 2 * np.pi * np.round(turned / (2 * np.pi)), 0.0, atol=1e-6)
    lying = np.column_stack([full[:, :4], zeros + np.sqrt(0.5), zeros, zeros, zeros + np.sqrt(0.5)])
    with pytest.raises(BagError, match="tilted by 90 degrees"):
        import_tracked_poses(replace(files, poses=table_file(tmp_path / "lying.csv", "time,x,y,z,qx,qy,qz,qw", lying)), tmp_path / "no")
    long = np.column_stack([full[:, :7], 3.0 + full[:, 7]])
    with pytest.raises(BagError, match="length other than 1"):
        import_tracked_poses(replace(files, poses=table_file(tmp_path / "long.csv", "time,x,y,z,qx,qy,qz,qw", long)), tmp_path / "no")


def test_column_push_separates_pushes_without_a_pause(tmp_path: Path, files: TrackedPoses, records: list[PushRecord]) -> None:
    _, pusher = tracked_rows(records)
    # Between the pushes the pusher travels on at once: no pause anywhere.
    rows, numbers = [], []
    for a, b in zip(range(N), range(1, N + 1), strict=True):
        own = pusher[pusher[:, 3] == a]
        rows.append(own[:, :3])
        numbers += [str(a)] * len(own)
        if b < N:
            there = pusher[pusher[:, 3] == b][0, :3]
            share = np.linspace(0.0, 1.0, 60)[1:-1, None]
            rows.append(own[-1, :3] * (1 - share) + there * share)
            numbers += [""] * 58
    lines = [f"{t:.6f},{x:.6f},{y:.6f},{n}" for (t, x, y), n in zip(np.vstack(rows), numbers, strict=True)]
    file = tmp_path / "numbered.csv"
    file.write_text("\n".join(["time,x,y,push", *lines]) + "\n")
    report = import_tracked_poses(replace(files, pusher=file), tmp_path / "bag")
    assert report.n_pushes == N and report.warnings == ()
    for push, record in zip(split_pushes(read_bag(tmp_path / "bag"), "1"), records, strict=True):
        np.testing.assert_allclose(push.pusher.position, record.pusher.position, atol=1e-6)


def test_lifted_pusher_and_motions_without_contact_are_no_pushes(tmp_path: Path, files: TrackedPoses, records: list[PushRecord]) -> None:
    _, pusher = tracked_rows(records)
    rows = []
    for number in range(N):
        own = pusher[pusher[:, 3] == number]
        lifted = np.column_stack([np.linspace(0.01, 1.0, 50) + own[-1, 0], np.tile(own[-1, 1:3], (50, 1)), np.full(50, 0.2)])
        lifted[:, 1] += np.linspace(0.0, 0.3, 50)  # over the table, not on it
        rows += [np.column_stack([own[:, :3], np.full(len(own), 0.01)]), lifted]
    end = rows[-1][-1, 0]
    stray = np.column_stack([end + np.linspace(1.0, 2.0, 50), 2.0 + np.linspace(0.0, 0.2, 50), np.full(50, 2.0), np.full(50, 0.01)])
    file = table_file(tmp_path / "lifted.csv", "time,x,y,z", np.vstack([*rows, stray]))
    report = import_tracked_poses(replace(files, pusher=file, lifted_above=0.05), tmp_path / "bag")
    assert report.n_pushes == N and report.warnings == ()
    assert any("1 motions" in note for note in report.notes)
    with pytest.raises(BagError, match="no column `z`"):
        import_tracked_poses(replace(files, lifted_above=0.05), tmp_path / "other")


def test_noise_is_measured_at_rest_or_asked_for(tmp_path: Path, files: TrackedPoses, records: list[PushRecord]) -> None:
    import_tracked_poses(replace(files, position_std=None, yaw_std=None), tmp_path / "rest")
    covariance = split_pushes(read_bag(tmp_path / "rest"), "1")[0].poses.covariance[0]
    assert np.sqrt(covariance[0, 0]) == pytest.approx(2e-4, rel=0.3) and np.sqrt(covariance[2, 2]) == pytest.approx(2e-3, rel=0.3)
    poses, _ = tracked_rows(records)
    ends = np.vstack(
        [poses[np.searchsorted(poses[:, 0], [2.0 + k * PERIOD - 0.5, 2.0 + k * PERIOD + 2.0]).clip(0, len(poses) - 1)] for k in range(N)]
    )
    few = replace(files, poses=table_file(tmp_path / "ends.csv", "time,x,y,yaw", ends), position_std=None, yaw_std=None)
    with pytest.raises(InputError, match="--position-std and --yaw-std"):
        import_tracked_poses(few, tmp_path / "no")
    report = import_tracked_poses(replace(few, position_std=1e-3, yaw_std=0.01), tmp_path / "ends")
    assert report.n_pushes == N
    with pytest.raises(InputError, match="positive"):
        import_tracked_poses(replace(files, position_std=0.0), tmp_path / "no")


def test_warns_where_object_and_pusher_do_not_meet(tmp_path: Path, files: TrackedPoses, records: list[PushRecord]) -> None:
    poses, pusher = tracked_rows(records)
    late = table_file(tmp_path / "late.csv", "time,x,y,push", pusher + np.array([0.3, 0.0, 0.0, 0.0]))
    report = import_tracked_poses(replace(files, pusher=late), tmp_path / "late")
    assert "the object moves while the pusher is still up to" in report.warnings[0] and "clocks" in report.warnings[0]
    report = import_tracked_poses(
        replace(files, radius=0.04, pusher=table_file(tmp_path / "n.csv", "time,x,y,push", pusher)), tmp_path / "thick"
    )
    assert "mm inside the outline" in report.warnings[0]
    with pytest.raises(BagError, match="one clock"):
        import_tracked_poses(
            replace(files, poses=table_file(tmp_path / "unix.csv", "time,x,y,yaw", poses + np.array([1.6e9, 0, 0, 0]))), tmp_path / "no"
        )


def test_lost_tracking_is_left_out_and_force_is_kept(tmp_path: Path, files: TrackedPoses) -> None:
    lines = files.poses.read_text().splitlines()
    for k in range(50, 60):
        lines[k] = lines[k].split(",")[0] + ",,,"
    lines.insert(70, lines[69])
    files.poses.write_text("\n".join(lines))
    time = np.arange(2.0, 4.0, 0.01)
    wrench = table_file(tmp_path / "force.csv", "time,fx,fy", np.column_stack([time, 1.0 + 0 * time, 0 * time]))
    report = import_tracked_poses(replace(files, wrench=wrench), tmp_path / "bag")
    assert any("10 of" in note for note in report.notes) and any("repeat a time" in note for note in report.notes)
    pushes = split_pushes(read_bag(tmp_path / "bag"), "1")
    assert pushes[0].wrench is not None and (pushes[0].wrench.force == [1.0, 0.0]).all()
    assert pushes[1].wrench is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is empty"),
        ("\n\n# only a comment\n", "is empty"),
        ("time,x,y,yaw\n", "0 rows"),
        ("time,x,y,yaw\n1,2,3,4\n", "1 rows"),
        ("1,2,3,4\n2,3,4,5\n", "holds numbers"),
        ("words without meaning\nmore words here\n", "no column `time`"),
        ("time,x,y\n1,2,3\n2,3,4\n", "no column `yaw`"),
        ("time,x,x,yaw\n1,2,3,4\n", "two columns"),
        ("time,x,y,yaw\n1,2,3,4\n2,3\n", "line 3: 2 cells"),
        ("time,x,y,yaw\n1,2,3,4\n2,3,four,5\n", "line 3: `four`"),
        ("time,x,y,yaw\n1,nan,3,4\n2,inf,4,5\n3,,4,5\n", "0 rows"),
        ("time,x,y,yaw\n2,0,0,0\n1,0,0,0\n", "line 3: time goes back"),
        ("time,x,y,yaw\n1,2000,0,0\n2,2000,0,0\n", "at most 100 m"),
        ("time,x,y,yaw\n1,0,0,0\n1e12,0,0,0\n", "time-unit"),
        ("time,x,y,yaw\n-1e300,0,0,0\n1,0,0,0\n", "at most"),
        ('time,x,y,yaw\n"1,2,3,4\n', "cells"),
        ('time,x,y,yaw\n"1,2,3,4\n2",3,4,5\n', "quotation mark"),
    ],
)
def test_malformed_tables_end_in_one_line(tmp_path: Path, files: TrackedPoses, text: str, reason: str) -> None:
    files.poses.write_text(text)
    done = run_here(*arguments(files, "--out", tmp_path / "bag"))
    assert done.returncode == 1 and "Traceback" not in done.stderr and done.stderr.count("\n") == 1
    with pytest.raises(PushIdentError, match=reason):
        import_tracked_poses(files, tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_binary_huge_and_missing_files_and_other_options_are_refused(tmp_path: Path, files: TrackedPoses) -> None:
    binary, huge = tmp_path / "binary.csv", tmp_path / "huge.csv"
    binary.write_bytes(b"\xff\xfe\x00\x81" * 100)
    huge.write_text("time,x,y,yaw\n" + "1,2,3,4\n" * 2_200_000)
    points = table_file(tmp_path / "line.csv", "x,y", np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.0]]))
    big = table_file(tmp_path / "big.csv", "x,y", np.array([[0.0, 0.0], [90.0, 0.0], [0.0, 90.0]]))
    for other, reason in (
        (replace(files, poses=binary), "not a text file"),
        (replace(files, poses=huge), "larger than"),
        (replace(files, poses=tmp_path), "cannot be read"),
        (replace(files, poses=tmp_path / "absent.csv"), "cannot be read"),
        (replace(files, outline=points), "encloses|no cell|inside"),
        (replace(files, outline=big), "at most 5 m"),
        (replace(files, cell_size=0.0), "cell size"),
        (replace(files, cell_size=1e-9), "larger cells"),
        (replace(files, cell_size=0.001), "larger cells"),
        (replace(files, radius=-0.01), "radius"),
        (replace(files, radius=float("nan")), "radius"),
        (replace(files, radius=8.0), "radius"),
        (replace(files, object_id="a b"), "Object id"),
        (replace(files, pose_format=TableFormat(length=1e3)), "at most"),
    ):
        with pytest.raises(PushIdentError, match=reason):
            import_tracked_poses(other, tmp_path / "bag")
    for wrong in (("--columns", "x"), ("--columns", "mass=m"), ("--pusher-columns", "x=")):
        done = run_here(*arguments(files, *wrong, "--out", tmp_path / "bag"))
        assert done.returncode == 1 and "ROLE=NAME" in done.stderr
    done = run_here("import", "csv", "--pusher", files.pusher, "--outline", files.outline, "--radius", 0.008, "--out", tmp_path / "bag")
    assert done.returncode == 1 and "poses" in done.stderr
    assert not (tmp_path / "bag").exists()
