"""Files of the MIT pushing dataset, of exactly the published form, made from simulated pushes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from helpers.commands import check_refused, run_here
from helpers.objects import record_of, straight_push, uniform
from helpers.recordings import mit_content, mit_file
from push_ident.bags.importers import MIT_SHAPES, MitOptions, import_mit
from push_ident.bags.importers.shapes import shape_of_outline
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.errors import BagError, InputError, PushIdentError
from push_ident.geometry.outline import polygon_centroid
from push_ident.types import PushRecord

RADIUS = 0.00475


@pytest.fixture(scope="module")
def record() -> PushRecord:
    """A push of rect1 beside its centre, in the base frame of a robot."""
    outline = MIT_SHAPES["rect1"].outline
    assert outline is not None
    model = uniform(shape_of_outline(outline), mass=0.8374, friction=0.25)
    pusher = straight_push((0.2, 0.02), 0.0, travel=0.1, speed=0.1, radius=RADIUS, rate=250.0)
    return record_of(model, pusher, np.array([0.28, 0.0, 0.0]), np.random.default_rng(1), noise=0.05)


def test_folder_of_files_becomes_one_bag_in_which_pushes_follow_each_other(tmp_path: Path, record: PushRecord) -> None:
    for number, start in enumerate((1460088637.2, 0.0, 1460000000.0)):
        mit_file(tmp_path / "abs" / "rect1", mit_content(record, start), number=number)
    done = run_here("import", "mit", tmp_path / "abs", "--out", tmp_path / "bag", "--json", tmp_path / "r.json")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["n_pushes"] == 3 and report["mass"] == 0.8374 and report["surface"] == "abs"
    assert [w.partition(" while")[0] for w in report["warnings"]] == ["no force is measured"], "it is the same with contact and without"
    assert np.abs(report["contact_distance_m"]).max() < 1e-3
    bag = read_bag(tmp_path / "bag")
    pushes = split_pushes(bag, "1")
    assert len(pushes) == 3 and np.diff(bag.pusher.time).max() < 10.0
    for push in pushes:
        np.testing.assert_allclose(push.poses.time - push.poses.time[0], record.poses.time, atol=1e-6)
        np.testing.assert_allclose(push.poses.pose, record.poses.pose, atol=1e-9)
        np.testing.assert_allclose(push.pusher.position, record.pusher.position, atol=1e-9)
        assert push.pusher.radius == RADIUS and push.wrench is not None
        np.testing.assert_allclose(push.wrench.force[0], [2.0, -0.5])  # on the object: along the motion of the probe
    done = run_here("import", "mit", tmp_path / "abs", "--out", tmp_path / "ends", "--ends-only")
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(split_pushes(read_bag(tmp_path / "ends"), "1")[0].poses.pose, record.poses.pose[[0, -1]], atol=1e-9)


def test_h5_holds_the_same_and_is_refused_with_a_remedy_without_its_library(
    tmp_path: Path, record: PushRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched, pytest.raises(PushIdentError, match=r"h5py is not installed.*mit"):
        patched.setitem(sys.modules, "h5py", None)
        own = tmp_path / "motion_surface=abs_shape=rect1_a=0.h5"
        own.write_bytes(b"\x89HDF")
        import_mit([own], tmp_path / "bag")
    h5py = pytest.importorskip("h5py", reason="h5py is optional: requirements/mit.txt")
    content = mit_content(record)
    for folder in ("h5", "json"):
        mit_file(tmp_path / folder, content)
    file = next((tmp_path / "h5").iterdir())
    with h5py.File(file.with_suffix(".h5"), "w") as out:
        for name, rows in content.items():
            out.create_dataset(name, data=rows)
    file.unlink()
    for folder in ("h5", "json"):
        import_mit([tmp_path / folder], tmp_path / f"bag_{folder}")
    first, second = (split_pushes(read_bag(tmp_path / f"bag_{folder}"), "1")[0] for folder in ("h5", "json"))
    np.testing.assert_array_equal(first.poses.pose, second.poses.pose)
    file.with_suffix(".h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(200))
    with pytest.raises(BagError, match="not an HDF5 file"):
        import_mit([tmp_path / "h5"], tmp_path / "other")
    with h5py.File(file.with_suffix(".h5"), "w") as out:
        out.create_dataset("tip_pose", shape=(2**40, 4), dtype="f8", chunks=(1024, 4))
    with pytest.raises(BagError, match="at most 16,777,216 bytes|expected object_pose"):
        import_mit([tmp_path / "h5"], tmp_path / "other")


def test_published_masses_are_those_of_steel_plates_of_one_thickness() -> None:
    """13 mm of steel of 7800 to 8000 kg/m^3 with the holes of the markers: a wrong leg or half axis changes the area by more."""
    for name, shape in MIT_SHAPES.items():
        if shape.outline is None:
            continue
        x, y = shape.outline.T
        area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
        assert 7700 < shape.mass / (area * 0.013) < 8050, name
    assert MIT_SHAPES["tri1"].outline is not None
    np.testing.assert_allclose(polygon_centroid(MIT_SHAPES["tri1"].outline), (0.00303, 0.00306), atol=3e-5)  # shape_db.py


def test_warns_where_the_probe_does_not_meet_the_object(tmp_path: Path, record: PushRecord) -> None:
    content = mit_content(record)
    for shift, reason in ((-0.03, "the object moves while the pusher is still up to"), (0.03, "inside the outline")):
        moved = content | {"tip_pose": [[t, x + shift, y, a] for t, x, y, a in content["tip_pose"]]}
        report = import_mit([mit_file(tmp_path / reason, moved)], tmp_path / f"bag {shift}")
        assert reason in report.warnings[0]


def test_empty_pushes_and_jumps_of_the_tracker_are_left_out_with_a_note(tmp_path: Path, record: PushRecord) -> None:
    content = mit_content(record)
    fine = 1460088637.2 + np.linspace(0.0, 1.0, 200)
    jump = content | {"object_pose": [[t, 0.28, 0.0, 0.0 if t < fine[100] else np.pi / 2] for t in fine]}
    files = [mit_file(tmp_path, c, number=k) for k, c in enumerate((content, content | {"object_pose": []}, jump))]
    report = import_mit(files, tmp_path / "bag")
    assert report.n_pushes == 1
    assert sum("is left out" in note for note in report.notes) == 2 and any("jumps by 90 degrees" in note for note in report.notes)
    with pytest.raises(BagError, match="none of 2 files"):
        import_mit(files[1:], tmp_path / "other")


def test_files_of_several_objects_or_surfaces_are_refused(tmp_path: Path, record: PushRecord) -> None:
    content = mit_content(record)
    rect1, hexagon = mit_file(tmp_path, content), mit_file(tmp_path, content, shape="hex")
    pu, butter = mit_file(tmp_path, content, surface="pu"), mit_file(tmp_path, content, shape="butter")
    for files, reason in (([rect1, hexagon], "objects hex, rect1"), ([rect1, pu], "surfaces abs, pu"), ([butter], "--outline")):
        with pytest.raises(InputError, match=reason):
            import_mit(files, tmp_path / "bag")
    with pytest.raises(InputError, match="no object `cube`"):
        import_mit([rect1], tmp_path / "bag", options=MitOptions(shape="cube"))
    own = MitOptions(outline=record.shape.outline)
    report = import_mit([butter], tmp_path / "bag", options=own)
    assert report.mass == 1.1974
    plain = tmp_path / "push.json"
    plain.write_text(rect1.read_text())
    with pytest.raises(InputError, match="--shape"):
        import_mit([plain], tmp_path / "other")
    assert import_mit([plain], tmp_path / "other", options=MitOptions(shape="rect1")).surface == ""


def test_malformed_truncated_huge_and_missing_files_end_in_one_line(tmp_path: Path, record: PushRecord) -> None:
    file = mit_file(tmp_path, mit_content(record))
    whole = file.read_text()
    for text, reason in (
        ("[" * 100_000, "not a JSON file"),
        (whole[: len(whole) // 2], "not a JSON file"),
        (" " * 17_000_000, "larger than"),
        ('{"object": [], "tip": []}', "has object, tip"),
        ('{"object_pose": [[1, 2]], "tip_pose": [], "ft_wrench": []}', r"shape \(1, 2\)"),
        ('{"object_pose": [[1, 2, 3, ' + "9" * 400 + ']], "tip_pose": [], "ft_wrench": []}', "not rows of numbers"),
        ('{"object_pose": [[1, 2, 3, NaN]], "tip_pose": [], "ft_wrench": []}', "not finite"),
        ('{"object_pose": [[0, 2000, 3, 0]], "tip_pose": [], "ft_wrench": []}', "at most 100 m"),
        ('{"object_pose": [], "tip_pose": [], "ft_wrench": []}', "0 object poses"),
    ):
        file.write_text(text)
        with pytest.raises(BagError, match=reason) as refused:
            import_mit([file], tmp_path / "bag")
        assert "\n" not in str(refused.value)
    check_refused("0 object poses", "import", "mit", file, "--out", tmp_path / "bag")
    (tmp_path / "none").mkdir()
    for path, reason in ((tmp_path / "absent.json", "JSON"), (tmp_path / "none", "no files"), (tmp_path / "a.txt", "suffix")):
        with pytest.raises((BagError, InputError), match=reason):
            import_mit([path], tmp_path / "bag", options=MitOptions(shape="rect1"))
    assert not (tmp_path / "bag").exists()
