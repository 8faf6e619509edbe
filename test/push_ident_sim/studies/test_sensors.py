"""The study of sensors: one true motion before every camera, and a case of its smallest size."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.geometry.se2 import compose
from push_ident.identification.fitting.budget import Budget
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings
from push_ident_sim.studies import sensors as study
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings
from push_ident_sim.studies.registry import EXPERIMENTS
from push_ident_sim.studies.sensors import FilmedObject, outline_errors

STUDY = EXPERIMENTS["sensors"]


def test_placed_outline_has_the_error_of_its_form_alone():
    square = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    moved = outline_errors(square + np.array([0.002, -0.001]), square)
    assert moved["placed_m"] < 2e-5 and 0.001 < moved["outline_m"] < 0.0024
    # An object that is wider by 1 mm on every side, wherever it is placed.
    wider = outline_errors(np.sign(square) * (np.abs(square) + 1e-3), square)
    assert wider["placed_m"] == pytest.approx(1e-3, rel=0.05) and wider["outline_m"] == pytest.approx(1e-3, rel=0.05)


def test_true_motion_is_the_same_before_every_camera_and_exact_poses_are_as_the_camera_reports_them():
    first = None
    for sensor, most in (("ideal", 3e-4), ("phoxi", 1.5e-3)):
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
    summary = STUDY.summarise([CaseResult(case, STUDY.run(case, settings))])
    assert 5e-4 < summary["sensors"]["kinect_v1"]["last_placed_m"] < 5e-3
    assert "kinect_v1" in STUDY.tables(summary) and "(kinect_v1)" in STUDY.answer(summary)
