"""Recordings of others as sets of pushes, and their table; one true motion before every model of a camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.objects import record_of, straight_push, uniform
from helpers.recordings import icra16_file, mit_content, mit_file
from push_ident.bags.importers import MIT_SHAPES, import_mit
from push_ident.bags.importers.shapes import shape_of_outline
from push_ident.errors import InputError
from push_ident.geometry.se2 import compose
from push_ident.identification.fitting.budget import Budget
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings
from push_ident_sim.studies import sensors as study
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings
from push_ident_sim.studies.recorded import draw_pushes, find_sets, known_of
from push_ident_sim.studies.registry import EXPERIMENTS
from push_ident_sim.studies.sensors import FilmedObject, outline_error

STUDY = EXPERIMENTS["recorded"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three pushes as files whose names are not in the order of time, the bag of them, and a file of CMU."""
    folder = tmp_path_factory.mktemp("recordings")
    outline = MIT_SHAPES["rect1"].outline
    assert outline is not None
    model, pusher = uniform(shape_of_outline(outline), mass=0.8374), straight_push((0.2, 0.02), 0.0, radius=0.00475, rate=250.0)
    for number, start in enumerate((2e5, 0.0, 1e5)):
        record = record_of(model, pusher, np.array([0.28 + 1e-3 * number, 0.0, 0.0]), np.random.default_rng(1), noise=0.05)
        mit_file(folder / "even" / "rect1", mit_content(record, 1.46e9 + start), number=number, surface="even")
    import_mit([folder / "even"], folder / "as" / "bag")
    icra16_file(folder / "hardboard" / "triangle.txt")
    return folder


def test_every_set_of_a_folder_is_known_by_its_form(folder: Path, tmp_path: Path) -> None:
    sets = find_sets(folder)
    assert {name: len(one.paths) for name, one in sets.items()} == {"even-rect1": 3, "as-bag": 1, "hardboard-triangle": 1}
    assert STUDY.find_objects is not None and set(STUDY.find_objects(folder)) == set(sets)
    assert len(draw_pushes(sets["hardboard-triangle"], 9, np.random.default_rng(0)).records) == 2
    for wrong, reason in ((tmp_path, "no recording in it"), (tmp_path / "elsewhere", "no such folder")):
        with pytest.raises(InputError, match=reason):
            find_sets(wrong)


def test_files_and_their_bag_give_the_same_pushes_in_the_order_in_which_they_were_made(folder: Path) -> None:
    sets = find_sets(folder)
    files, bag = (draw_pushes(sets[name], 9, np.random.default_rng(0)) for name in ("even-rect1", "as-bag"))
    assert files.n_all == bag.n_all == 3 and files.mass == 0.8374 and bag.mass is None
    for one, other in zip(files.records, bag.records, strict=True):
        np.testing.assert_allclose(one.poses.pose, other.poses.pose, atol=1e-9)
    assert [round(1e3 * record.poses.pose[0, 0]) for record in files.records] == [281, 282, 280]
    drawn = draw_pushes(sets["even-rect1"], 2, np.random.default_rng(1), ends_only=True, with_forces=False)
    assert len(drawn.records) == 2 and all(len(r.poses.time) == 2 and r.wrench is None for r in drawn.records)


def test_what_authors_measured_is_read_by_patterns_of_names(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "known.json").write_text('{"even-*": {"friction": 0.25}}')
    assert known_of(tmp_path, "even-rect1")["friction"] == 0.25 and known_of(tmp_path, "other") == {} == known_of(folder, "even-rect1")
    (tmp_path / "known.json").write_text("[1]")
    with pytest.raises(InputError, match="an object of objects"):
        known_of(tmp_path, "even-rect1")


def test_draws_of_a_set_are_counted_with_named_effects_measured_friction_and_refusals() -> None:
    named = {"n": 14, "n_all": 60, "verdict": "named", "effects": [{"name": "wear", "parameters": {"w": -0.02}}], "refused": []}
    named |= {"something_else": 0.05, "gap": None, "friction": 0.25, "known": {"friction": 0.28}, "seconds": 10.0}
    other = named | {"verdict": "not_trustworthy", "effects": [], "refused": ["no push touches"], "something_else": None, "friction": None}
    summary = STUDY.summarise([CaseResult(Case("hex", seed, "14-pushes"), draw) for seed, draw in enumerate((named, other))])
    row = summary["diagnosed"]["hex, 14-pushes"]
    assert row["draws"] == 2 and row["pushes"] == [14, 60] and row["verdicts"] == {"named": 1, "not_trustworthy": 1}
    assert row["named"] == {"wear": {"n": 1, "mean": {"w": -0.02}}} and row["something_else"] == 0.05 and row["friction"] == 0.25
    assert "hex, 14-pushes was refused: no push touches" in STUDY.tables(summary) and "2 draws" in STUDY.answer(summary)


SENSORS = EXPERIMENTS["sensors"]


def test_error_of_an_outline_is_its_distance_from_the_true_one():
    square = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    # An object that is wider by 1 mm on every side.
    assert outline_error(np.sign(square) * (np.abs(square) + 1e-3), square) == pytest.approx(1e-3, rel=0.05)


def test_true_motion_is_the_same_before_every_camera_and_exact_poses_are_as_the_camera_reports_them():
    first = None
    for sensor, most in (("ideal", 3e-4), ("kinect_v1", 3e-3)):
        filmed = FilmedObject(make_object("toolbox", 3), [3, 3, 8], sensor=sensor, unit=17, rest=6)
        record = filmed.execute(filmed.true_push(np.random.default_rng(1)))
        (test,) = filmed.test_pushes(1, np.random.default_rng(2))
        filmed.close()
        first = first or (filmed.true_pose, test)
        np.testing.assert_array_equal(filmed.true_pose, first[0])
        np.testing.assert_array_equal(test.pusher.position, first[1].pusher.position)
        assert (np.linalg.norm(filmed.as_reported(np.zeros(3))) < 1e-4) == (sensor == "ideal")
        (exact,) = filmed.exact
        np.testing.assert_array_equal(exact.poses.time, record.poses.time)
        assert np.max(np.abs(record.poses.pose - exact.poses.pose)[:, :2]) < most
        assert exact.poses.pose[-1] == pytest.approx(compose(filmed.as_reported(filmed.true_pose), filmed.offset), abs=1e-9)


def test_case_gives_all_that_the_table_shows(tmp_path, monkeypatch):
    for name, value in (("N_PUSHES", 1), ("N_TEST", 2), ("_REST", 10)):
        monkeypatch.setattr(study, name, value)
    settings = CaseSettings(tmp_path, Budget(max_seconds=10.0, processor_time=True), TruthSettings(), CameraNoise())
    case = Case("toolbox", 3, "kinect_v1")
    summary = SENSORS.summarise([CaseResult(case, SENSORS.run(case, settings))])
    assert 5e-4 < summary["sensors"]["kinect_v1"]["last_outline_m"] < 5e-3
    assert "kinect_v1" in SENSORS.tables(summary) and "(kinect_v1)" in SENSORS.answer(summary)
