"""Bags whose topics are not those of the contract, and depth images that are compressed or in another unit."""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image

import push_ident as pi
from helpers.bags import copy_renamed, header_msg, new, pose_msg, write_push, write_raw
from helpers.commands import check_refused, run_here
from helpers.depth_scene import CAMERA, SMALL, box, render
from push_ident.bags.contract import Role, TopicRole
from push_ident.bags.raw import raw_messages
from push_ident.bags.read_options import ReadOptions, parse_topics
from push_ident.bags.reader import read_bag, read_depth
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError, FrameError, InputError, PerceptionError
from push_ident.perception.frame.depth_unit import wrong_unit
from push_ident.types import CameraIntrinsics, DepthFrame, Float64Array

OTHER = CameraIntrinsics(320, 240, 500.0, 500.0, 100.0, 100.0)


@pytest.fixture(scope="module")
def frame() -> DepthFrame:
    return render([box(0, 0, 0.2, 0.12, 0.1, 0.4)], CAMERA, rng=np.random.default_rng(0), intrinsics=SMALL)


def png(values: Float64Array) -> bytes:
    return bytes(cv2.imencode(".png", np.rint(values).astype(np.uint16))[1])


def compressed(kind: str, depth: Any) -> tuple[str, bytes]:
    """Format and data as image_transport writes them; 32FC1 with steps of 1/a of inverse depth, up to 10 m."""
    metres = np.nan_to_num(np.asarray(depth, dtype=np.float64))
    if kind == "16UC1; png compressed ":
        return kind, png(1e3 * metres)
    if kind == "rvl":
        return "16UC1; compressedDepth rvl", bytes(12) + b"\x01\x02\x03\x04" * 9
    if kind.startswith("16UC1"):
        return kind, bytes(12) + png(1e3 * metres)
    a = 100.0 * 101.0
    b = 1.0 - a / 10.0
    with np.errstate(divide="ignore"):
        return kind, struct.pack("<iff", 0, a, b) + png(np.where(metres > 0, a / metres + b, 0.0))


def write_image(writer: BagWriter, topic: str, depth: Any, *, encoding: str = "16UC1", unit: float = 1e-3, stamp: float = 2.0) -> None:
    pixels = np.nan_to_num(depth) / unit
    pixels = np.rint(pixels).astype(np.uint16) if encoding != "32FC1" else pixels.astype(np.float32)
    fields = *pixels.shape, encoding, 0, pixels.shape[1] * pixels.itemsize, pixels.view(np.uint8).ravel()
    write_raw(writer, Role.DEPTH.msgtype, topic, round(1e9 * stamp), header_msg(stamp, "camera_depth_optical_frame"), *fields)


