"""perception_node as a real process, with a camera that the test plays."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from shape_msgs.msg import SolidPrimitive
from visualization_msgs.msg import Marker

from helpers.depth_scene import CAMERA, HAMMER, INTRINSICS, Prism, rectangle, render
from helpers.executor_cell import Stalls, ask
from helpers.lifecycle import Lifecycle
from helpers.node_process import Talker
from helpers.played_camera import POSE, SECOND, THIRD, Camera, send_until, start, wait_for
from helpers.spinning import spinning
from push_ident.geometry.outline import polygon_area
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import (
    camera_accuracy_from_msg,
    planar_pose_from_msg,
    shape_from_msgs,
    stamp_from_msg,
    stamp_to_msg,
)
from push_ident.nodes.convert.refusals import refusals_from_msg
from push_ident.nodes.perception.perception_node import PerceptionNode
from push_ident.perception.frame.view import points_in_table

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def camera(domain: int) -> Iterator[Camera]:
    with spinning(Camera, domain) as camera:
        yield camera


@pytest.fixture(scope="module")
def node(domain: int, camera: Camera) -> Iterator[subprocess.Popen[str]]:
    process = start(domain, "-p", "rest_frames:=4", "-p", "rest_frame:=4")
    try:
        wait_for(lambda: camera.diagnostics, 120.0)
        yield process
    finally:
        with Stalls() as stalls:
            process.send_signal(signal.SIGINT)
            asked = time.monotonic()
            try:
                output, _ = process.communicate(timeout=30.0)
            finally:
                process.kill()
            took = time.monotonic() - asked
    assert took < 2.0 + 4.0 * stalls.worst
    assert process.returncode == 0 and "Traceback" not in output, output
    assert "rest_frame is not one of perception_node and is ignored; did you mean rest_frames?" in output


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


def await_refusal(camera: Camera, key: str, change: Callable[[Image, CameraInfo], None], text: str) -> None:
    """Until changed images are refused with this text: those of an earlier change may still wait for the node."""
    before = int(camera.values().get(key, 0))

    def is_refused() -> bool:
        values = camera.values()
        return int(values.get(key, 0)) > before and text in values["last_error"]

    send_until(camera, is_refused, change=change)


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

    for change, text in (
        (wrong_encoding, "'rgb8', expected one of 16UC1, 32FC1"),
        (cut, "expected step * height"),
        (other_size, "640 x 480, camera info 320 x 480"),
        (without_focal_length, "focal lengths > 0"),
        (distorted, "not rectified"),
        (overflowing, "pixels, expected 1 to"),
        (other_frame, "'elsewhere'"),
    ):
        await_refusal(camera, "frames_refused", change, text)
    await_refusal(camera, "frames_without_result", blind, f"0 valid of {INTRINSICS.width * INTRINSICS.height} pixels")
    before = len(camera.poses)
    send_until(camera, lambda: len(camera.poses) > before)


def test_images_far_from_their_info_are_dropped_with_the_skew(camera, node):
    # Infos all stand at the last good stamp: a second later nothing belongs together.
    camera.stamp += 1.0

    def old_info(image: Image, info: CameraInfo) -> None:
        info.header.stamp = stamp_to_msg(stamp_from_msg(image.header.stamp) - 0.3)

    await_refusal(camera, "dropped_skew", old_info, "ms apart, expected at most 50 ms")


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
        await_refusal(camera, "frames_without_result", also_older, "2 nodes publish images")
        latest = camera.stamp
        send_until(camera, lambda: stamp_from_msg(camera.poses[-1].header.stamp) > latest)  # all older ones have come by then
    finally:
        ask(camera, lambda: camera.destroy_publisher(other))
    assert camera.values().get("restarts") == restarts


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
            output, _ = process.communicate(timeout=30.0)
        assert process.returncode == 0 and "Traceback" not in output, output


def test_accuracy_of_the_camera_is_published_and_again_when_it_changes(camera, node):
    client = camera.create_client(SetParameters, "perception_node/set_parameters")

    def stated() -> float:
        return camera_accuracy_from_msg(camera.accuracies[-1]).position if camera.accuracies else np.nan

    def is_stated_as(accuracy: float) -> None:
        send_until(camera, lambda: stated() == pytest.approx(accuracy))

    def change(accuracy: float) -> None:
        # The answer is not awaited: a node that has not found the reading end of the client yet drops it.
        client.call_async(SetParameters.Request(parameters=[Parameter("camera_position_std", value=accuracy).to_parameter_msg()]))
        is_stated_as(accuracy)

    is_stated_as(0.002)
    wait_for(client.service_is_ready)
    try:
        change(0.005)
        change(0.0)
    finally:
        change(0.002)


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
        ask(camera, lambda: camera.destroy_publisher(publisher))


def test_a_clock_that_does_not_tick_is_reported():
    domain, arguments = own_domain(), ["--ros-args", "-p", "use_sim_time:=true"]
    with spinning(lambda context: PerceptionNode(context=context, cli_args=arguments), domain) as node, Talker(domain) as talker:
        talker.until(lambda: "nothing comes on /clock" in talker.values().get("why_no_pose", ""))
        node.close()
