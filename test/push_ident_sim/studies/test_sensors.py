"""The experiment on sensors: one true motion before every camera, tables from the summary."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.geometry.se2 import compose
from push_ident.identification.fitting.budget import Budget
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings
from push_ident_sim.studies.common.filmed import FilmedObject
from push_ident_sim.studies.common.seeing import outline_errors, unit_of
from push_ident_sim.studies.registry import EXPERIMENTS
from push_ident_sim.studies.sensors import study

STUDY = EXPERIMENTS["sensors"]


def test_no_two_cases_share_a_unit():
    units = {unit_of(name, seed) for name in OBJECT_NAMES for seed in range(20)}
    assert len(units) == 20 * len(OBJECT_NAMES)


def test_placed_outline_has_the_error_of_its_form_alone():
    square = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    moved = outline_errors(square + np.array([0.002, -0.001]), square)
    assert moved["placed_m"] < 2e-5 and 0.001 < moved["outline_m"] < 0.0024
    # A thing that is wider by 1 mm on every side, wherever it is placed.
    wider = outline_errors(np.sign(square) * (np.abs(square) + 1e-3), square)
    assert wider["placed_m"] == pytest.approx(1e-3, rel=0.05) and wider["outline_m"] == pytest.approx(1e-3, rel=0.05)


@pytest.fixture(scope="module")
def filmed():
    filmed = {}
    for sensor in ("ideal", "phoxi"):
        own = FilmedObject(make_object("toolbox", 3), [3, 3, 8], sensor=sensor, unit=17, rest=12)
        own.record = own.execute(own.true_push(np.random.default_rng(1)))
        own.test = own.test_pushes(1, np.random.default_rng(2), as_perceived=False)
        own.close()
        filmed[sensor] = own
    return filmed


def test_true_motion_is_the_same_before_every_camera(filmed):
    ideal, phoxi = filmed["ideal"], filmed["phoxi"]
    np.testing.assert_array_equal(ideal.true_pose, phoxi.true_pose)
    np.testing.assert_array_equal(ideal.test[0].pusher.position, phoxi.test[0].pusher.position)


def test_exact_poses_are_those_that_the_camera_reports_without_noise(filmed):
    ideal, phoxi = filmed["ideal"], filmed["phoxi"]
    assert np.linalg.norm(ideal.as_reported(np.zeros(3))) < 1e-4 < np.linalg.norm(phoxi.as_reported(np.zeros(3)))
    for own, most in ((ideal, 3e-4), (phoxi, 1.5e-3)):
        (exact,) = own.exact
        np.testing.assert_array_equal(exact.poses.time, own.record.poses.time)
        assert np.max(np.abs(own.record.poses.pose - exact.poses.pose)[:, :2]) < most
        assert exact.poses.pose[-1] == pytest.approx(compose(own.as_reported(own.true_pose), own.offset), abs=1e-9)
        assert outline_errors(own.exact_shape.outline, own.shape.outline)["placed_m"] < 2e-3


def test_a_case_gives_all_that_the_tables_show(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "N_PUSHES", 1)
    monkeypatch.setattr(study, "N_TEST", 2)
    settings = CaseSettings(tmp_path, Budget(max_seconds=10.0, processor_time=True), TruthSettings(), CameraNoise())
    cases = [Case("toolbox", 3, sensor) for sensor in ("ideal", "kinect_v1")]
    results = [CaseResult(case, STUDY.run(case, settings)) for case in cases]
    assert all(set(r.values["errors_m"]) == {"perceived", "exact_poses", "exact_outline", "exact"} for r in results)
    summary = STUDY.summarise(results)
    assert summary["sensors"]["ideal"]["last_placed_m"] < 3e-4 < 5e-4 < summary["sensors"]["kinect_v1"]["last_placed_m"]
    tables = STUDY.tables(summary)
    assert "kinect_v1" in tables and " 1.00 |" in tables
    assert list(STUDY.draw(summary, tmp_path)) == ["sensors.png"] and (tmp_path / "sensors.png").stat().st_size > 1000
    alone = STUDY.tables(STUDY.summarise(results[1:]))
    assert "–" in alone
