"""Wrong units, axes, clock or frame of an imported recording are found from the contact of pusher and object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.commands import run_here
from helpers.objects import hammer, random_records
from helpers.recordings import table_file, tracked_rows
from push_ident.bags.importers import ImportReport, TrackedPoses, import_tracked_poses
from push_ident.bags.importers.axes import parse_axes
from push_ident.bags.importers.recording import OverlapError
from push_ident.errors import BagError, InputError
from push_ident.types import Float64Array, PushRecord

Rows = tuple[Float64Array, Float64Array]
Change = Callable[[Float64Array], Float64Array]
WithPusher = Callable[[Float64Array], TrackedPoses]


@pytest.fixture
def with_pusher(tmp_path: Path, tables: TrackedPoses) -> WithPusher:
    """The tables with other rows of the pusher."""
    return lambda rows: replace(tables, pusher=table_file(tmp_path / "changed.csv", "time,x,y,push", rows))


def fits(report: ImportReport) -> bool:
    return report.overlap is not None and report.overlap.fits and report.overlap.causes == () and report.warnings == ()


def explained(report: ImportReport) -> str:
    assert report.overlap is not None and report.overlap.causes and not report.overlap.fits
    return report.overlap.causes[0].text


def in_frame(pusher: Float64Array, x: float, y: float, yaw: float) -> Float64Array:
    """Rows of the pusher as a robot has them whose base lies there."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.column_stack([pusher[:, 0], (pusher[:, 1:3] - [x, y]) @ np.array([[cosine, -sine], [sine, cosine]]), pusher[:, 3]])


@pytest.mark.parametrize(
    ("change", "option", "mended"),
    [
        (lambda rows: rows, "", {}),
        (lambda rows: rows + np.array([0.3, 0, 0, 0]), "", {"time_offset": -0.3}),
        (lambda rows: rows[:, [0, 2, 1, 3]] * [1, -1, 1, 1], "--pusher-axes y,-x,z", {"pusher_axes": parse_axes("y,-x,z", "")}),
        (lambda rows: rows * [1, 1, -1, 1], "--pusher-axes x,-y,-z", None),  # needs heights
        (lambda rows: rows * [1, 100, 100, 1], "--pusher-length-unit", None),
        (lambda rows: in_frame(rows, 0.5, -0.2, 0.4), "--pusher-frame", {"pusher_frame": np.array([0.5, -0.2, 0.4])}),
    ],
    ids=["right", "clock", "exchanged axes", "mirrored axis", "unit", "frame"],
)
def test_what_keeps_pusher_and_object_apart_is_named_with_the_option_that_mends_it(
    tmp_path: Path, rows: Rows, with_pusher: WithPusher, change: Change, option: str, mended: dict[str, Any] | None
) -> None:
    tables = with_pusher(change(rows[1]))
    if option:
        text = explained(import_tracked_poses(tables, tmp_path / "bag"))
        assert option in text
        if option == "--pusher-frame":
            frame = [float(part) for part in text.split(option)[1].split()[0].split(",")]
            np.testing.assert_allclose(frame, [0.5, -0.2, 0.4], atol=0.02)
    if mended is not None:
        assert fits(import_tracked_poses(replace(tables, **mended), tmp_path / "mended"))


def test_clocks_that_differ_are_named_with_the_offset(tmp_path: Path, rows: Rows, with_pusher: WithPusher) -> None:
    late = with_pusher(rows[1] + np.array([0.3, 0.0, 0.0, 0.0]))
    report = import_tracked_poses(late, tmp_path / "bag")
    found = [cause.text for cause in report.overlap.causes if "clock" in cause.text] if report.overlap else []
    assert found and abs(float(found[0].split("add ")[1].split()[0]) + 0.3) < 0.05
    late.pusher.write_text("time,x,y,push\n" + "\n".join(f"{t + 1.6e9:.4f},{x:.6f},{y:.6f},{n:.0f}" for t, x, y, n in rows[1]) + "\n")
    with pytest.raises(BagError, match="one clock.*--time-offset -1600000000"):
        import_tracked_poses(late, tmp_path / "no")


def test_an_outline_about_another_origin_is_named(tmp_path: Path, tables: TrackedPoses, pushed: list[PushRecord]) -> None:
    outline = table_file(tmp_path / "corner.csv", "x,y", pushed[0].shape.outline + np.array([0.03, 0.02]))
    text = explained(import_tracked_poses(replace(tables, outline=outline), tmp_path / "bag"))
    assert text.startswith("the origin of the outline")
    shift = [float(part) for part in text.split("(")[1].split(")")[0].split(",")]
    np.testing.assert_allclose(shift, [-0.03, -0.02], atol=3e-3)


