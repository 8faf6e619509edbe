"""Recordings of CMU: the geometry of the import is checked against contact and friction, which fix every sign in it."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from rosbags import rosbag1

from helpers.commands import check_refused, run_here
from helpers.paths import recording
from helpers.recordings import icra16_file
from push_ident.bags.importers import ImportReport, MocapObject, import_cmu_icra16, import_cmu_mocap
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.errors import BagError, InputError
from push_ident.geometry.outline import points_in_polygon, signed_distance
from push_ident.geometry.se2 import inverse, rotation, transform_points
from push_ident.types import PushRecord

Imported = tuple[ImportReport, list[PushRecord]]
MOCAP = "cmu_mocap/robot_multi_push_3out_3.bag"


def pushes_of(report: ImportReport) -> Imported:
    return report, split_pushes(read_bag(report.bag), "1")


@pytest.fixture(scope="module")
def icra16(tmp_path_factory: pytest.TempPathFactory) -> Imported:
    file = recording("cmu_icra16/30_90_30_30_30_90__exp_08_11_30.txt")
    return pushes_of(import_cmu_icra16(file, tmp_path_factory.mktemp("icra16") / "bag"))


@pytest.fixture(scope="module")
def mocap(tmp_path_factory: pytest.TempPathFactory) -> Imported:
    return pushes_of(import_cmu_mocap(recording(MOCAP), tmp_path_factory.mktemp("mocap") / "bag"))


def inward_normal(record: PushRecord, frame: int) -> np.ndarray:
    """Of the outline edge nearest to the pusher at the last sample, table frame."""
    outline = transform_points(record.poses.pose[frame], record.shape.outline)
    edge = np.roll(outline, -1, axis=0) - outline
    inward = np.column_stack([-edge[:, 1], edge[:, 0]]) / np.linalg.norm(edge, axis=1)[:, None]
    depth = np.sum((record.pusher.position[-1] - outline) * inward, axis=1)
    return inward[np.argmin(depth)]


def test_icra16_gives_thirty_pushes_known_at_their_ends(icra16: Imported) -> None:
    report, pushes = icra16
    assert report.n_pushes == len(pushes) == 30
    assert {len(push.poses.time) for push in pushes} == {2}
    assert 100 <= len(pushes[0].shape.cells) <= 130 and pushes[0].pusher.radius == 0.0
    for push in pushes:
        assert np.linalg.norm(push.pusher.position[-1] - push.pusher.position[0]) == pytest.approx(0.0163, abs=3e-4)
        assert push.poses.time[-1] - push.poses.time[0] == pytest.approx(6.65, abs=0.1)
    # The mean motion of all cells that the recording's description states.
    moved = [np.linalg.norm(np.diff(transform_points(p.poses.pose, p.shape.cells.centres), axis=0), axis=2).mean() for p in pushes]
    assert np.mean(moved) == pytest.approx(8.2e-3, rel=0.1)
    np.testing.assert_allclose(report.centre_of_mass, pushes[0].shape.outline.mean(axis=0))
    assert points_in_polygon(report.supports, pushes[0].shape.outline).all()


def test_icra16_pusher_touches_the_outline_when_force_sets_in_and_force_stays_in_a_friction_cone(icra16: Imported) -> None:
    report, pushes = icra16
    start = [signed_distance(transform_points(inverse(p.poses.pose[0]), p.pusher.position[:1]), p.shape.outline)[0] for p in pushes]
    assert min(start) > 1.3e-3 and max(start) < 2.7e-3
    assert np.sqrt(np.mean(report.contact_distance**2)) < 1.3e-3 and np.abs(report.contact_distance).max() < 2.1e-3
    for push in pushes:
        assert push.wrench is not None
        assert np.linalg.norm(push.wrench.force[:20].mean(axis=0)) < 5e-3  # bias removed
        force = push.wrench.force[-60:].mean(axis=0)
        along, across = rotation(-np.arctan2(*inward_normal(push, -1)[::-1])) @ force
        assert along > 1.0 and abs(across / along) < np.tan(np.radians(35))


def test_mocap_is_cut_into_its_pushes_with_every_pose_kept_and_the_pusher_at_the_outline_in_contact(mocap: Imported) -> None:
    report, pushes = mocap
    assert report.n_pushes == len(pushes) == 5 and report.supports.shape == (3, 2) and report.warnings == ()
    contents = read_bag(report.bag)
    # Pauses between pushes may be too short to tell them apart: each has its record.
    assert contents.topics["/objects/1/pose"] == 4996 and len(contents.push_intervals) == 5
    assert np.abs(report.contact_distance).max() < 2e-3
    for push in pushes:
        assert np.median(np.diff(push.poses.time)) == pytest.approx(1 / 60, rel=0.01)
        assert push.poses.time[0] <= push.pusher.time[0] and push.poses.time[-1] >= push.pusher.time[-1]
        # All pushes are against the hypotenuse, the edge after the leg along x.
        start, end = transform_points(push.poses.pose[-1], push.shape.outline)[1:]
        travel = push.pusher.position[-1] - push.pusher.position[0]
        across = rotation(np.pi / 2) @ (end - start)
        assert across @ travel > 0.4 * np.linalg.norm(across) * np.linalg.norm(travel)
    turned = [push.poses.pose[-20:, 2].mean() - push.poses.pose[:20, 2].mean() for push in pushes]
    assert np.degrees(max(turned)) == pytest.approx(10.7, abs=0.5)
    assert 45 <= len(pushes[0].shape.cells) <= 55


def test_mocap_refuses_bags_without_its_topics_and_poses_without_a_rotation(tmp_path: Path, mocap: Imported) -> None:
    with pytest.raises(BagError, match="/Mocap"):
        import_cmu_mocap(mocap[0].bag, tmp_path / "bag")
    with (
        rosbag1.Reader(recording(MOCAP)) as source,
        rosbag1.Writer(tmp_path / "zero.bag") as target,
    ):
        links = {c.id: target.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest) for c in source.connections}
        for connection, stamp, data in islice(source.messages(), 2000):
            if connection.topic == "/Mocap":
                turn = 52 + int.from_bytes(data[12:16], "little")  # behind header, number, count and position
                data = data[:turn] + bytes(32) + data[turn + 32 :]
            target.write(links[connection.id], stamp, data)
    with pytest.raises(BagError, match="no messages of /Mocap;"):
        import_cmu_mocap(tmp_path / "zero.bag", tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("name", "surface", "supports"),
    [
        ("10_90_10_10_30_130/exp.txt", "hardboard", [[0.01, 0.01], [0.09, 0.03], [0.01, 0.13]]),
        ("wood_30_63.33_43.33_30_43.33_63.33/exp_1.txt", "wood", [[0.03, 0.03], [0.06333, 0.04333], [0.04333, 0.06333]]),
        ("30_90_30_30_30_90__exp.txt", "hardboard", [[0.03, 0.03], [0.09, 0.03], [0.03, 0.09]]),
        ("patch/exp.txt", "hardboard", np.zeros((0, 2))),
    ],
)
def test_icra16_reads_surface_and_supports_from_the_published_names(
    tmp_path: Path, name: str, surface: str, supports: list[list[float]]
) -> None:
    report = import_cmu_icra16(icra16_file(tmp_path / name), tmp_path / "bag")
    assert report.surface == surface and report.warnings == ()
    np.testing.assert_allclose(report.supports, supports, atol=1e-12)


def test_icra16_takes_supports_that_the_user_knows_and_refuses_those_outside(tmp_path: Path) -> None:
    command = ("import", "cmu-icra16", icra16_file(tmp_path / "copied" / "exp.txt"), "--json", tmp_path / "r.json", "--out")
    done = run_here(*command, tmp_path / "without")
    assert done.returncode == 0 and "--supports" in done.stdout, done.stderr
    assert json.loads((tmp_path / "r.json").read_text())["surface"] is None
    done = run_here(*command, tmp_path / "bag", "--supports", "0.02,0.02", "100mm,2cm", "0.02,0.1")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "r.json").read_text())
    assert content["supports_m"] == [[0.02, 0.02], [0.1, 0.02], [0.02, 0.1]] and content["n_pushes"] == 2 and content["mass"] == 1.518
    np.testing.assert_allclose(content["contact_distance_m"], [0.0, 0.0], atol=5e-4)
    push, _ = split_pushes(read_bag(tmp_path / "bag"), "1")
    assert push.wrench is not None
    np.testing.assert_allclose(push.wrench.force[-1], [4.0, 0.0], atol=1e-3)
    for wrong, reason in (
        (("2,2", "3,2", "2,3"), "outside the object"),
        (("20,20", "100,20", "20,100"), "20mm is 0.02 m"),
        (("1", "2", "3"), "three points"),
    ):
        check_refused(reason, *command, tmp_path / "other", "--supports", *wrong)
    assert not (tmp_path / "other").exists()


def test_icra16_notes_what_is_broken_off_and_warns_of_another_tool_and_of_pushes_without_contact(tmp_path: Path) -> None:
    report = import_cmu_icra16(icra16_file(tmp_path / "patch" / "exp.txt", announced=30, n=3), tmp_path / "bag")
    assert report.n_pushes == 3 and any("announces 30" in note for note in report.notes)
    report = import_cmu_icra16(icra16_file(tmp_path / "patch" / "far.txt", gap=9.0), tmp_path / "far")
    assert len(report.warnings) == 1 and "8.7 mm outside" in report.warnings[0]
    silent = import_cmu_icra16(icra16_file(tmp_path / "patch" / "silent.txt", n_force=0), tmp_path / "silent")
    assert np.isnan(silent.contact_distance).all() and "nothing shows" in silent.warnings[0]


def test_mocap_takes_another_object_or_supports_and_warns_where_the_tool_does_not_meet_it(tmp_path: Path) -> None:
    file = recording(MOCAP)
    outline = np.array([[0.2, 0.0], [0.25, 0.0], [0.25, 0.05], [0.2, 0.05]])
    report = import_cmu_mocap(file, tmp_path / "bag", body=MocapObject(outline=outline, mass=0.5))
    assert report.mass == 0.5 and report.centre_of_mass is None and len(report.supports) == 0
    assert "outside the outline" in report.warnings[0]
    with pytest.raises(InputError, match="4 x 4"):
        import_cmu_mocap(file, tmp_path / "other", body=MocapObject(frame_in_body=np.ones((4, 4))))
    (tmp_path / "robot_push_many.bag").symlink_to(file)  # a name that says nothing of supports
    given = np.array([[0.028, 0.028], [0.048, 0.028], [0.028, 0.048]])
    known = import_cmu_mocap(tmp_path / "robot_push_many.bag", tmp_path / "given", body=MocapObject(supports=given))
    np.testing.assert_array_equal(known.supports, given)
