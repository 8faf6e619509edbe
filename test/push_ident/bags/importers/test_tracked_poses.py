"""Tables of tracked poses: what goes out as CSV comes back from the bag."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.commands import check_refused, run_here
from helpers.recordings import PERIOD, table_file
from push_ident.bags.importers import TableFormat, TrackedPoses, import_tracked_poses
from push_ident.bags.importers.recording import without_lost
from push_ident.bags.importers.tables import read_table
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.errors import BagError, InputError, PushIdentError
from push_ident.types import Float64Array, PushRecord

N = 6
Rows = tuple[Float64Array, Float64Array]


@pytest.fixture
def files(tmp_path: Path, tables: TrackedPoses, rows: Rows) -> TrackedPoses:
    """Without numbers of the pushes: pauses separate them."""
    return replace(tables, pusher=table_file(tmp_path / "pauses.csv", "time,x,y", rows[1][:, :3]))


def arguments(files: TrackedPoses, *more: object) -> list[object]:
    return ["import", "csv", files.poses, "--pusher", files.pusher, "--outline", files.outline, "--radius", files.radius, *more]


def test_tables_come_back_from_the_bag(tmp_path: Path, files: TrackedPoses, pushed: list[PushRecord]) -> None:
    done = run_here(*arguments(files, "--object", "hammer", "--out", tmp_path / "bag", "--json", tmp_path / "r.json"))
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["n_pushes"] == N and report["warnings"] == [] and report["mass"] is None and report["supports_m"] == []
    assert np.abs(report["contact_distance_m"]).max() < 2e-3
    for push, record in zip(split_pushes(read_bag(tmp_path / "bag"), "hammer"), pushed, strict=True):
        np.testing.assert_allclose(push.shape.outline, record.shape.outline, atol=1e-6)
        assert push.pusher.radius == 0.008
        # The pusher stands at both ends of the record; the poses have some of the rest around it.
        np.testing.assert_allclose(push.pusher.position[[0, -1]], record.pusher.position[[0, -1]], atol=1e-3)
        np.testing.assert_allclose(push.poses.pose[[0, -1], :2], record.poses.pose[[0, -1], :2], atol=2e-3)
        assert len(push.poses.time) > len(record.poses.time) / 2
        assert np.sqrt(push.poses.covariance[0, 0, 0]) == pytest.approx(2e-4, rel=0.3)
    given = (
        "--object",
        files.poses,
        "--pusher",
        files.pusher,
        "--outline",
        files.outline,
        "--radius",
        "8mm",
        "--pusher-frame",
        "0mm,0,0deg",
    )
    assert run_here("import", "csv", *given, "--out", tmp_path / "other").returncode == 0  # `--object` may be the file
    assert len(split_pushes(read_bag(tmp_path / "other"), "1")) == N


def test_names_and_units_of_other_programs(tmp_path: Path, files: TrackedPoses, rows: Rows, pushed: list[PushRecord]) -> None:
    other = replace(
        files,
        poses=table_file(tmp_path / "p.csv", "Stamp,PX,PY,Heading", rows[0] * [1e3, 1e3, 1e3, 180.0 / np.pi], separator=";"),
        pusher=table_file(tmp_path / "t.csv", "Stamp,X,Y", rows[1][:, :3] * 1e3, separator="\t"),
        outline=table_file(tmp_path / "o.csv", "x,y", 1e3 * pushed[0].shape.outline, separator=" "),
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
    for text in ("# made by hand\n\ntime;x\n1,5;-2,25\n2;\n", "sep=|\ntime|x\n1,5|-2,25\n2|\n", '"sep=\t"\ntime\tx\n1.5\t-2.25\n2\t\n'):
        (tmp_path / "a.csv").write_text(text)
        content = read_table(tmp_path / "a.csv")
        np.testing.assert_array_equal(content.column("time", {}), [1.5, 2.0])
        np.testing.assert_array_equal(content.column("x", {}), [-2.25, np.nan])


def test_column_push_separates_pushes_without_a_pause(tmp_path: Path, files: TrackedPoses, rows: Rows, pushed: list[PushRecord]) -> None:
    lines = ["time,x,y,push"]
    parts = [rows[1][rows[1][:, 3] == number] for number in range(N)]
    for part, following in zip(parts, [*parts[1:], None], strict=True):
        lines += [f"{t:.6f},{x:.6f},{y:.6f},{n:.0f}" for t, x, y, n in part]
        if following is not None:  # the pusher travels on at once
            share = np.linspace(0.0, 1.0, 60)[1:-1, None]
            lines += [f"{t:.6f},{x:.6f},{y:.6f}," for t, x, y in part[-1, :3] * (1 - share) + following[0, :3] * share]
    file = tmp_path / "numbered.csv"
    file.write_text("\n".join(lines) + "\n")
    report = import_tracked_poses(replace(files, pusher=file), tmp_path / "bag")
    assert report.n_pushes == N and report.warnings == ()
    for push, record in zip(split_pushes(read_bag(tmp_path / "bag"), "1"), pushed, strict=True):
        np.testing.assert_allclose(push.pusher.position, record.pusher.position, atol=1e-6)


def test_lifted_pusher_and_motions_without_contact_are_no_pushes(tmp_path: Path, files: TrackedPoses, rows: Rows) -> None:
    motions = []
    for number in range(N):
        part = rows[1][rows[1][:, 3] == number]
        lifted = np.column_stack([np.linspace(0.01, 1.0, 50) + part[-1, 0], np.tile(part[-1, 1:3], (50, 1)), np.full(50, 0.2)])
        lifted[:, 1] += np.linspace(0.0, 0.3, 50)  # over the table, not on it
        motions += [np.column_stack([part[:, :3], np.full(len(part), 0.01)]), lifted]
    end = motions[-1][-1, 0]
    motions.append(np.column_stack([end + np.linspace(1.0, 2.0, 50), 2.0 + np.linspace(0.0, 0.2, 50), np.full(50, 2.0), np.full(50, 0.01)]))
    file = table_file(tmp_path / "lifted.csv", "time,x,y,z", np.vstack(motions))
    report = import_tracked_poses(replace(files, pusher=file, lifted_above=0.05), tmp_path / "bag")
    assert report.n_pushes == N and report.warnings == ()
    assert any("1 motions" in note for note in report.notes)
    with pytest.raises(BagError, match="no column `z`"):
        import_tracked_poses(replace(files, lifted_above=0.05), tmp_path / "other")


def test_noise_is_measured_at_rest_or_asked_for(tmp_path: Path, files: TrackedPoses, rows: Rows) -> None:
    import_tracked_poses(replace(files, position_std=None, yaw_std=None), tmp_path / "rest")
    covariance = split_pushes(read_bag(tmp_path / "rest"), "1")[0].poses.covariance[0]
    assert np.sqrt(covariance[0, 0]) == pytest.approx(2e-4, rel=0.3) and np.sqrt(covariance[2, 2]) == pytest.approx(2e-3, rel=0.3)
    time = rows[0][:, 0]
    ends = [rows[0][np.searchsorted(time, [2.0 + k * PERIOD - 0.5, 2.0 + k * PERIOD + 2.0]).clip(0, len(time) - 1)] for k in range(N)]
    few = replace(files, poses=table_file(tmp_path / "e.csv", "time,x,y,yaw", np.vstack(ends)), position_std=None, yaw_std=None)
    with pytest.raises(InputError, match="--position-std and --yaw-std"):
        import_tracked_poses(few, tmp_path / "no")
    assert import_tracked_poses(replace(few, position_std=1e-3, yaw_std=0.01), tmp_path / "ends").n_pushes == N


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


def test_malformed_tables_end_in_one_line(tmp_path: Path, files: TrackedPoses) -> None:
    for text, reason in (
        ("\n\n# only a comment\n", "is empty"),
        ("time,x,y,yaw\n1,2,3,4\n", "1 rows"),
        ("1,2,3,4\n2,3,4,5\n", "holds numbers"),
        ("sep=;\n", "is empty"),
        ("time,x,x,yaw\n1,2,3,4\n", "two columns"),
        ("time,x,y,yaw\n1,2,3,4\n2,3\n", "line 3: 2 cells"),
        ("time,x,y,yaw\n1,2,3,4\n2,3,four,5\n", "line 3: `four`"),
        ("time,x,y,yaw\n1,nan,3,4\n2,inf,4,5\n3,,4,5\n", "0 rows"),
        ("time,x,y,yaw\n9,0,0,0\n1,0,0,0\n", "line 3: time goes back"),
        ("time,x,y,yaw\n1,2000,0,0\n2,2000,0,0\n", "at most 100 m"),
        ("time,x,y,yaw\n1,0,0,0\n1e12,0,0,0\n", "time-unit"),
        ('time,x,y,yaw\n"1,2,3,4\n2",3,4,5\n', "quotation mark"),
    ):
        files.poses.write_text(text)
        with pytest.raises(PushIdentError, match=reason) as refused:
            import_tracked_poses(files, tmp_path / "bag")
        assert "\n" not in str(refused.value)
    check_refused("quotation mark", *arguments(files, "--out", tmp_path / "bag"))
    assert not (tmp_path / "bag").exists()


def test_binary_huge_and_missing_files_and_other_options_are_refused(tmp_path: Path, files: TrackedPoses) -> None:
    binary, huge = tmp_path / "binary.csv", tmp_path / "huge.csv"
    binary.write_bytes(b"\xff\xfe\x00\x81" * 100)
    with huge.open("w") as sparse:
        sparse.truncate(17_000_000)
    line = table_file(tmp_path / "line.csv", "x,y", np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.0]]))
    big = table_file(tmp_path / "big.csv", "x,y", np.array([[0.0, 0.0], [90.0, 0.0], [0.0, 90.0]]))
    for other, reason in (
        ({"poses": binary}, "not a text file"),
        ({"poses": huge}, "larger than"),
        ({"poses": tmp_path / "absent.csv"}, "cannot be read"),
        ({"outline": line}, "encloses|no cell|inside"),
        ({"outline": big}, "at most 5 m"),
        ({"cell_size": 0.0}, "cell size"),
        ({"cell_size": 0.001}, "larger cells"),
        ({"radius": 8.0}, "radius"),
        ({"position_std": 0.0}, "positive"),
        ({"object_id": "a b"}, "Object id"),
        ({"pose_format": TableFormat(length=1e3)}, "at most"),
    ):
        with pytest.raises(PushIdentError, match=reason):
            import_tracked_poses(replace(files, **other), tmp_path / "bag")  # type: ignore[arg-type]
    for wrong in (("--columns", "x"), ("--columns", "mass=m"), ("--pusher-columns", "x=")):
        check_refused("ROLE=NAME", *arguments(files, *wrong, "--out", tmp_path / "bag"))
    no_poses = ("--pusher", files.pusher, "--outline", files.outline, "--radius", 0.008)
    check_refused("poses", "import", "csv", *no_poses, "--out", tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_zeros_are_lost_tracking_where_a_body_jumps_there_and_a_place_where_it_starts() -> None:
    rows = np.column_stack([np.arange(20.0), np.linspace(0.3, 0.4, 20), np.full(20, 0.2), np.zeros(20)])
    lost = np.where(np.isin(np.arange(20), [4, 5, 11])[:, None] & (np.arange(4) > 0), 0.0, rows)
    notes: list[str] = []
    assert np.flatnonzero(np.isnan(without_lost(lost, "poses.csv", notes)).any(axis=1)).tolist() == [4, 5, 11]
    assert notes == ["poses.csv: tracking was lost in 3 of 20 rows, which are zero"]
    starts = np.column_stack([np.arange(20.0), np.maximum(np.arange(20) - 5, 0) * 0.005, np.zeros(20), np.zeros(20)])
    np.testing.assert_array_equal(without_lost(starts, "poses.csv", notes), starts)
    tracked = np.column_stack([np.arange(3.0), np.zeros((3, 3)), [[0, 0, 0, 1.0], [0, 0, 0, 0.0], [0, 0, 0, 1.0]]])
    assert np.flatnonzero(np.isnan(without_lost(tracked, "poses.csv", notes)).any(axis=1)).tolist() == [1]