def write_info(writer: BagWriter, topic: str, camera: CameraIntrinsics) -> None:
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0])
    p = np.array([camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1.0, 0])
    roi = new("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    size = camera.height, camera.width, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, roi
    write_raw(writer, Role.CAMERA_INFO.msgtype, topic, 10**9, header_msg(2.0, "camera_depth_optical_frame"), *size)


def write_compressed(writer: BagWriter, topic: str, kind: str, depth: Any) -> None:
    text, data = compressed(kind, depth)
    fields = header_msg(2.0, "camera_depth_optical_frame"), text, np.frombuffer(data, np.uint8)
    write_raw(writer, "sensor_msgs/msg/CompressedImage", topic, 2 * 10**9, *fields)


@pytest.mark.parametrize("image", ["/camera/camera/depth/image_rect_raw", "/aligned/image_raw", "/k4a/depth_to_rgb/image"])
def test_depth_under_another_name_is_listed_with_the_option_that_names_it(tmp_path: Path, frame: DepthFrame, image: str) -> None:
    info = image.rpartition("/")[0] + "/camera_info"
    with BagWriter(tmp_path / "bag") as writer:
        write_image(writer, "/colour/image_raw", frame.depth, encoding="mono16")
        write_image(writer, image, frame.depth)
        write_info(writer, info, SMALL)
        write_info(writer, "/rgb/depth/camera_info", OTHER)
        writer.write_extrinsics(1.0, CAMERA)
    refused = run_here("look", tmp_path / "bag", "--out", tmp_path)
    assert refused.returncode == 1 and "colour/image_raw=" not in refused.stderr
    found = re.findall(r"--map \S+=\w+", refused.stderr)
    assert found == [f"--map {image}=depth"], refused.stderr
    (seen,) = read_depth(tmp_path / "bag", ReadOptions(parse_topics({image: "depth"}))).frames()
    assert seen.intrinsics == SMALL  # beside the images, not that of another camera under the name of the contract
    done = run_here("look", tmp_path / "bag", *found[0].split(), "--out", tmp_path)
    assert done.returncode == 0 and "o1:" in done.stdout, done.stderr


def test_a_camera_info_elsewhere_is_named_as_well(tmp_path: Path, frame: DepthFrame) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_image(writer, "/lab/depth", frame.depth)
        write_info(writer, "/lab/info", SMALL)
    with pytest.raises(BagError, match="--map /lab/depth=depth --map /lab/info=camera_info"):
        read_depth(tmp_path / "bag")
    options = ReadOptions(parse_topics({"lab/depth": "depth", "/lab/info": "camera_info"}))
    assert len(list(read_depth(tmp_path / "bag", options).frames())) == 1
    with pytest.raises(BagError, match="--map /lab/info=camera_info"):
        list(read_depth(tmp_path / "bag", ReadOptions(parse_topics({"lab/depth": "depth"}))).frames())


@pytest.mark.parametrize(
    ("kind", "accuracy"),
    [
        ("16UC1; compressedDepth png", 1e-6),
        ("16UC1; compressedDepth", 1e-6),
        ("compressedDepth", 2e-4),  # of real numbers, by its header
        ("16UC1; png compressed ", 1e-6),
        ("32FC1; compressedDepth png", 2e-4),  # half a step of 1/a at 1.4 m is 0.1 mm
    ],
)
def test_compressed_depth_comes_in_metres(tmp_path: Path, frame: DepthFrame, kind: str, accuracy: float) -> None:
    topic = "/depth/image_rect/compressedDepth"
    with BagWriter(tmp_path / "bag") as writer:
        write_compressed(writer, topic, kind, frame.depth)
        write_info(writer, "/depth/camera_info", SMALL)
    check_refused(f"--map {topic}=depth", "look", tmp_path / "bag", "--out", tmp_path)
    (seen,) = read_depth(tmp_path / "bag", ReadOptions(parse_topics({topic: "depth"}))).frames()
    np.testing.assert_allclose(seen.depth, frame.depth, atol=accuracy)
    assert np.isfinite(seen.depth).sum() == np.isfinite(frame.depth).sum()


def test_depth_of_another_unit_or_compressed_is_played_in_metres(tmp_path: Path, frame: DepthFrame) -> None:
    topics = parse_topics({"/lab/depth": "depth"})
    for name, unit in (("quarters", 2.5e-4), ("compressed", None)):
        with BagWriter(tmp_path / name) as writer:
            if unit:
                write_image(writer, "/lab/depth", frame.depth, unit=unit)
            else:
                write_compressed(writer, "/lab/depth", "16UC1; compressedDepth png", frame.depth)
        (played,) = raw_messages(tmp_path / name, ReadOptions(topics, unit))
        image = deserialize_message(played.data, Image)
        depth = np.frombuffer(image.data, np.float32).reshape(image.height, image.width)
        assert (played.msgtype, image.encoding) == ("sensor_msgs/msg/Image", "32FC1")
        np.testing.assert_allclose(depth, frame.depth, atol=2e-4)


def test_compressed_images_that_are_no_depth_are_refused_in_one_line(tmp_path: Path, frame: DepthFrame) -> None:
    grey = bytes(cv2.imencode(".png", np.zeros((240, 320), np.uint8))[1])
    cases = (
        (*compressed("rvl", frame.depth), "RVL"),
        ("16UC1; compressedDepth png", bytes(12) + grey, "8 bits"),
        ("16UC1; compressedDepth png", bytes(12) + png(np.ones((240, 320)))[:60], "cannot be decoded"),
        ("16UC1; compressedDepth png", bytes(5), "holds no PNG"),
        ("16UC1; compressedDepth png", bytes(12) + grey[:16] + b"\xff" * 8 + grey[24:], "side of an image"),
        ("rgb8; jpeg compressed bgr8", b"\xff\xd8", "expected depth"),
        ("16UC1; compressedDepth png", bytes(12) + png(np.ones((24, 32))), "camera info"),
    )
    options = ReadOptions({"d": TopicRole(Role.DEPTH)})
    for number, (text, data, reason) in enumerate(cases):
        bag = tmp_path / str(number)
        with BagWriter(bag) as writer:
            fields = header_msg(2.0, "camera"), text, np.frombuffer(data, np.uint8)
            write_raw(writer, "sensor_msgs/msg/CompressedImage", "/d", 2 * 10**9, *fields)
            write_info(writer, "/camera_info", SMALL)
        with pytest.raises(FrameError, match=reason):
            list(read_depth(bag, options).frames())


def test_poses_and_pusher_under_other_names_are_read_as_what_they_are_mapped_to(tmp_path: Path) -> None:
    names = {"/objects/7/pose": "/body", "/pusher/pose": "/tool"}
    with BagWriter(tmp_path / "contract") as writer:
        write_push(writer, 2.0)
    copy_renamed(tmp_path / "contract", tmp_path / "other", names)
    with pytest.raises(BagError, match=r"--map /body=pose:ID, and --map /tool=pusher\."):
        read_bag(tmp_path / "other")
    options = ReadOptions(parse_topics({"/body": "pose:hammer", "tool/": "pusher"}))
    contents, same = read_bag(tmp_path / "other", options), read_bag(tmp_path / "contract")
    np.testing.assert_array_equal(contents.pusher.value, same.pusher.value)
    np.testing.assert_array_equal(contents.objects["hammer"].pose, same.objects["7"].pose)
    for topics, reason in (({"/nose": "pusher"}, "no topic nose"), ({"/body": "wrench"}, "holds geometry_msgs/msg/PoseWith")):
        with pytest.raises(BagError, match=reason):
            read_bag(tmp_path / "other", ReadOptions(parse_topics(topics)))
    with pytest.raises(BagError, match="import rosbag"):
        pi.load(tmp_path / "other", topics={"/body": "pusher"})


def test_roles_and_units_that_are_none_are_refused(tmp_path: Path) -> None:
    for topics in ({"/a": "arm"}, {"/a": "depth:1"}, {"/": "depth"}, {"/a": "pose:x y"}, {"/a": ""}):
        with pytest.raises(InputError, match="expected"):
            parse_topics(topics)
    for unit in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="metres per unit"):
            ReadOptions(depth_unit=unit)
    for command in ("identify", "diagnose", "look"):
        check_refused("TOPIC=ROLE", command, tmp_path, "--map", "depth")
        check_refused("twice", command, tmp_path, "--map", "a=depth", "--map", "a=pusher")


