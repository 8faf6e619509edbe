"""perception_node as a real process, with a camera that the test plays."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from depth_scene import CAMERA, HAMMER, INTRINSICS, Prism, circle, render
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from push_ident.geometry.outline import polygon_area
from push_ident.nodes.convert import (
    depth_frame_to_msgs,
    planar_pose_from_msg,
    position_to_msg,
    shape_from_msgs,
    stamp_from_msg,
    stamp_to_msg,
)
from push_ident.nodes.perception_node import camera_pose

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CONFIG = Path(__file__).parents[1] / "src/push_ident/config/push_ident.yaml"
POSE = np.array([0.03, -0.02, 0.4])
TOOL = np.array([-0.15, 0.15, 0.004])


class Camera(Node):
    """Publishes depth of a hammer at rest beside the lowered tool; keeps what comes back."""

    def __init__(self, context: Context) -> None:
        super().__init__("camera", context=context)
        rng = np.random.default_rng(0)
        scene = [prism.at(POSE) for prism in HAMMER] + [Prism(circle(0.018) + TOOL[:2], 0.11, TOOL[2])]
        self.frames = [render(scene, rng=rng) for _ in range(4)]
        self.images = self.create_publisher(Image, "depth/image_rect", qos_profile_sensor_data)
        self.infos = self.create_publisher(CameraInfo, "depth/camera_info", qos_profile_sensor_data)
        self.tool = self.create_publisher(PoseStamped, "tool/pose", 10)
        self.cells: list[OccupancyGrid] = []
        self.outlines: list[PolygonStamped] = []
        self.poses: list[PoseWithCovarianceStamped] = []
        self.workspace: list[OccupancyGrid] = []
        self.diagnostics: list[DiagnosticArray] = []
        for kind, topic, kept, qos in (
            (OccupancyGrid, "objects/o1/cells", self.cells, LATCHED),
            (PolygonStamped, "objects/o1/outline", self.outlines, LATCHED),
            (PoseWithCovarianceStamped, "objects/o1/pose", self.poses, 10),
            (OccupancyGrid, "workspace/occupancy", self.workspace, LATCHED),
            (DiagnosticArray, "/diagnostics", self.diagnostics, 10),
        ):
            self.create_subscription(kind, topic, kept.append, qos)
        self.stamp = 100.0
        self._n = 0

    def send(self, *, change: Callable[[Image, CameraInfo], None] | None = None, info_first: bool = False) -> float:
        self.stamp += 1 / 15
        self._n += 1
        stamp = stamp_to_msg(self.stamp)
        image, info = depth_frame_to_msgs(self.frames[self._n % len(self.frames)], stamp)
        info.header = type(info.header)(stamp=stamp, frame_id=info.header.frame_id)
        if change is not None:
            change(image, info)
        self.tool.publish(position_to_msg(stamp, TOOL))
        for publisher, msg in ((self.infos, info), (self.images, image)) if info_first else ((self.images, image), (self.infos, info)):
            publisher.publish(msg)
        return self.stamp

    def values(self) -> dict[str, str]:
        return {value.key: value.value for msg in self.diagnostics[-1:] for value in msg.status[0].values}


def wait_for(condition: Callable[[], object], timeout: float = 10.0) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.005)


@pytest.fixture(scope="module")
def domain() -> int:
    return random.randint(1, 100)


@pytest.fixture(scope="module")
def camera(domain: int) -> Iterator[Camera]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    camera = Camera(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(camera)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    yield camera
    executor.shutdown()
    thread.join(2.0)
    camera.destroy_node()
    context.try_shutdown()


def start(domain: int, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "push_ident.nodes.perception_node", "--ros-args", "--params-file", str(CONFIG), *arguments],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_PYTHON_CHECK_FIELDS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.fixture(scope="module")
def node(domain: int, camera: Camera) -> Iterator[subprocess.Popen[str]]:
    process = start(domain, "-p", "rest_frames:=4", "-p", "rest_frame:=4")
    try:
        wait_for(lambda: camera.diagnostics, 15.0)
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        asked = time.monotonic()
        try:
            output, _ = process.communicate(timeout=3.0)
        finally:
            process.kill()
    assert time.monotonic() - asked < 2.0
    assert process.returncode == 0 and "Traceback" not in output, output
    assert "rest_frame is not one of perception_node and is ignored; did you mean rest_frames?" in output


def send_until(camera: Camera, condition: Callable[[], object], **how: object) -> None:
    deadline = time.monotonic() + 15.0
    while not condition():
        assert time.monotonic() < deadline, camera.values()
        camera.send(**how)  # type: ignore[arg-type]
        time.sleep(1 / 15)


def test_default_extrinsics_are_those_of_the_camera_of_the_tests():
    np.testing.assert_allclose(camera_pose([0.55, 0.0, 0.85], [0.67815377, 0.67815377, -0.20026847, -0.20026847]), CAMERA, atol=1e-7)


def test_without_images_the_node_says_on_which_topic_it_waits(camera, node):
    wait_for(lambda: camera.values().get("why_nothing", "").startswith("no depth image on /depth/image_rect"))
    assert camera.diagnostics[-1].status[0].level == DiagnosticStatus.ERROR


def test_shape_pose_and_occupancy_are_published_with_the_stamp_of_the_image(camera, node):
    send_until(camera, lambda: len(camera.poses) >= 3 and camera.outlines and camera.cells and camera.workspace)
    shape = shape_from_msgs(camera.cells[-1], camera.outlines[-1])
    assert polygon_area(shape.outline) == pytest.approx(0.00712, rel=0.05)
    assert camera.cells[-1].header.frame_id == "object_o1"
    stamp, pose, covariance = planar_pose_from_msg(camera.poses[-1])
    assert ((stamp - 100.0) * 15) == pytest.approx(round((stamp - 100.0) * 15), abs=1e-6)
    # The hammer's centroid is 19.9 mm along its handle; its yaw counts from where it was first seen.
    assert pose[:2] == pytest.approx([0.03 + 0.0199 * np.cos(0.4), -0.02 + 0.0199 * np.sin(0.4)], abs=0.001)
    assert pose[2] == pytest.approx(0.0, abs=0.005)
    assert np.linalg.eigvalsh(covariance)[0] > 0
    assert camera.workspace[-1].header.frame_id == "table"

    def occupied() -> float:
        grid = camera.workspace[-1]
        return float(np.count_nonzero(np.asarray(grid.data) == 100) * grid.info.resolution**2)

    # The tool is neither object nor free: only the hammer is occupied, as soon as it is known where the tool is.
    send_until(camera, lambda: occupied() == pytest.approx(0.00712, rel=0.15))
    wait_for(lambda: "stage_tracked" in camera.values())


def test_infos_that_come_before_their_images_are_paired_too(camera, node):
    before = len(camera.poses)
    send_until(camera, lambda: len(camera.poses) > before + 2, info_first=True)


def refused(camera: Camera, key: str, change: Callable[[Image, CameraInfo], None]) -> str:
    before = int(camera.values().get(key, 0))
    send_until(camera, lambda: int(camera.values().get(key, 0)) > before, change=change)
    return camera.values()["last_error"]


def test_wrong_images_are_counted_by_reason_and_the_node_goes_on(camera, node):
    def wrong_encoding(image: Image, info: CameraInfo) -> None:
        image.encoding = "rgb8"

    def cut(image: Image, info: CameraInfo) -> None:
        image.data = image.data[:-2]

    def other_frame(image: Image, info: CameraInfo) -> None:
        info.header.frame_id = "elsewhere"

    def blind(image: Image, info: CameraInfo) -> None:
        image.data = type(image.data)("B", bytes(len(image.data)))

    assert "'rgb8', expected one of 16UC1, 32FC1" in refused(camera, "frames_refused", wrong_encoding)
    assert "expected step * height" in refused(camera, "frames_refused", cut)
    assert "'elsewhere'" in refused(camera, "frames_refused", other_frame)
    assert f"0 valid of {INTRINSICS.width * INTRINSICS.height} pixels" in refused(camera, "frames_without_result", blind)
    before = len(camera.poses)
    send_until(camera, lambda: len(camera.poses) > before)


def test_images_far_from_their_info_are_dropped_with_the_skew(camera, node):
    # Infos all stand at the last good stamp: a second later nothing belongs together.
    camera.stamp += 1.0

    def old_info(image: Image, info: CameraInfo) -> None:
        info.header.stamp = stamp_to_msg(stamp_from_msg(image.header.stamp) - 0.3)

    assert "ms apart, expected at most 50 ms" in refused(camera, "dropped_skew", old_info)


def test_time_going_back_starts_anew(camera, node):
    camera.stamp = 10.0
    send_until(camera, lambda: int(camera.values().get("restarts", 0)) == 1)
    send_until(camera, lambda: camera.poses and stamp_from_msg(camera.poses[-1].header.stamp) < 90.0)


def test_an_impossible_parameter_ends_the_process_with_one_line(domain):
    process = start(domain, "-p", "min_object_height:=7.0")
    output, _ = process.communicate(timeout=15.0)
    assert process.returncode == 1
    assert "min_object_height of perception_node is 7.0: expected 0.002 to 0.5" in output and "Traceback" not in output