def test_a_pusher_far_from_the_object_ends_in_an_error_and_a_page(tmp_path: Path, tables: TrackedPoses, rows: Rows) -> None:
    still = table_file(tmp_path / "still.csv", "time,x,y,yaw", rows[0] * [1, 0, 0, 0] + [0, 50.0, 50.0, 0])
    far = table_file(tmp_path / "far.csv", "time,x,y", rows[1][:, :3] * [1, 1e2, 1e2])
    given = ("--pusher", far, "--outline", tables.outline, "--radius", 0.008, "--position-std", 2e-4, "--yaw-std", 2e-3)
    done = run_here("import", "csv", still, *given, "--out", tmp_path / "bag")
    assert done.returncode == 1 and "no push in it" in done.stderr and not (tmp_path / "bag").exists()
    assert "No bag was written" in (tmp_path / "bag_import.html").read_text()
    with pytest.raises(OverlapError):
        import_tracked_poses(replace(tables, poses=still, pusher=far), tmp_path / "bag")


def test_units_in_the_names_of_columns_are_understood(tmp_path: Path, tables: TrackedPoses, rows: Rows, pushed: list[PushRecord]) -> None:
    named = replace(
        tables,
        poses=table_file(tmp_path / "p.csv", "Timestamp (ms),Pos_X_mm,Pos_Y_mm,theta [deg]", rows[0] * [1e3, 1e3, 1e3, 180 / np.pi]),
        pusher=table_file(tmp_path / "t.csv", "t_ms,x_cm,y_cm,push", rows[1] * [1e3, 1e2, 1e2, 1]),
        outline=table_file(tmp_path / "o.csv", "x [mm],y [mm]", 1e3 * pushed[0].shape.outline),
    )
    assert fits(import_tracked_poses(named, tmp_path / "bag"))


def test_motion_capture_with_y_up_becomes_the_table_frame(tmp_path: Path, tables: TrackedPoses, rows: Rows) -> None:
    poses, pusher = rows
    zeros, half = np.zeros(len(poses)), 0.5 * poses[:, 3]
    # Table x is x, table y is -z, up is y.
    up = np.column_stack([poses[:, 0], poses[:, 1], zeros + 0.03, -poses[:, 2], zeros, np.sin(half), zeros, np.cos(half)])
    tool = np.column_stack([pusher[:, :2], np.full(len(pusher), 0.02), -pusher[:, 2], pusher[:, 3]])
    mocap = replace(
        tables,
        poses=table_file(tmp_path / "m.csv", "time,x,y,z,qx,qy,qz,qw", up),
        pusher=table_file(tmp_path / "t.csv", "time,x,y,z,push", tool),
        axes=parse_axes("x,-z,y", "--axes"),  # of the pusher, too
    )
    report = import_tracked_poses(mocap, tmp_path / "bag")
    assert fits(report) and report.n_pushes == 6
    turned = replace(mocap, pusher_axes=parse_axes("-z,-x,y", "--pusher-axes"))
    assert "--pusher-axes x,-z,y" in explained(import_tracked_poses(turned, tmp_path / "turned"))
    with pytest.raises(BagError, match="no column `z`"):
        import_tracked_poses(replace(tables, axes=mocap.axes), tmp_path / "no")
    for text, reason in (("x,y", "in the order"), ("x,x,z", "in the order"), ("y,x,z", "mirror")):
        with pytest.raises(InputError, match=reason):
            parse_axes(text, "--axes")
    for quaternion, reason in (([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], "tilted by 90 degrees"), ([0, 0, 0, 3.0], "length other than 1")):
        wrong = table_file(mocap.poses, "time,x,y,z,qx,qy,qz,qw", np.column_stack([up[:, :4], np.tile(quaternion, (len(up), 1))]))
        with pytest.raises(BagError, match=reason):
            import_tracked_poses(replace(tables, poses=wrong), tmp_path / "no")


def test_noise_of_a_camera_is_no_motion_before_the_pusher_comes(tmp_path: Path, tables: TrackedPoses) -> None:
    poses, pusher = tracked_rows(random_records(hammer(3), 6, 3))
    noisy = replace(
        tables,
        poses=table_file(tmp_path / "p.csv", "time,x,y,yaw", poses),
        pusher=table_file(tmp_path / "t.csv", "time,x,y,push", pusher),
        position_std=1e-3,
        yaw_std=8.7e-3,
    )
    report = import_tracked_poses(noisy, tmp_path / "bag")
    assert report.warnings == () and np.abs(report.contact_distance).max() < 6e-3
