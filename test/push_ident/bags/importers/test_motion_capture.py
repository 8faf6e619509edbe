"""Exports of motion capture programs: poses that go out in the form of a program come back, and other forms end in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.commands import check_refused, run_here
from helpers.motion_capture import Body, Writer, motive, qualisys, tracked_bodies, vicon
from push_ident.bags.importers import TrackedPoses
from push_ident.bags.importers.axes import parse_axes, planar_of
from push_ident.bags.importers.motion_capture import read_body
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.errors import BagError
from push_ident.types import Float64Array, PushRecord

N = 30
TIME = 4.0 + 0.01 * np.arange(N)
ROLES = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")


def bodies() -> list[Body]:
    """Two that turn about all axes and are lost at other times."""
    rng = np.random.default_rng(5)
    lost = [np.isin(np.arange(N), frames) for frames in ([0, 7, 8], [20])]
    return [
        Body(name, rng.uniform(-1.0, 1.0, (N, 3)), Rotation.from_rotvec(rng.uniform(-1.5, 1.5, (N, 3))), is_lost.tolist())
        for name, is_lost in zip(("Big box, blue", "Tool 1"), lost, strict=True)
    ]


@pytest.mark.parametrize(
    ("write", "axes"),
    [
        (motive(), "x,-z,y"),
        (motive(length="Millimeters", timecode=True), "x,-z,y"),
        (motive("XYZ", "Centimeters"), "x,-z,y"),
        (motive("ZYX"), "x,-z,y"),
        (vicon(), "x,y,z"),
        (vicon("deg", "cm", title="Segments", prefix="Global Angle "), "x,y,z"),
        (vicon("quaternion", "m"), "x,y,z"),
        (vicon("quaternion", empty=False), "x,y,z"),
        (qualisys(), "x,y,z"),
        (qualisys(empty=True), "x,y,z"),
    ],
)
def test_poses_come_back_in_metres_and_lost_frames_have_none(tmp_path: Path, write: Writer, axes: str) -> None:
    file = write(tmp_path / "export.csv", TIME, bodies())
    for body in bodies():
        table = read_body(Path(f"{file}#{body.name}"))
        rows = np.column_stack([table.column(role, {}) for role in ROLES])
        assert table.axes == axes and table.unit("x", {}) == 1.0
        np.testing.assert_allclose(rows[:, 0], TIME, atol=1e-6)
        np.testing.assert_array_equal(np.isnan(rows[:, 1:]).all(axis=1), body.is_lost)
        tracked = ~np.array(body.is_lost)
        np.testing.assert_allclose(rows[tracked, 1:4], body.position[tracked], atol=1e-5)
        between = body.attitude[tracked].inv() * Rotation.from_quat(rows[tracked, 4:])
        assert between.magnitude().max() < 1e-4


def test_body_is_named_where_a_file_has_several(tmp_path: Path) -> None:
    one, two = tmp_path / "a#1.csv", tmp_path / "two.csv"
    motive()(one, TIME, bodies()[:1])
    motive()(two, TIME, bodies())
    assert read_body(one).column("x", {})[1] == pytest.approx(bodies()[0].position[1, 0], abs=1e-5)
    read_body(Path(f"{one}#Big box, blue"))
    for name, reason in (
        (f"{two}", "2 bodies, expected one of Big box, blue, Tool 1"),
        (f"{two}#Tool", "no body `Tool`.*'two.csv#Big box"),
    ):
        with pytest.raises(BagError, match=reason):
            read_body(Path(name))
    table = tmp_path / "table.csv"
    table.write_text("time,x,y\n1,2,3\n")
    with pytest.raises(BagError, match="leave #Tool out"):
        read_body(Path(f"{table}#Tool"))
    with pytest.raises(BagError, match="cannot be read"):
        read_body(tmp_path / "absent.csv#Tool")


def test_euler_angles_of_a_flat_body_give_the_yaw_of_a_rotation_vector(tmp_path: Path) -> None:
    """Vicon does not say which of both it wrote."""
    yaw, around = np.linspace(-3.0, 3.0, N), np.linspace(0.0, 20.0, N)
    tilt = np.radians(2.0) * np.column_stack([np.cos(around), np.sin(around), 0.0 * around])
    attitude = Rotation.from_rotvec(tilt) * Rotation.from_rotvec(np.column_stack([0.0 * yaw, 0.0 * yaw, yaw]))
    file = vicon("euler")(tmp_path / "v.csv", TIME, [Body("box", np.zeros((N, 3)), attitude, [False] * N)])
    table = read_body(file)
    found = planar_of(np.column_stack([table.column(role, {}) for role in ROLES[4:]]), parse_axes(table.axes, ""), "v.csv", [])
    np.testing.assert_allclose(found, yaw, atol=np.radians(0.1))


def changed(write: Writer, old: str, new: str) -> Callable[[Path], None]:
    def make(file: Path) -> None:
        text = write(file, TIME, bodies()).read_text()
        assert old in text
        file.write_text(text.replace(old, new))

    return make


def shown(text: str) -> Callable[[Path], None]:
    return lambda file: file.write_text(text) and None


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (changed(motive(), "Rotation Type,Quaternion", "Rotation Type,Matrix"), "Rotation Type of Motive is `Matrix`"),
        (changed(motive(), "Length Units,Meters", "Length Units,Inches"), "Length Units of Motive is `Inches`"),
        (changed(motive(), "Space,Global", "Space,Local"), "Coordinate Space of Motive is `Local`"),
        (changed(motive(), "Rigid Body", "Bone"), "header and rigid bodies"),
        (changed(motive(), "Rotation Type,Quaternion", "Rotation Type,XYX"), "`XYX`"),
        (shown("Frame,Time (Seconds),X,Y,Z,W,X,Y,Z\n1,0,0,0,0,1,0,0,0\n"), "Motive without a head"),
        (shown("Format Version,1.23\n"), "Motive without a head"),
        (changed(vicon(), "rad,rad", "grad,grad"), "unit of RX of Vicon is `grad`|unit of RY of Vicon is `grad`"),
        (changed(vicon(), "mm,mm,mm", "ft,ft,ft"), "unit of TX of Vicon is `ft`"),
        (changed(vicon(), "\n100", "\nfast"), "rate of Vicon is `fast`"),
        (changed(vicon(title="Joints"), "Joints", "Joints"), "Vicon with Joints, Trajectories, expected Objects or Segments"),
        (shown("Trajectories\n100\n,,a:m1,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n1,0,1,2,3\n"), "Vicon with Trajectories, expected"),
        (shown("Objects\n100\n,,a\n"), "cut off"),
        (changed(qualisys(), "Rot[0]", "Rot"), "QTM with 6D, expected 6D with"),
        (changed(qualisys(), "Time", "Seconds"), "no column Time"),
        (changed(qualisys(), "Tool 1 X", "Tool X"), "columns of Tool 1"),
        (changed(qualisys(), "\tTool 1\n", "\n"), "2 bodies"),
        (shown("NO_OF_FRAMES\t2\nDATA_INCLUDED\t3D\nMARKER_NAMES\ta\na X\ta Y\ta Z\n1\t2\t3\n"), "QTM with 3D, expected 6D"),
        (changed(motive(), "4.010000", "four"), "line 10: `four` in column `time`"),
        (changed(qualisys(), "BODY_NAMES", "NAMES"), "6DOF"),
    ],
)
def test_other_forms_end_in_one_line(tmp_path: Path, make: Callable[[Path], None], reason: str) -> None:
    file = tmp_path / "export.csv"
    make(file)
    with pytest.raises(BagError, match=reason) as refused:
        read_body(Path(f"{file}#Tool 1"))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("write", "up", "options"),
    [
        (motive(length="Millimeters"), "x,-z,y", ()),
        (motive("XYZ"), "x,y,z", ("--axes", "x,y,z")),  # an export with z up: the pusher follows
        (vicon("deg", empty=False), "x,y,z", ("--length-unit", "m")),
        (qualisys(), "x,y,z", ()),
    ],
    ids=["motive", "motive z up", "vicon", "qualisys"],
)
def test_export_becomes_a_bag_of_its_pushes(
    tmp_path: Path,
    tables: TrackedPoses,
    rows: tuple[Float64Array, Float64Array],
    pushed: list[PushRecord],
    write: Writer,
    up: str,
    options: tuple[str, ...],
) -> None:
    file = write(tmp_path / "take.csv", *tracked_bodies(rows, up))
    of_object = ("import", "csv", f"{file}#My box", "--outline", tables.outline, "--radius", 0.008, "--cell-size", 0.011)
    given = (*of_object, "--pusher", f"{file}#Tool", "--position-std", 2e-4, "--yaw-std", 2e-3, *options)
    done = run_here(*given, "--out", tmp_path / "bag", "--json", tmp_path / "r.json")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["n_pushes"] == len(pushed) and report["warnings"] == []
    assert any(note.startswith("take.csv#My box: ") and "left out" in note for note in report["notes"]), report["notes"]
    for push, record in zip(split_pushes(read_bag(tmp_path / "bag"), "1"), pushed, strict=True):
        np.testing.assert_allclose(push.poses.pose[[0, -1], :2], record.poses.pose[[0, -1], :2], atol=3e-3)
    check_refused("2 bodies", *of_object, "--pusher", file, *options, "--out", tmp_path / "no")
