"""`push-ident check-calibration` as its users and their scripts see it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from helpers.commands import check_refused, run_here
from helpers.objects import hammer_shape
from helpers.paths import CONFIG
from helpers.tangent_pushes import pushes_around
from push_ident.bags.records import write_records
from push_ident_sim.injected.into_recordings import with_causes

PARAMETERS = """
/**/perception_node:
  ros__parameters:
    camera_position: [0.5, 0.1, 0.8]
    camera_quaternion: [0.0, 1.0, 0.0, 0.0]
    camera_position_std: 0.002
    camera_heading_std: 0.005
"""


def test_a_displaced_camera_is_found_and_corrected_in_a_parameter_file(tmp_path: Path) -> None:
    bag, out, params = tmp_path / "pushes", tmp_path / "out", tmp_path / "my_cell.yaml"
    params.write_text(PARAMETERS)
    pushes = pushes_around(hammer_shape(), 12, np.random.default_rng(1))
    write_records(bag, with_causes(pushes, {"camera_translation": (0.01, 0.0)}))
    done = run_here("check-calibration", bag, "--params", params, "--without", "11", "--out", out, "--json", tmp_path / "c.json")
    assert done.returncode == 1 and "The calibration is wrong: camera along x (11 of 11 pushes show contacts)." in done.stdout, done.stderr
    content = json.loads((tmp_path / "c.json").read_text())
    assert content == json.loads((out / "result.json").read_text())
    first = content["quantities"][0]
    assert content["verdict"] == "differs" and first["name"] == "camera_x" and first["outcome"] == "differs"
    assert first["estimate"] == pytest.approx(0.01, abs=5e-4) and first["stated_std"] == pytest.approx(2e-3, rel=0.1)
    written = yaml.safe_load((out / "camera.yaml").read_text())["/**/perception_node"]["ros__parameters"]
    assert written["camera_position"] == pytest.approx([0.49, 0.1, 0.8], abs=1e-3) and written["camera_position_std"] < 1e-3
    page = (out / "calibration.html").read_text()
    assert "camera along x" in page and "as configured" in page and page.count("<circle") == 2 * 11 + 2


def test_a_right_calibration_has_exit_status_0_and_a_tool_of_another_radius_1(tmp_path: Path) -> None:
    bag = tmp_path / "pushes"
    write_records(bag, pushes_around(hammer_shape(), 12, np.random.default_rng(1)))
    done = run_here("check-calibration", bag, "--out", tmp_path / "out")
    assert done.returncode == 0 and "agrees with the contacts" in done.stdout, done.stderr
    assert "no bag has the pose of the camera" in done.stderr and not (tmp_path / "out/camera.yaml").exists()
    done = run_here("check-calibration", bag, "--robot", CONFIG / "robots/ur5e.yaml")
    assert done.returncode == 1 and "The calibration is wrong: outline and radius" in done.stdout
    assert "the 10.0 mm of the robot file are checked" in done.stderr


def test_files_that_are_no_parameters_are_refused(tmp_path: Path) -> None:
    params, bag = tmp_path / "my_cell.yaml", tmp_path / "pushes"
    params.write_text("/**:\n  ros__parameters:\n    camera_position_std: wide\n")
    write_records(bag, pushes_around(hammer_shape(), 2, np.random.default_rng(1)))
    check_refused("camera_position_std is 'wide', expected a number", "check-calibration", bag, "--params", params)
