"""perception_node as a real process, with a camera that the test plays."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from shape_msgs.msg import SolidPrimitive
from visualization_msgs.msg import Marker, MarkerArray

from helpers.depth_scene import CAMERA, HAMMER, HAMMER_OUTLINE, INTRINSICS, Prism, circle, look_at, rectangle, render
from helpers.domains import own_domain
from helpers.paths import CONFIG
from helpers.spinning import spinning
from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.nodes.convert import (
    depth_frame_to_msgs,
    planar_pose_from_msg,
    position_to_msg,
    shape_from_msgs,
    stamp_from_msg,
    stamp_to_msg,
)
from push_ident.nodes.convert_refusals import refusals_from_msg
from push_ident.perception.depth import points_in_table
from push_ident.perception.parameter_file import pose_lines
from push_ident.types import DepthFrame
from push_ident_sim.faults.lifecycle import Lifecycle

pytestmark = pytest.mark.alone

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SIDE = look_at((0.0, -0.6, 0.8), (0.0, 0.0, 0.0))
POSE = np.array([0.03, -0.02, 0.4])
SECOND, THIRD = np.array([-0.03, 0.05, 1.0]), np.array([-0.09, -0.02, 1.6])
"""Where it rests later."""
PARAMETERS = str(CONFIG / "push_ident.yaml")
TOOL = np.array([-0.15, 0.15, 0.004])


class Camera(Node):
    """Publishes depth of a hammer at rest beside the lowered tool; keeps what comes back."""

    def __init__(self, context: Context) -> None:
        super().__init__("camera", context=context)
        rng = np.random.default_rng(0)
        scene = [prism.at(POSE) for prism in HAMMER] + [Prism(circle(0.018) + TOOL[:2], 0.11, TOOL[2])]
        self.frames = [render(scene, rng=rng) for _ in range(4)]
        over_the_border = Prism(rectangle(-0.1, 0.36, -0.02, 0.44), 0.04)
        self.with_more = [render([*scene, over_the_border], rng=rng) for _ in range(4)]
        self.images = self.create_publisher(Image, "depth/image_rect", qos_profile_sensor_data)
        self.infos = self.create_publisher(CameraInfo, "depth/camera_info", qos_profile_sensor_data)
        self.tool = self.create_publisher(PoseStamped, "tool/pose", 10)
        self.cells: list[OccupancyGrid] = []
        self.outlines: list[PolygonStamped] = []
        self.poses: list[PoseWithCovarianceStamped] = []
        self.workspace: list[OccupancyGrid] = []
        self.refused: list[MarkerArray] = []
        self.diagnostics: list[DiagnosticArray] = []
        for kind, topic, kept, qos in (
            (OccupancyGrid, "objects/o1/cells", self.cells, LATCHED),
            (PolygonStamped, "objects/o1/outline", self.outlines, LATCHED),
            (PoseWithCovarianceStamped, "objects/o1/pose", self.poses, 10),
            (OccupancyGrid, "workspace/occupancy", self.workspace, LATCHED),
            (MarkerArray, "workspace/refused", self.refused, LATCHED),
            (DiagnosticArray, "/diagnostics", self.diagnostics, 10),
        ):
            self.create_subscription(kind, topic, kept.append, qos)
        self.further: list[tuple[Publisher, Publisher, list[DepthFrame]]] = []
        self.stamp = 100.0
        self._n = 0

    def add(self, name: str, frames: list[DepthFrame]) -> None:
        """Publish the frames of a further camera as well."""
        images = self.create_publisher(Image, f"{name}/depth/image_rect", qos_profile_sensor_data)
        infos = self.create_publisher(CameraInfo, f"{name}/depth/camera_info", qos_profile_sensor_data)
        self.further.append((images, infos, frames))

    def send(self, *, change: Callable[[Image, CameraInfo], None] | None = None, info_first: bool = False) -> float:
        self.stamp += 1 / 15
        self._n += 1
        stamp = stamp_to_msg(self.stamp)
        image, info = depth_frame_to_msgs(self.frames[self._n % len(self.frames)], stamp)
        info.header = type(info.header)(stamp=stamp, frame_id=info.header.frame_id)
        if change is not None:
            change(image, info)
        self.tool.publish(position_to_msg(stamp, TOOL))
        for images, infos, frames in self.further:
            for publisher, msg in zip((images, infos), depth_frame_to_msgs(frames[self._n % len(frames)], stamp), strict=True):
                publisher.publish(msg)
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
def camera(domain: int) -> Iterator[Camera]:
    with spinning(Camera, domain) as camera:
        yield camera


def start(domain: int, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "push_ident.nodes",
            "perception_node",
            "--ros-args",
            "--params-file",
            str(CONFIG / "push_ident.yaml"),
            *arguments,
        ],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_PYTHON_CHECK_FIELDS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.fixture(scope="module")
def node(domain: int, camera: Camera) -> Iterator[subprocess.Popen[str]]:
    process = start(domain, "-p", "rest_frames:=4", "-p", "rest_frame:=4")
    try:
        wait_for(lambda: camera.diagnostics, 30.0)
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
    deadline = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < deadline, camera.values()
        camera.send(**how)  # type: ignore[arg-type]
        time.sleep(1 / 15)


def test_default_extrinsics_are_those_of_the_camera_of_the_tests():
    np.testing.assert_allclose(pose_of_quaternion([0.55, 0.0, 0.85], [0.67815377, 0.67815377, -0.20026847, -0.20026847]), CAMERA, atol=1e-7)


def test_without_images_the_node_names_the_topic_it_waits_for(camera, node):
    wait_for(lambda: camera.values().get("why_no_pose", "").startswith("no depth image on /depth/image_rect"))
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

    def other_size(image: Image, info: CameraInfo) -> None:
        info.width = 320

    def without_focal_length(image: Image, info: CameraInfo) -> None:
        info.k, info.p = [0.0] * 9, [0.0] * 12

    def distorted(image: Image, info: CameraInfo) -> None:
        info.p, info.d = [0.0] * 12, [0.1, -0.2, 0.0, 0.0, 0.0]

    def overflowing(image: Image, info: CameraInfo) -> None:
        image.width = info.width = image.height = info.height = 2**31

    assert "'rgb8', expected one of 16UC1, 32FC1" in refused(camera, "frames_refused", wrong_encoding)
    assert "expected step * height" in refused(camera, "frames_refused", cut)
    assert "640 x 480, camera info 320 x 480" in refused(camera, "frames_refused", other_size)
    assert "focal lengths > 0" in refused(camera, "frames_refused", without_focal_length)
    assert "not rectified" in refused(camera, "frames_refused", distorted)
    assert "pixels, expected 1 to" in refused(camera, "frames_refused", overflowing)
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


def test_what_is_no_object_is_published_with_the_reason_and_its_outline(camera, node):
    frames, camera.frames = camera.frames, camera.with_more
    try:
        send_until(camera, lambda: camera.refused and refusals_from_msg(camera.refused[-1]))
    finally:
        camera.frames = frames
    ((outline, words),) = refusals_from_msg(camera.refused[-1])
    assert "reaches over the border of the workspace" in words
    assert np.linalg.norm(outline[:, :2].mean(axis=0) - (-0.06, 0.38)) < 0.03
    assert [marker.action for marker in camera.refused[-1].markers] == [Marker.DELETEALL, Marker.ADD, Marker.ADD]
    send_until(camera, lambda: not refusals_from_msg(camera.refused[-1]))


def test_images_of_a_second_camera_driver_are_refused_by_name(camera, node):
    other = camera.create_publisher(Image, "depth/image_rect", qos_profile_sensor_data)

    def also_older(image: Image, info: CameraInfo) -> None:
        older = type(image)(**{name: getattr(image, name) for name in image.get_fields_and_field_types()})
        older.header = type(image.header)(stamp=stamp_to_msg(stamp_from_msg(image.header.stamp) - 0.1), frame_id=image.header.frame_id)
        other.publish(older)

    restarts = camera.values().get("restarts")
    try:
        assert "2 nodes publish images" in refused(camera, "frames_without_result", also_older)
    finally:
        camera.destroy_publisher(other)
    assert camera.values().get("restarts") == restarts


def test_time_going_back_starts_anew(camera, node):
    camera.stamp = 10.0
    send_until(camera, lambda: int(camera.values().get("restarts", 0)) == 1)
    send_until(camera, lambda: camera.poses and stamp_from_msg(camera.poses[-1].header.stamp) < 90.0)


def test_an_object_that_came_apart_is_no_longer_published(camera, node):
    def boxes(gap):
        return [render([Prism(rectangle(-0.04, y, 0.04, y + 0.06), 0.05) for y in (-0.06, gap)], rng=np.random.default_rng(0))]

    before, camera.stamp, frames = int(camera.values().get("restarts", 0)), 1.0, camera.frames
    try:
        camera.frames = boxes(0.0)
        send_until(camera, lambda: int(camera.values().get("restarts", 0)) > before and camera.values().get("object_o1") == "tracked")
        camera.frames = boxes(0.05)
        send_until(camera, lambda: camera.values().get("given_up") == "1" and camera.values().get("object_o3") == "tracked")
    finally:
        camera.frames = frames
    assert camera.values()["note_object_o1"].startswith("given up: several things that touch")
    assert camera.count_publishers("objects/o1/pose") == 0 and camera.count_publishers("objects/o2/pose") == 1


def cut_hammer(pose, rng, is_cut):
    """A hammer; cut, nothing is measured at the end of its handle, as in a shadow."""
    frame = render([prism.at(pose) for prism in HAMMER], rng=rng)
    if not is_cut:
        return frame
    at = transform_points(inverse(pose), points_in_table(frame, CAMERA)[..., :2].reshape(-1, 2)).reshape(*frame.depth.shape, 2)
    end_of_handle = (np.abs(at[..., 0] + 0.105) < 0.02) & (np.abs(at[..., 1]) < 0.02)
    return replace(frame, depth=np.where(end_of_handle, np.float32(np.nan), frame.depth))


def take_in_and_move(camera, rng):
    """A cut hammer is taken in and moved to another place, where all of it is seen."""
    camera.frames = [cut_hammer(POSE, rng, True)]
    send_until(camera, lambda: camera.values().get("object_o1") == "tracked")
    assert area_of_outline(camera) < 0.95 * 0.00712
    move(camera, rng, POSE, SECOND)


def move(camera, rng, begin, end):
    for share in np.linspace(0.1, 1.0, 10):
        camera.frames = [cut_hammer(begin + share * (end - begin), rng, False)]
        send_one(camera)


def send_one(camera):
    """One frame, until there is a pose of it."""
    n = len(camera.poses)
    camera.send()
    wait_for(lambda: len(camera.poses) > n)


def rest_for_long(camera):
    """A search finds the rest after 4 to 9 frames; a better outline then has more parts than the rest of these frames have turns."""
    for _ in range(12):
        send_one(camera)


def area_of_outline(camera):
    return polygon_area(shape_from_msgs(camera.cells[-1], camera.outlines[-1]).outline)


def test_a_better_outline_is_published_once_the_object_rests_elsewhere(camera, node):
    before, camera.stamp, frames = int(camera.values().get("restarts", 0)), 1.0, camera.frames
    try:
        camera.frames = [cut_hammer(POSE, np.random.default_rng(1), True)]
        send_until(camera, lambda: int(camera.values().get("restarts", 0)) > before)
        take_in_and_move(camera, np.random.default_rng(0))
        send_until(camera, lambda: camera.values().get("outlines_refined") == "1")
        wait_for(lambda: area_of_outline(camera) == pytest.approx(0.00712, rel=0.02))
    finally:
        camera.frames = frames


def test_a_node_stops_while_a_better_outline_is_under_way_and_goes_on_or_begins_anew():
    domain, rng = own_domain(), np.random.default_rng(0)
    with spinning(Camera, domain) as camera, Lifecycle.of("perception_node", domain) as lifecycle:
        process = start(domain, "-p", "rest_frames:=4")
        try:
            lifecycle.wait()

            take_in_and_move(camera, rng)
            rest_for_long(camera)
            assert area_of_outline(camera) < 0.95 * 0.00712
            lifecycle.go_to("inactive")
            lifecycle.go_to("active")
            send_until(camera, lambda: area_of_outline(camera) == pytest.approx(0.00712, rel=0.02))
            move(camera, rng, SECOND, THIRD)
            rest_for_long(camera)
            for state in ("inactive", "unconfigured", "active"):
                lifecycle.go_to(state)
            camera.diagnostics.clear()
            send_until(camera, lambda: camera.values().get("object_o1") == "tracked")
        finally:
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=10.0)
        assert process.returncode == 0 and "Traceback" not in output, output


@pytest.mark.parametrize(
    ("parameter", "line"),
    [
        ("min_object_height:=7.0", "min_object_height of perception_node is 7.0: expected 0.002 to 0.5"),
        ("camera_heading_std:=-0.01", "camera_heading_std of perception_node is -0.01: expected 0 to 0.2 (standard deviation"),
    ],
)
def test_an_impossible_parameter_ends_the_process_with_one_line(domain, parameter, line):
    process = start(domain, "-p", parameter)
    output, _ = process.communicate(timeout=15.0)
    assert process.returncode == 1 and line in output and "Traceback" not in output


def test_accuracy_of_the_camera_widens_the_poses_of_an_object_that_turned(camera, node):
    hammers = [render([prism.at(POSE + np.array([0.0, 0.0, turn])) for prism in HAMMER]) for turn in np.linspace(0.0, 1.0, 13)]
    client = camera.create_client(SetParameters, "perception_node/set_parameters")

    def std_with(accuracy: float) -> float:
        asked = Parameter("camera_position_std", value=accuracy).to_parameter_msg()
        wait_for(client.call_async(SetParameters.Request(parameters=[asked])).done)
        n = len(camera.poses)
        send_until(camera, lambda: len(camera.poses) > n + 1)
        return float(np.sqrt(camera.poses[-1].pose.covariance[0]))

    send_until(camera, lambda: camera.poses)
    frames, camera.frames, camera.stamp, before = camera.frames, hammers[:1], 1.0, int(camera.values().get("restarts", 0))
    try:
        send_until(camera, lambda: int(camera.values().get("restarts", 0)) > before and camera.values().get("object_o1") == "tracked")
        assert std_with(0.005) < 0.002
        for frame in hammers[1:]:
            camera.frames = [frame]
            turned = std_with(0.005)
        assert turned == pytest.approx(0.005 * np.hypot(1.0 - np.cos(1.0), np.sin(1.0)), rel=0.15) and std_with(0.0) < 0.002
    finally:
        camera.frames = frames


def test_where_nothing_was_measured_the_workspace_is_unknown(camera, node):
    def half_blind(image: Image, info: CameraInfo) -> None:
        pixels = np.frombuffer(image.data, np.uint16).reshape(image.height, image.width).copy()
        pixels[:, : image.width // 2] = 0
        image.data = type(image.data)("B", pixels.tobytes())

    before = len(camera.workspace)
    send_until(camera, lambda: len(camera.workspace) > before + 1, change=half_blind)
    grid = camera.workspace[-1]
    cells = np.asarray(grid.data, np.int8).reshape(grid.info.height, grid.info.width)
    # The camera looks along -x, so the left half of its image is the half of negative y.
    assert np.mean(cells[: len(cells) // 2 - 20, 150:250] == -1) > 0.99
    assert np.mean(cells[len(cells) // 2 + 20 : -60, 200:300] == -1) < 0.5


def test_a_publisher_of_another_quality_of_service_is_named_with_the_policy(camera, node):
    publisher = camera.create_publisher(SolidPrimitive, "pusher/shape", QoSProfile(depth=1))
    try:
        wait_for(lambda: int(camera.values().get("incompatible_qos", 0)) > 0)
        assert "/pusher/shape" in camera.values()["last_error"] and "DURABILITY" in camera.values()["last_error"]
    finally:
        camera.destroy_publisher(publisher)


def test_a_clock_that_does_not_tick_is_reported_within_five_seconds(domain, camera):
    process = start(domain, "-r", "__ns:=/lonely", "-p", "use_sim_time:=true")
    lines: list[str] = []
    reader = threading.Thread(target=lambda: lines.extend(process.stdout or ()), daemon=True)
    reader.start()
    try:
        # From when the node is there: the imports of its process take a while on a busy machine.
        wait_for(lambda: ("perception_node", "/lonely") in camera.get_node_names_and_namespaces(), 30.0)
        wait_for(lambda: any("nothing comes on /clock" in line for line in lines), 6.0)
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(5.0)


def test_extrinsics_from_tf_without_tf_end_with_one_line(domain):
    if importlib.util.find_spec("tf2_ros") is not None:
        pytest.skip("tf2_ros is installed here")
    process = start(domain, "-p", "extrinsics:=tf")
    output, _ = process.communicate(timeout=20.0)
    assert process.returncode == 1
    assert "tf2_ros is not installed; give camera_position" in output and "Traceback" not in output


def as_arguments(*parameters: str) -> list[str]:
    return [word for parameter in parameters for word in ("-p", parameter)]


def end(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=5.0)
    assert "Traceback" not in output, output
    return output


def test_the_node_calibrates_all_its_cameras_and_writes_what_it_found(domain, tmp_path):
    outline, mark_pose = np.array([(0.0, 0.0), (0.15, 0.0), (0.0, 0.1)]), (0.05, -0.03, 0.7)
    other = own_domain()
    file = tmp_path / "camera.yaml"
    pose = ", ".join(str(value) for value in mark_pose)
    parameters = ("extrinsics:=calibrate", f"mark_pose:=[{pose}]", "calibration_frames:=6", f"calibration_file:={file}")
    with spinning(Camera, other) as camera:
        rng = np.random.default_rng(1)
        mark = [Prism(outline, 0.03).at(mark_pose)]
        camera.frames = [render(mark, rng=rng) for _ in range(4)]
        camera.add("side", [render(mark, SIDE, rng=rng) for _ in range(4)])
        process = start(other, *as_arguments(*parameters, "extra_cameras:=[side]"))
        try:
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


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        (["extra_cameras:=[side]"], "Give side.camera_position and side.camera_quaternion"),
        (["extra_cameras:=[side, side]"], "extra_cameras has 'side', expected different names"),
        (["extra_cameras:=[2nd]"], "extra_cameras has '2nd', expected different names of letters"),
    ],
)
def test_further_cameras_without_a_pose_or_a_name_end_with_one_line(domain, parameters, line):
    process = start(domain, *as_arguments(*parameters))
    output, _ = process.communicate(timeout=20.0)
    assert process.returncode == 1
    assert line in output and "Traceback" not in output
