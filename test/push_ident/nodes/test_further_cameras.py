"""perception_node with further cameras, and its calibration by a mark."""

from __future__ import annotations

import signal
import subprocess

import numpy as np
import pytest
import yaml

from helpers.depth_scene import CAMERA, HAMMER, HAMMER_OUTLINE, Prism, render
from helpers.played_camera import POSE, SIDE, Camera, send_until, start
from helpers.spinning import spinning
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import (
    shape_from_msgs,
)
from push_ident.survey.parameter_file import pose_lines

pytestmark = pytest.mark.live


def as_arguments(*parameters: str) -> list[str]:
    return [word for parameter in parameters for word in ("-p", parameter)]


def end(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=30.0)
    assert "Traceback" not in output, output
    return output


def test_the_node_calibrates_all_its_cameras_and_writes_what_it_found(domain, tmp_path):
    outline, mark_pose = np.array([(0.0, 0.0), (0.15, 0.0), (0.0, 0.1)]), (0.05, -0.03, 0.7)
    other = own_domain()
    file = tmp_path / "camera.yaml"
    pose = ", ".join(str(value) for value in mark_pose)
    parameters = (
        "extrinsics:=calibrate",
        f"mark_pose:=[{pose}]",
        "calibration_frames:=6",
        f"calibration_file:={file}",
        "extrinsics_timeout:=1.0",
    )
    with spinning(Camera, other) as camera:
        rng = np.random.default_rng(1)
        mark = [Prism(outline, 0.03).at(mark_pose)]
        without_mark = [render([], rng=rng)]
        camera.frames = [render(mark, rng=rng) for _ in range(4)]
        camera.add("side", [render(mark, SIDE, rng=rng) for _ in range(4)])
        right, camera.frames = camera.frames, without_mark
        process = start(other, *as_arguments(*parameters, "extra_cameras:=[side]"))
        try:
            send_until(camera, lambda: camera.values().get("why_no_pose", "").startswith("still no extrinsics (calibrate)"))
            camera.frames = right
            send_until(camera, lambda: {"note_extrinsics", "note_extrinsics_side"} <= set(camera.values()))
            assert "outline of the mark 0." in camera.values()["note_extrinsics"]
        finally:
            end(process)
    found = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    for prefix, truth in (("", CAMERA), ("side.", SIDE)):
        difference = pose_of_quaternion(found[f"{prefix}camera_position"], found[f"{prefix}camera_quaternion"]) @ np.linalg.inv(truth)
        assert np.linalg.norm(difference[:3, 3]) < 0.002
        assert np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)) < np.deg2rad(0.5)


def test_a_further_camera_helps_with_the_shape_and_a_missing_one_is_named(domain, tmp_path):
    other = own_domain()
    file = tmp_path / "cameras.yaml"
    # As calibration writes it.
    lines = [*pose_lines(CAMERA), *pose_lines(SIDE, "side."), *pose_lines(SIDE, "wall."), "extra_cameras: [side, wall]"]
    file.write_text("/**:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in lines), encoding="utf-8")
    with spinning(Camera, other) as camera:
        rng = np.random.default_rng(3)
        camera.add("side", [render([prism.at(POSE) for prism in HAMMER], SIDE, rng=rng) for _ in range(4)])
        process = start(other, "--params-file", str(file), "-p", "rest_frames:=10")
        try:
            send_until(camera, lambda: camera.outlines and camera.cells and camera.values().get("side_views_used") == "1")
            send_until(camera, lambda: int(camera.values().get("wall_silent", 0)) > 0)
            assert camera.values()["note_camera_wall"].startswith("no depth image on /wall/depth/image_rect (0 publishers)")
            assert camera.values()["wall_views_left_out"] == "1" and int(camera.values()["side_frames"]) >= 10
        finally:
            end(process)
    # The object frame is turned as `table`; its origin is the centroid, 19.9 mm along the handle.
    origin = (POSE[0] + 0.0199 * np.cos(POSE[2]), POSE[1] + 0.0199 * np.sin(POSE[2]), 0.0)
    outline = transform_points(origin, shape_from_msgs(camera.cells[-1], camera.outlines[-1]).outline)
    assert np.abs(signed_distance(outline, transform_points(POSE, HAMMER_OUTLINE))).max() < 0.001
