"""`push-ident look`: what it reads, what it writes, and one line for each bad input."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from helpers.commands import check_refused, run_here
from helpers.depth_scene import CAMERA, SMALL, box, render
from helpers.paths import EXAMPLE_BAG
from push_ident.perception.frame.view import points_in_table
from push_ident.types import DepthFrame

INFO = {
    "image_width": 320,
    "image_height": 240,
    "camera_name": "depth",
    "camera_matrix": {"rows": 3, "cols": 3, "data": [290.0, 0, 150.0, 0, 290.0, 110.0, 0, 0, 1]},
    "projection_matrix": {"rows": 3, "cols": 4, "data": [300.0, 0, 159.5, 0, 0, 300.0, 119.5, 0, 0, 0, 1, 0]},
}
NUMBERS = "300,300,159.5,119.5"


@pytest.fixture(scope="module")
def frame() -> DepthFrame:
    """A box on a table."""
    return render([box(0, 0, 0.2, 0.12, 0.1, 0.4)], CAMERA, rng=np.random.default_rng(0), intrinsics=SMALL)


@pytest.fixture
def folder(tmp_path: Path, frame: DepthFrame) -> Path:
    """Depth images in millimetres with their camera info, and a picture for the eye between them."""
    path = tmp_path / "images"
    path.mkdir()
    for name in ("2.png", "10.png"):
        cv2.imwrite(str(path / name), np.rint(np.nan_to_num(frame.depth) * 1e3).astype(np.uint16))
    cv2.imwrite(str(path / "3.png"), np.zeros((240, 320, 3), np.uint8))
    (path / "camera_info.yaml").write_text(yaml.safe_dump(INFO))
    return path


def look(*args: object, out: Path):
    done = run_here("look", *args, "--out", out, "--json", out / "look.json")
    return done, json.loads((out / "look.json").read_text()) if (out / "look.json").exists() else {}


def check_found(content: dict) -> None:
    assert [own["object_id"] for own in content["objects"]] == ["o1"]
    np.testing.assert_allclose([*content["objects"][0]["size_m"], content["objects"][0]["top_m"]], (0.2, 0.12, 0.1), atol=0.004)
    assert content["camera"]["position_m"][2] == pytest.approx(0.85, abs=0.002)


def test_a_folder_of_images_gives_picture_page_parameters_and_json(folder: Path, tmp_path: Path) -> None:
    done, content = look(folder, "--known", "200mmx0.12x10cm", out=tmp_path / "out")
    assert done.returncode == 0, done.stderr
    check_found(content)
    assert content["n_frames"] == 2 and content["scale_check"]["outcome"] == "agrees"
    assert any("3.png" in note and "colour" in note for note in content["notes"])
    assert "o1: 20" in done.stdout and "right within" in done.stdout
    page = (tmp_path / "out" / "look.html").read_text(encoding="utf-8")
    assert "data:image/png;base64," in page and "camera_quaternion" in page and "Noise of a height" in page
    values = yaml.safe_load((tmp_path / "out" / "perception.yaml").read_text())["/**/perception_node"]["ros__parameters"]
    np.testing.assert_allclose(values["workspace_low"], content["workspace"]["low_m"], atol=1e-3)


def cloud_of(frame: DepthFrame) -> str:
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 320\nHEIGHT 240\nVIEWPOINT 0 0 0 1 0 0 0\n"
    rows = [f"{x:.6f} {y:.6f} {z:.6f}" for x, y, z in points_in_table(frame, np.eye(4)).reshape(-1, 3)]
    return head + f"POINTS {len(rows)}\nDATA ascii\n" + "\n".join(rows) + "\n"


# Open3D, which reads clouds, is installed for a release only.
@pytest.mark.parametrize("name", ["depth.npy", "depth.tif", pytest.param("depth.pcd", marks=pytest.mark.release), "tenths.png"])
def test_each_kind_of_image_is_read(name: str, frame: DepthFrame, tmp_path: Path) -> None:
    file, options = tmp_path / name, ["--intrinsics", NUMBERS]
    if name == "depth.npy":
        np.save(file, frame.depth)
    elif name == "depth.pcd":
        file.write_text(cloud_of(frame))
        options = []
    elif name == "tenths.png":
        cv2.imwrite(str(file), np.rint(frame.depth * 1e4).astype(np.uint16))
        options += ["--depth-unit", "0.0001"]
    else:
        cv2.imwrite(str(file), frame.depth)
    done, content = look(file, *options, out=tmp_path / "out")
    assert done.returncode == 0, done.stderr
    check_found(content)


def test_a_bag_gives_its_intrinsics_and_extrinsics(tmp_path: Path) -> None:
    done, content = look(EXAMPLE_BAG, out=tmp_path)
    assert done.returncode == 0, done.stderr
    assert content["n_frames"] == 30 and content["camera"]["is_given"]
    np.testing.assert_allclose(content["camera"]["position_m"], (0.55, 0.0, 0.85), atol=0.002)
    assert len(content["objects"]) == 1 and content["objects"][0]["height_m"] < 0.05


def test_a_camera_file_is_used_and_errors_of_camera_and_size_are_named_when_everything_is_written(folder: Path, tmp_path: Path) -> None:
    np.savetxt(tmp_path / "camera.txt", CAMERA)
    _, content = look(folder, "--camera", tmp_path / "camera.txt", out=tmp_path / "out")
    np.testing.assert_allclose(content["camera"]["position_m"], CAMERA[:3, 3], atol=0.003)
    np.savetxt(tmp_path / "camera.txt", CAMERA + 0.35 * np.outer([0, 0, 1, 0], [0, 0, 0, 1]))  # too high
    done, content = look(folder, "--camera", tmp_path / "camera.txt", "--known", "0.9x0.7", out=tmp_path / "other")
    assert not content["camera"]["is_given"] and "is not used" in done.stderr
    assert done.returncode == 1 and "None of 1 objects" in done.stderr
    assert content["objects"] and (tmp_path / "other" / "look.html").exists()


DISTORTED = {**INFO, "projection_matrix": None, "distortion_coefficients": {"data": [0.1, 0, 0, 0, 0]}}
UNORGANISED = b"VERSION 0.7\nWIDTH 320\nHEIGHT 1\nPOINTS 320\nDATA ascii\n"


@pytest.mark.parametrize(
    ("name", "content", "options", "expected"),
    [
        ("nothing", None, (), "does not exist; give a bag, a folder"),
        ("none/", None, (), "has no depth image"),
        ("camera_info.yaml", None, (), "no camera_info.yaml beside it"),
        ("camera_info.yaml", b"a: [\n", (), "gives no intrinsics"),
        ("camera_info.yaml", DISTORTED, (), "no projection matrix P"),
        ("camera_info.yaml", INFO | {"image_width": 640}, (), "belong to different cameras"),
        ("8.png", np.full((240, 320), 9, np.uint8), (), "8 bits hold no depth"),
        ("0.png", np.zeros((240, 320), np.uint16), (), "0 valid of 76800 pixels"),
        ("p.npy", np.array([{}], dtype=object), (), "cannot be read as an image"),
        ("2.png", b"\x89PNG\r\n", (), "damaged"),
        pytest.param("c.pcd", UNORGANISED, (), "not organised", marks=pytest.mark.release),
        ("b.mcap", b"nothing of the kind", (), "b.mcap"),
        (".", None, ("--intrinsics", "1,2"), "expected four numbers"),
        (".", None, ("--known", "a box"), "expected width x depth x height"),
        (".", None, ("--known", "200x120"), "0.2x0.1x0.05 in metres"),
        (".", None, ("--depth-unit", "1"), "give the metres per unit"),
        (str(EXAMPLE_BAG), None, ("--intrinsics", NUMBERS), "is a bag"),
    ],
)
def test_each_bad_input_ends_in_one_line(
    folder: Path, tmp_path: Path, name: str, content: object, options: tuple[str, ...], expected: str
) -> None:
    """`name` in the folder gets a content: bytes, an image or the content of a camera info; a folder is made, and None is no file."""
    file = folder / name
    if name.endswith("/"):
        file.mkdir()
    elif name == "camera_info.yaml" and not isinstance(content, bytes):
        file.unlink() if content is None else file.write_text(yaml.safe_dump(content))
    elif isinstance(content, np.ndarray):
        np.save(file, content, allow_pickle=True) if name.endswith(".npy") else cv2.imwrite(str(file), content)
    elif isinstance(content, bytes):
        file.write_bytes(content)
    check_refused(expected, "look", folder if name == "camera_info.yaml" else file, *options, "--out", tmp_path / "out")