@pytest.mark.parametrize(
    ("encoding", "unit", "words"),
    [
        ("16UC1", 1e-4, "10.0 times too large: its unit is 0.1 mm"),
        ("16UC1", 2.5e-4, "4.0 times too large: its unit is 0.25 mm"),
        ("16UC1", 1e-2, "10.0 times too small: its unit is 10 mm"),
        ("32FC1", 1e-3, "1000.0 times too large: its unit is 1 mm"),
    ],
)
def test_another_unit_of_the_depth_is_named_and_mended(tmp_path: Path, frame: DepthFrame, encoding: str, unit: float, words: str) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_extrinsics(1.0, CAMERA)
        write_info(writer, "/depth/camera_info", SMALL)
        write_push(writer, 2.0, poses=False)
        for number in range(2):
            write_image(writer, "/depth/image_rect", frame.depth, encoding=encoding, unit=unit, stamp=2.0 + number / 30)
    wrong = run_here("look", tmp_path / "bag", "--out", tmp_path)
    assert words in wrong.stderr and f"--depth-unit {unit:g}" in wrong.stderr, wrong.stderr
    check_refused(f"{words}; `push-ident identify`", "diagnose", tmp_path / "bag")
    with pytest.raises(PerceptionError, match=f"--depth-unit {unit:g}"):
        pi.load(tmp_path / "bag")
    done = run_here("look", tmp_path / "bag", "--depth-unit", unit, "--out", tmp_path)
    assert done.returncode == 0 and "corrects the given pose" in done.stderr, done.stderr
    # Steps of depth of 10 mm leave its edges too rough to announce it.
    assert ("o1: 20" if unit < 0.01 else "105.3 mm high, is no object") in done.stdout, done.stdout
    (first, _) = read_bag(tmp_path / "bag", ReadOptions(depth_unit=unit)).depth_frames()
    np.testing.assert_allclose(first.depth, frame.depth, atol=0.51 * min(unit, 1e-2))


def test_a_camera_in_another_place_is_no_other_unit(frame: DepthFrame) -> None:
    millimetres = replace(frame, unit=1e-3)
    assert wrong_unit(millimetres, CAMERA) is None
    for higher in (0.1, 0.35, -0.4, 0.85):
        moved = CAMERA.copy()
        moved[2, 3] += higher
        assert wrong_unit(millimetres, moved) is None
    assert wrong_unit(replace(millimetres, depth=np.full_like(frame.depth, np.nan)), CAMERA) is None


def test_a_pusher_in_another_frame_than_the_camera_is_noted(tmp_path: Path, frame: DepthFrame) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_extrinsics(1.0, CAMERA)
        write_info(writer, "/depth/camera_info", SMALL)
        write_image(writer, "/depth/image_rect", frame.depth)
        write_raw(writer, Role.PUSHER.msgtype, "/tool", 2 * 10**9, header_msg(2.0, "base_link"), pose_msg())
    notes = read_bag(tmp_path / "bag", ReadOptions(parse_topics({"/tool": "pusher"}))).notes
    assert any("in 'base_link', the camera in 'table'" in note for note in notes), notes


def test_of_two_cameras_the_one_that_is_mapped_has_its_own_camera_info(tmp_path: Path, frame: DepthFrame) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for name, camera in (("left", OTHER), ("right", SMALL)):
            write_image(writer, f"/{name}/depth/image_rect", frame.depth)
            write_info(writer, f"/{name}/depth/camera_info", camera)
    with pytest.raises(BagError, match=r"--map /left/depth/image_rect=depth"):
        read_depth(tmp_path / "bag")
    (seen,) = read_depth(tmp_path / "bag", ReadOptions(parse_topics({"/right/depth/image_rect": "depth"}))).frames()
    assert seen.intrinsics == SMALL
