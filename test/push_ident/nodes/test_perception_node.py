"""perception_node, in the process of the test, with cameras that it plays."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from shape_msgs.msg import SolidPrimitive
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from helpers.depth_scene import CAMERA, HAMMER, HAMMER_OUTLINE, INTRINSICS, Prism, circle, look_at, rectangle, render
from helpers.executor_cell import ask, wait_for
from helpers.lifecycle import Lifecycle
from helpers.node_process import Talker
from helpers.paths import CONFIG
from helpers.spinning import running, spinning
from push_ident.errors import PerceptionError
from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.base.settings import NODE
from push_ident.nodes.convert.markers import refusals_from_msg
from push_ident.nodes.convert.messages import (
    camera_accuracy_from_msg,
    depth_frame_to_msgs,
    planar_pose_from_msg,
    position_to_msg,
    shape_from_msgs,
    stamp_from_msg,
    stamp_to_msg,
)
from push_ident.nodes.perception.perception_node import OlderImages, PerceptionNode
from push_ident.perception.frame.view import points_in_table
from push_ident.survey.parameter_file import pose_lines
from push_ident.types import DepthFrame

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SIDE = look_at((0.0, -0.6, 0.8), (0.0, 0.0, 0.0))
POSE = np.array([0.03, -0.02, 0.4])
SECOND, THIRD = np.array([-0.03, 0.05, 1.0]), np.array([-0.09, -0.02, 1.6])
"""Where it rests later."""
PARAMETERS = CONFIG / "push_ident.yaml"
TOOL = np.array([-0.15, 0.15, 0.004])


class Camera(Node):
    """Publishes depth of a hammer at rest beside the lowered tool; keeps what comes back."""

    def __init__(self, context: Context) -> None:
        super().__init__("camera", context=context)
        rng = np.random.default_rng(0)
        scene = [prism.at(POSE) for prism in HAMMER] + [Prism(circle(0.018) + TOOL[:2], 0.11, TOOL[2])]
        self.frames = [render(scene, rng=rng) for _ in range(4)]
        self.with_more = [render([*scene, Prism(rectangle(-0.1, 0.36, -0.02, 0.44), 0.04)], rng=rng)]
        """And something over the border of the workspace."""
        self.images = self.create_publisher(Image, "depth/image_rect", qos_profile_sensor_data)
        self.infos = self.create_publisher(CameraInfo, "depth/camera_info", qos_profile_sensor_data)
        self.tool = self.create_publisher(PoseStamped, "tool/pose", 10)
        kept: dict[str, list[Any]] = {}
        for kind, topic, qos in (
            (OccupancyGrid, "objects/o1/cells", LATCHED),
            (PolygonStamped, "objects/o1/outline", LATCHED),
            (PoseWithCovarianceStamped, "objects/o1/pose", 10),
            (OccupancyGrid, "workspace/occupancy", LATCHED),
            (MarkerArray, "workspace/refused", LATCHED),
            (DiagnosticArray, "/diagnostics", 10),
            (PoseWithCovarianceStamped, "depth/camera_accuracy", LATCHED),
            (PoseStamped, "depth/camera_pose", LATCHED),
            (TFMessage, "/tf", QoSProfile(depth=100)),
            (TFMessage, "/tf_static", LATCHED),
        ):
            self.create_subscription(kind, topic, kept.setdefault(topic, []).append, qos)
        self.cells, self.outlines, self.poses, self.workspace, self.refused, self.diagnostics, self.accuracies, *frames = kept.values()
        self.camera_poses, self.moving, self.static = frames
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


def send_until(camera: Camera, condition: Callable[[], object], **how: object) -> None:
    deadline = time.monotonic() + 120.0  # the node may have to start first
    while not condition():
        assert time.monotonic() < deadline, camera.values()
        camera.send(**how)  # type: ignore[arg-type]
        time.sleep(1 / 15)


pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def camera(domain: int) -> Iterator[Camera]:
    with spinning(Camera, domain) as camera:
        yield camera


@pytest.fixture(scope="module")
def node(domain: int, camera: Camera) -> Iterator[PerceptionNode]:
    with running(PerceptionNode, domain, "rest_frames:=4", file=PARAMETERS) as node:
        wait_for(lambda: camera.diagnostics, 120.0)
        yield node


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
    grid = camera.workspace[-1].info
    cells = np.reshape(camera.workspace[-1].data, (grid.height, grid.width))
    centre = grid.resolution * (np.argwhere(cells == 100).mean(axis=0)[::-1] + 0.5)
    assert np.add(centre, [grid.origin.position.x, grid.origin.position.y]) == pytest.approx(pose[:2], abs=0.005) and -1 in cells
    wait_for(lambda: "stage_tracked" in camera.values())


def test_frames_of_objects_and_camera_are_broadcast_with_the_stamps_and_numbers_of_their_poses(camera, node):
    first = len(camera.moving)
    send_until(camera, lambda: len(camera.moving) > first + 3)
    stamped = {stamp_from_msg(msg.header.stamp): msg.pose.pose for msg in camera.poses}
    for msg in camera.moving[first:]:
        (transform,) = msg.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("table", "object_o1")
        pose, at = stamped[stamp_from_msg(transform.header.stamp)], transform.transform.translation
        assert [at.x, at.y, at.z] == [pose.position.x, pose.position.y, pose.position.z]
        assert transform.transform.rotation == pose.orientation
    (transform,) = camera.static[-1].transforms
    at, published = transform.transform.translation, camera.camera_poses[-1]
    assert (transform.header.frame_id, transform.child_frame_id) == ("table", "camera_depth_optical_frame")
    assert transform.header.stamp == published.header.stamp and transform.transform.rotation == published.pose.orientation
    assert [at.x, at.y, at.z] == [published.pose.position.x, published.pose.position.y, published.pose.position.z]


def await_refusal(camera: Camera, key: str, change: Callable[[Image, CameraInfo], None], text: str) -> None:
    """Until changed images are refused with this text: those of an earlier change may still wait for the node."""
    before = int(camera.values().get(key, 0))

    def is_refused() -> bool:
        values = camera.values()
        return int(values.get(key, 0)) > before and text in values["last_error"]

    send_until(camera, is_refused, change=change)


def test_images_that_are_refused_are_counted_by_reason_and_the_node_goes_on(camera, node):
    """Which ones are: `test_convert.py`."""

    def other_frame(image: Image, info: CameraInfo) -> None:
        info.header.frame_id = "elsewhere"

    def blind(image: Image, info: CameraInfo) -> None:
        image.data = type(image.data)("B", bytes(len(image.data)))

    def old_info(image: Image, info: CameraInfo) -> None:
        info.header.stamp = stamp_to_msg(stamp_from_msg(image.header.stamp) - 0.3)

    await_refusal(camera, "frames_refused", other_frame, "'elsewhere'")
    await_refusal(camera, "frames_without_result", blind, f"0 valid of {INTRINSICS.width * INTRINSICS.height} pixels")
    camera.stamp += 1.0  # infos all stand at the last good stamp: a second later nothing belongs together
    await_refusal(camera, "dropped_skew", old_info, "ms apart, expected at most 100 ms")
    before = len(camera.poses)
    send_until(camera, lambda: len(camera.poses) > before + 2, info_first=True)


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


def test_an_older_image_is_of_a_source_that_starts_again_unless_there_is_a_second_driver():
    world = SimpleNamespace(n_drivers=1, now=100.0)
    older = OlderImages(lambda: world.n_drivers, lambda: world.now)
    older.check(5.0)
    world.n_drivers = 2
    with pytest.raises(PerceptionError, match=r"2 nodes publish images, and this one is 0\.100 s older"):
        older.check(0.1)
    world.n_drivers, world.now = 1, 100.9
    with pytest.raises(PerceptionError, match=r"0\.100 s older than the latest: of a node that has just stopped"):
        older.check(0.1)
    world.now = 101.1
    older.check(0.1)


def test_time_going_back_starts_anew(camera, node):
    before, camera.stamp = int(camera.values().get("restarts", 0)), 10.0
    send_until(camera, lambda: int(camera.values().get("restarts", 0)) > before)
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
        # One message has the frames of all objects, and none of one that is no longer seen.
        camera.moving.clear()
        send_until(camera, lambda: camera.moving)
        assert {transform.child_frame_id for transform in camera.moving[-1].transforms} == {"object_o2", "object_o3"}
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


def test_a_better_outline_is_published_once_the_object_rests_elsewhere_also_after_a_pause(domain, camera, node):
    before, camera.stamp, frames, rng = int(camera.values().get("restarts", 0)), 1.0, camera.frames, np.random.default_rng(0)
    try:
        camera.frames = [cut_hammer(POSE, rng, True)]
        send_until(camera, lambda: int(camera.values().get("restarts", 0)) > before and camera.values().get("object_o1") == "tracked")
        assert area_of_outline(camera) < 0.95 * 0.00712
        move(camera, rng, POSE, SECOND)
        rest_for_long(camera)
        assert area_of_outline(camera) < 0.95 * 0.00712, "it is under way"
        with Lifecycle("perception_node", domain) as lifecycle:
            for state in ("inactive", "active"):
                lifecycle.go_to(state)
            send_until(camera, lambda: area_of_outline(camera) == pytest.approx(0.00712, rel=0.04))
            wait_for(lambda: camera.values().get("outlines_refined") == "1")
            move(camera, rng, SECOND, THIRD)
            rest_for_long(camera)
            for state in ("inactive", "unconfigured", "active"):
                lifecycle.go_to(state)
            camera.diagnostics.clear()
            send_until(camera, lambda: camera.values().get("object_o1") == "tracked")
    finally:
        camera.frames = frames


def test_accuracy_of_the_camera_is_published_and_again_when_it_changes(camera, node):
    def stated() -> float:
        return camera_accuracy_from_msg(camera.accuracies[-1]).position if camera.accuracies else np.nan

    send_until(camera, lambda: stated() == pytest.approx(0.002))
    for accuracy in (0.005, 0.0, 0.002):
        assert node.set_parameters([Parameter("camera_position_std", value=accuracy)])[0].successful
        send_until(camera, lambda accuracy=accuracy: stated() == pytest.approx(accuracy))


def test_a_publisher_of_another_quality_of_service_is_named_with_the_policy(camera, node):
    publisher = camera.create_publisher(SolidPrimitive, "pusher/shape", QoSProfile(depth=1))
    try:
        wait_for(lambda: int(camera.values().get("incompatible_qos", 0)) > 0)
        assert "/pusher/shape" in camera.values()["last_error"] and "DURABILITY" in camera.values()["last_error"]
    finally:
        ask(camera, lambda: camera.destroy_publisher(publisher))


def test_a_clock_that_does_not_tick_is_reported_and_no_warning_while_a_cell_starts(capfd):
    domain, started = own_domain(), time.monotonic()
    with running(PerceptionNode, domain, "use_sim_time:=true"), Talker(domain) as talker:
        talker.until(lambda: "nothing comes on /clock" in talker.values().get("why_no_pose", ""))
        # rcl warns of the nodes of the same name in this process.
        warned = [line for line in capfd.readouterr().err.splitlines() if "WARN" in line and "rcl." not in line]
        assert not warned or time.monotonic() - started > NODE.listener_wait


def test_the_node_calibrates_all_its_cameras_and_writes_what_it_found(tmp_path):
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
        "extra_cameras:=[side]",
    )
    rng, mark = np.random.default_rng(1), [Prism(outline, 0.03).at(mark_pose)]
    right, without_mark = [render(mark, rng=rng) for _ in range(4)], [render([], rng=rng)]
    with spinning(Camera, other) as camera, running(PerceptionNode, other, *parameters, file=PARAMETERS):
        camera.frames = without_mark
        camera.add("side", [render(mark, SIDE, rng=rng) for _ in range(4)])
        send_until(camera, lambda: camera.values().get("why_no_pose", "").startswith("still no extrinsics (calibrate)"))
        camera.frames = right
        send_until(camera, lambda: {"note_extrinsics", "note_extrinsics_side"} <= set(camera.values()))
        assert "outline of the mark 0." in camera.values()["note_extrinsics"]
    found = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    for prefix, truth in (("", CAMERA), ("side.", SIDE)):
        difference = pose_of_quaternion(found[f"{prefix}camera_position"], found[f"{prefix}camera_quaternion"]) @ np.linalg.inv(truth)
        assert np.linalg.norm(difference[:3, 3]) < 0.002
        assert np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)) < np.deg2rad(0.5)


def test_a_further_camera_helps_with_the_shape_and_a_missing_one_is_named(tmp_path):
    other = own_domain()
    file = tmp_path / "cameras.yaml"
    # As calibration writes it.
    lines = [*pose_lines(CAMERA), *pose_lines(SIDE, "side."), *pose_lines(SIDE, "wall."), "extra_cameras: [side, wall]"]
    file.write_text("/**:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in lines), encoding="utf-8")
    rng = np.random.default_rng(3)
    with spinning(Camera, other) as camera, running(PerceptionNode, other, "rest_frames:=10", file=file):
        camera.add("side", [render([prism.at(POSE) for prism in HAMMER], SIDE, rng=rng) for _ in range(4)])
        send_until(camera, lambda: camera.outlines and camera.cells and camera.values().get("side_views_used") == "1")
        send_until(camera, lambda: int(camera.values().get("wall_silent", 0)) > 0)
        assert camera.values()["note_camera_wall"].startswith("no depth image on /wall/depth/image_rect (0 publishers)")
        assert camera.values()["wall_views_left_out"] == "1" and int(camera.values()["side_frames"]) >= 10
    # The object frame is turned as `table`; its origin is the centroid, 19.9 mm along the handle.
    origin = (POSE[0] + 0.0199 * np.cos(POSE[2]), POSE[1] + 0.0199 * np.sin(POSE[2]), 0.0)
    outline = transform_points(origin, shape_from_msgs(camera.cells[-1], camera.outlines[-1]).outline)
    assert np.abs(signed_distance(outline, transform_points(POSE, HAMMER_OUTLINE))).max() < 0.001
