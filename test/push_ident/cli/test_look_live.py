"""`push-ident look --live`: a camera that runs, and one line for each camera that cannot be looked through."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from helpers.commands import check_refused, run_here
from helpers.depth_scene import CAMERA, SMALL, box, render
from helpers.spinning import spinning
from push_ident.nodes.convert.messages import depth_frame_to_msgs, transform_to_msg

pytestmark = pytest.mark.live

Change = Callable[[Image, CameraInfo], object]
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@contextmanager
def camera(
    topic: str = "depth/image_rect", change: Change | None = None, *, info: bool = True, pose: bool = False, period: float = 0.05
) -> Iterator[Node]:
    """A depth camera over a box, an image each `period` [s] with an info beside it, as a driver of image_transport publishes them."""
    rng = np.random.default_rng(0)
    depths = [render([box(0, 0, 0.2, 0.12, 0.1, 0.4)], CAMERA, rng=rng, intrinsics=SMALL) for _ in range(5)]
    beside = topic.rpartition("/")[0]
    with spinning(lambda context: Node("camera", context=context)) as node:
        images = node.create_publisher(Image, topic, qos_profile_sensor_data)
        infos = node.create_publisher(CameraInfo, f"{beside}/camera_info", qos_profile_sensor_data) if info else None
        if pose:
            latched = node.create_publisher(PoseStamped, f"{beside}/camera_pose", LATCHED)
            latched.publish(transform_to_msg(node.get_clock().now().to_msg(), CAMERA))

        def send() -> None:
            depths.append(depths.pop(0))
            messages = depth_frame_to_msgs(depths[0], node.get_clock().now().to_msg())
            if change is not None:
                change(*messages)
            images.publish(messages[0])
            if infos is not None:
                infos.publish(messages[1])

        node.create_timer(period, send)
        yield node


def look(out: Path, *args: object) -> tuple[subprocess.CompletedProcess[str], dict[str, Any]]:
    done = run_here("look", "--live", *args, "--out", out, "--json", out / "look.json")
    return done, json.loads((out / "look.json").read_text()) if (out / "look.json").exists() else {}


def test_a_live_camera_gives_what_its_images_in_files_give(tmp_path: Path) -> None:
    with camera():
        done, content = look(tmp_path, "--known", "0.2x0.12x0.1")
    assert done.returncode == 0, done.stderr
    assert "listening to /depth/image_rect and /depth/camera_info" in done.stdout and "30 depth images at rest" in done.stdout
    assert content["n_frames"] == 30 and not content["camera"]["is_given"]
    assert content["scale_check"]["outcome"] == "agrees"
    (found,) = content["objects"]
    np.testing.assert_allclose([*found["size_m"], found["top_m"]], (0.2, 0.12, 0.1), atol=0.004)
    assert {"look.html", "perception.yaml"} <= {path.name for path in tmp_path.iterdir()}


def test_topics_beside_the_image_and_a_published_pose_are_used(tmp_path: Path) -> None:
    with camera("/camera/depth/image_rect_raw", pose=True):
        done, content = look(tmp_path, "/camera/depth/image_rect_raw")
    assert done.returncode == 0, done.stderr
    assert content["camera"]["is_given"]
    np.testing.assert_allclose(content["camera"]["position_m"], CAMERA[:3, 3], atol=0.003)


def test_what_ends_before_thirty_frames_is_surveyed_with_those_it_has(tmp_path: Path) -> None:
    heights = itertools.cycle((240, 239))  # every other image is cut
    # At most 25 whole ones; 2 also where the camera is found late.
    with camera(change=lambda image, info: setattr(image, "height", next(heights)), period=0.1):
        done, content = look(tmp_path, "--seconds", 5)
    assert done.returncode == 0, done.stderr
    assert 2 <= content["n_frames"] < 30
    assert any("not usable and left out" in note for note in content["notes"])


def test_no_publisher_is_named_with_the_topics_that_have_images_and_a_topic_of_another_type(tmp_path: Path) -> None:
    live = ("look", "--live", "--out", tmp_path, "--seconds")
    with camera("/other/depth/image_raw") as node:
        node.create_publisher(CompressedImage, "/other/depth/compressedDepth", 1)
        check_refused("has messages of type sensor_msgs/msg/CompressedImage", *live, 5, "/other/depth/compressedDepth")
        done = run_here(*live, 10)  # the other camera may be found late
    assert done.returncode == 1
    assert "/depth/image_rect has no publisher within 10 s" in done.stderr and "Topics with images: /other/depth/image_raw." in done.stderr
    check_refused("No other topic has images; check ROS_DOMAIN_ID", *live, 0.5)


@pytest.mark.parametrize(
    ("cameras", "options", "expected"),
    [
        (
            [{"change": lambda image, info: setattr(image, "encoding", "rgb8")}],
            (),
            "images of encoding 'rgb8', expected one of 16UC1, 32FC1",
        ),
        ([{"info": False}], (), "but no camera info on /depth/camera_info (0 publishers)"),
        ([{}, {}], (), "2 publishers send images on /depth/image_rect ("),
        ([{}], ("depth/camera_info",), "expected that of the images beside it"),
        ([{}], ("depth image",), "is not a name that ROS allows"),
    ],
)
def test_each_camera_that_cannot_be_used_ends_in_one_line(
    cameras: list[dict[str, Any]], options: tuple[str, ...], expected: str, tmp_path: Path
) -> None:
    with ExitStack() as stack:
        for own in cameras:
            stack.enter_context(camera(**own))
        check_refused(expected, "look", "--live", "--seconds", 4, *options, "--out", tmp_path)


def test_options_that_no_source_or_no_live_camera_has_are_refused_at_once(tmp_path: Path) -> None:
    for options, expected in (
        ((), "There is no SOURCE"),
        (("--live", "--intrinsics", "300,300,160,120"), "leave out --intrinsics"),
        (("--live", "."), "is a file or folder, expected a topic"),
    ):
        check_refused(expected, "look", *options, "--out", tmp_path)


def test_ctrl_c_ends_listening_without_a_traceback(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "push_ident.cli", "look", "--live", "--seconds", "60", "--out", str(tmp_path)]
    with subprocess.Popen(
        command, env=os.environ | {"PYTHONUNBUFFERED": "1"}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and "listening" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=20)
    assert process.returncode == 130 and "Traceback" not in error
